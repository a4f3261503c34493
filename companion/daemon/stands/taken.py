"""The stands of an alignment as they were taken, and as the estimate takes them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Container, Sequence
from typing import Final

import numpy as np

from companion.daemon.stands.align_steps import Seen
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align_model import Ground, ImuStand, Stand
from companion.estimation.means.pose import CompassModel
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.solution.site import LocalEarth
from companion.physics.units import DEG

READING_SIGMA_DEG: Final = 0.005
"""What one mean of a gradienter is good for besides its zero (the gradienter noise of the table in method 3.4)."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """One stand, measured; its heading counts from the compass' own north, else from the first stand, not wrapped."""

    window: Window
    seen: Seen
    heading_sigma_deg: float
    counted: bool = False
    """By how much it was turned since the stand before."""

    @property
    def seconds(self) -> float:
        """How long it was measured."""
        return self.window.end_s - self.window.start_s

    def as_stand(
        self,
        names: Sequence[str],
        *,
        on_spot: bool = True,
        north_deg: float = 0.0,
        zero_deg: tuple[float, float] = (0.0, 0.0),
    ) -> Stand:
        """Of these IMUs; `north_deg` is its north from the true one, `zero_deg` the gradienter's as configured."""
        imus, tilt = {imu.name: imu for imu in self.window.imus}, self.window.tilt
        sigmas = (1.0, 1.0) if tilt is None else (tilt.x_sigma_deg, tilt.y_sigma_deg)
        return Stand(
            imus=tuple(_imu_stand(imus[name]) for name in names),
            tilt_deg=None if tilt is None else (tilt.x_deg - zero_deg[0], tilt.y_deg - zero_deg[1]),
            tilt_sigma_deg=(math.hypot(READING_SIGMA_DEG, sigmas[0]), math.hypot(READING_SIGMA_DEG, sigmas[1])),
            heading_rad=(self.seen.heading_deg + north_deg) * DEG,
            heading_sigma_rad=self.heading_sigma_deg * DEG,
            on_spot=on_spot,
            counted=self.counted,
        )


def _imu_stand(imu: ImuWindow) -> ImuStand:
    figures = imu.accel_m_s2, imu.accel_sigma_use_m_s2, imu.gyro_rad_s, imu.gyro_sigma_use_rad_s
    return ImuStand(imu.name, *map(np.array, figures))


def readable(taken: Sequence[Taken], among: Container[str] | None = None) -> list[str]:
    """IMUs whose accelerometers can be read in all stands, of all or of these.

    Raises:
        CalibrationRefusedError: there is none.
    """
    read = [{imu.name for imu in one.window.imus if not imu.refused("accel")} for one in taken]
    names = [imu.name for imu in taken[0].window.imus if all(imu.name in each for each in read)]
    names = [name for name in names if among is None or name in among]
    if not names:
        raise CalibrationRefusedError("no IMU whose accelerometers can be read")
    return names


def ground(local: LocalEarth, compass: CompassModel | None) -> Ground:
    """Without a compass headings count from the first stand, which may point anywhere."""
    rate = local.rate_in_body(np.eye(3), heading_known=compass is not None)
    covariance = rate.covariance.copy()
    if compass is not None and compass.magnetic:
        east = local.rate_ned_rad_s[0] * local.declination_sigma_deg * DEG
        covariance[1, 1] += east**2
    return Ground(local.gravity_m_s2, local.gravity_sigma_m_s2, rate.mean, covariance)
