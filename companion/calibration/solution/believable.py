"""Which means of a window can be those of a biased sensor: the others take no part."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from companion.calibration.means.windows import Hidden, ImuWindow
from companion.calibration.solution.site import LocalEarth
from companion.calibration.stillness.plausible import implausible
from companion.physics.frames import Array


def believable(imus: Sequence[ImuWindow], up: Array, local: LocalEarth) -> tuple[ImuWindow, ...]:
    """The same; what cannot be is hidden, with the words that say why and what to do. `up` (3,), vehicle FRD."""
    return tuple(_believable(imu, local.gravity_m_s2 * up, local) for imu in imus)


def _believable(imu: ImuWindow, expected_m_s2: Array, local: LocalEarth) -> ImuWindow:
    means = np.array(imu.gyro_rad_s), np.array(imu.accel_m_s2)
    found = implausible(imu.name, *means, expected_m_s2, np.array(imu.mounting), local.remedies.mounting)
    hidden = {triad: Hidden(f"{words}; {local.remedies.any_bias}", useless=True) for triad, words in found.items()}
    return msgspec.structs.replace(imu, hidden={**imu.hidden, **hidden}) if hidden else imu
