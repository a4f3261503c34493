"""Which means of a window can be those of a biased sensor, what is to be said of the others, and why sigma is wide."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from companion.calibration.means.windows import Hidden, ImuWindow
from companion.calibration.solution.site import LocalEarth, Remedies
from companion.calibration.stillness.plausible import implausible
from companion.physics.frames import Array, Matrix
from companion.samples import Triad


def believable(imu: ImuWindow, up: Array, local: LocalEarth) -> ImuWindow:
    """The same; what cannot be is hidden, with the words that say why and what to do. `up` (3,), vehicle FRD."""
    means = np.array(imu.gyro_rad_s), np.array(imu.accel_m_s2)
    found = implausible(imu.name, *means, local.gravity_m_s2 * up, np.array(imu.mounting), local.remedies.mounting)
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


def without_heading(imus: Sequence[ImuWindow], earth_covariance: Matrix, remedies: Remedies) -> list[str]:
    """What made the gyros' sigma wide whose heading nobody knows: that, or a part that nobody has named.

    `earth_covariance` (3, 3) is what is not known of the Earth's rate, (rad/s)^2.
    """
    earth = float(np.diag(earth_covariance).max())
    by_part = [
        imu.name
        for imu in imus
        # Where integers hide the mean, that made it, and is said.
        if not imu.named and "gyro" not in imu.hidden and float(np.square(imu.gyro_sigma_use_rad_s).max()) > earth
    ]
    found = [f"imu {name}: gyro sigma is that of the worst common parts: {remedies.part}" for name in by_part]
    if len(by_part) < len(imus):
        found.append(f"{remedies.no_heading}: the horizontal part of the Earth's rate is unknown, gyro sigma widened")
    return found
