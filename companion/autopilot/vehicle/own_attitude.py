"""The autopilot's own attitude (ATTITUDE, #30), and whether its yaw is a heading.

No message gives a sigma of the yaw. It is a heading while the autopilot has a healthy magnetometer (SYS_STATUS) and
its estimator compares one with its yaw and finds them agreeing (EKF_STATUS_REPORT, ESTIMATOR_STATUS): then it is as
good as a compass next to motors and wires is, and no better.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.solution.otherwise import OwnHeading
from companion.calibration.solution.site import UNKNOWN_DECLINATION_SIGMA_DEG
from companion.physics.units import DEG

HEADING_SIGMA_DEG: Final = 10.0
"""Of an autopilot's compass that agrees with its gyros; next to iron, or badly calibrated, it is off by more."""
RATE_HZ: Final = 1.0
STEADY_DEG: Final = 2.0
"""By how much yaw may move in `KEPT_S` while the aircraft stands: else the estimator is still looking for it."""
KEPT_S: Final = 5.0
OLD_S: Final = 5.0
_MAGNETOMETER: Final[int] = mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG


class Angles(NamedTuple):
    """Of ATTITUDE, rad."""

    t_s: float
    roll: float
    pitch: float
    yaw: float


class OwnAttitude:
    """Listens to the latched autopilot.

    Args:
        vehicle: it.
        wanted: ask for what the heading needs, all the time.
    """

    def __init__(self, vehicle: Vehicle, *, wanted: bool) -> None:
        self._vehicle = vehicle
        self._seen: deque[Angles] = deque(maxlen=256)
        self._has_compass_s = self._agrees_s = -math.inf
        rate_hz = RATE_HZ if wanted else None
        vehicle.hear(mavlink.MAVLink_attitude_message, self._on_attitude, rate_hz)
        vehicle.hear(mavlink.MAVLink_sys_status_message, self._on_status, rate_hz)
        vehicle.hear(mavlink.MAVLink_ekf_status_report_message, self._on_ardupilot, rate_hz, "ardupilot")
        vehicle.hear(mavlink.MAVLink_estimator_status_message, self._on_px4, rate_hz, "px4")

    def heading(self) -> OwnHeading | None:
        """Its yaw from true north; None while it has none that can be believed."""
        now_s = asyncio.get_running_loop().time()
        seen = self._since(now_s - KEPT_S)
        if len(seen) < 2 or min(self._has_compass_s, self._agrees_s) < now_s - OLD_S:
            return None
        last = seen[-1].yaw
        turned = [(one.yaw - last + math.pi) % (2.0 * math.pi) - math.pi for one in seen]
        if max(turned) - min(turned) > STEADY_DEG * DEG:
            return None
        # Without a place it knows no declination.
        north_deg = 0.0 if self._vehicle.place.position is not None else UNKNOWN_DECLINATION_SIGMA_DEG
        return OwnHeading((last + sum(turned) / len(turned)) / DEG % 360.0, math.hypot(HEADING_SIGMA_DEG, north_deg))

    def _since(self, t_s: float) -> list[Angles]:
        return [one for one in self._seen if one.t_s >= t_s]

    def _on_attitude(self, message: mavlink.MAVLink_attitude_message, t_s: float) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        if all(map(math.isfinite, angles)):
            self._seen.append(Angles(t_s, *angles))

    def _on_status(self, message: mavlink.MAVLink_sys_status_message, t_s: float) -> None:
        fit = (
            message.onboard_control_sensors_present
            & message.onboard_control_sensors_enabled
            & message.onboard_control_sensors_health
            & _MAGNETOMETER
        )
        self._has_compass_s = t_s if fit else -math.inf

    def _on_ardupilot(self, message: mavlink.MAVLink_ekf_status_report_message, t_s: float) -> None:
        fit = message.flags & mavlink.EKF_ATTITUDE and not message.flags & mavlink.EKF_UNINITIALIZED
        self._agrees(message.compass_variance, t_s, fit=bool(fit))

    def _on_px4(self, message: mavlink.MAVLink_estimator_status_message, t_s: float) -> None:
        self._agrees(message.mag_ratio, t_s, fit=bool(message.flags & mavlink.ESTIMATOR_ATTITUDE))

    def _agrees(self, ratio: float, t_s: float, *, fit: bool) -> None:
        """`ratio`: of the innovation to what is allowed; exactly 0 where nothing is compared."""
        self._agrees_s = t_s if fit and 0.0 < ratio < 1.0 else -math.inf
