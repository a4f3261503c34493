"""What made the gyros' sigma wide: a heading that nobody knows, or a part that nobody has named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.calibration.means.windows import ImuWindow
from companion.calibration.solution.site import Remedies
from companion.physics.frames import Matrix


def without_heading(imus: Sequence[ImuWindow], earth_covariance: Matrix, remedies: Remedies) -> list[str]:
    """Warnings of gyros whose heading is not known: each names the larger of the two.

    Args:
        imus: as measured.
        earth_covariance: (3, 3) of what is not known of the Earth's rate, (rad/s)^2.
        remedies: why there is no heading, and how to name the part.
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
