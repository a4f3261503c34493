"""Which means of a window can be those of a biased sensor, and what is to be said of the others."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from companion.calibration.means.windows import Hidden, ImuWindow
from companion.calibration.solution.site import LocalEarth
from companion.calibration.stillness.plausible import implausible
from companion.physics.frames import Array
from companion.samples import Triad


def believable(imus: Sequence[ImuWindow], up: Array, local: LocalEarth) -> tuple[ImuWindow, ...]:
    """The same; what cannot be is hidden, with the words that say why and what to do. `up` (3,), vehicle FRD."""
    return tuple(_believable(imu, local.gravity_m_s2 * up, local) for imu in imus)


def _believable(imu: ImuWindow, expected_m_s2: Array, local: LocalEarth) -> ImuWindow:
    means = np.array(imu.gyro_rad_s), np.array(imu.accel_m_s2)
    found = implausible(imu.name, *means, expected_m_s2, np.array(imu.mounting), local.remedies.mounting)
    hidden = {triad: Hidden(f"{words}; {local.remedies.any_bias}", useless=True) for triad, words in found.items()}
    return msgspec.structs.replace(imu, hidden={**imu.hidden, **hidden}) if hidden else imu


def untold(imu: ImuWindow, asked: Collection[Triad]) -> list[str]:
    """What this IMU's readings do not tell, or not well, of what is asked for."""
    return list(dict.fromkeys(hidden.words for triad, hidden in imu.hidden.items() if triad in asked))


def widened(imu: ImuWindow, asked: Collection[Triad], powered_s: float, variance: Array) -> list[str]:
    """Why its sigma is wide, where that is for a warm-up; `variance` (6,): what is in it besides."""
    if imu.warming is None or "gyro" not in asked or imu.refused("gyro") is not None:
        return []
    words = imu.warming.in_words(imu.name, powered_s, variance)
    return [words] if words else []
