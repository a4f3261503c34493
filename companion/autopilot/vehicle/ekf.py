"""The autopilot's own estimator: its gyro biases, its attitude (ATTITUDE, #30), and whether its yaw can be trusted.

ArduPilot reports its gyro biases in AHRS (#163): omegaI is minus the estimate. After a step in the offsets EKF3 keeps
its old estimate, which is then wrong by minus the step. Meanwhile the heading turns by that error times 17 to 25 s
(docs/reference/autopilots 1.7, 9.3.1). With right offsets the true bias is zero, so omegaI shows if EKF3 has settled.

No message gives a sigma of the yaw. The yaw is a heading while the autopilot has a healthy magnetometer (SYS_STATUS)
and its estimator reports that the yaw agrees with the magnetometer (EKF_STATUS_REPORT, ESTIMATOR_STATUS). Its accuracy
is then that of a compass next to motors and wires.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.firmwares import FIRMWARES
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.estimation.solution.site import UNKNOWN_DECLINATION_SIGMA_DEG
from companion.estimation.solution.truth import OwnHeading
from companion.links.mavlink.link import Message
from companion.links.system.events import comes
from companion.messages import message
from companion.physics.frames import Array, body_from_ned
from companion.physics.units import DEG

ADJUSTING: Final = "EKF adjusting"
SETTLED_RAD_S: Final = 0.02 * DEG
"""Largest bias estimate of a settled EKF, per axis: 72 deg/h. After a reset the estimate wanders up to 52 deg/h on the
ground (docs/reference/autopilots 9.3.1). 72 deg/h for 25 s turn the heading by 0.5 deg, less than a compass error."""

_AHRS: Final[int] = mavlink.MAVLINK_MSG_ID_AHRS
_AHRS_RATE_HZ: Final = 4.0
_AHRS_MEAN_S: Final = 2.0
_OLDEST_S: Final = 10.0
_FIRST_WITHIN_S: Final = 1.5
_ASKS: Final = 3
_AHRS_LOOK_S: Final = 0.25


class EkfWatch:
    """Requests ArduPilot's AHRS message while the EKF's gyro bias is wanted, and averages the bias over 2 s."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._seen: deque[tuple[float, float, float, float]] = deque(maxlen=2048)
        self._arrived = asyncio.Event()
        self._asked = False
        vehicle.hear(mavlink.MAVLink_ahrs_message, self._on_ahrs)

    async def bias_rad_s(self) -> float | None:
        """Return the EKF's gyro bias, largest axis, averaged over up to 2 s; None: the autopilot reports none."""
        for _ in range(_ASKS):
            if (found := self._mean(0.0)) is not None:
                return found
            self._ask()
            self._arrived.clear()
            await comes(self._arrived, _FIRST_WITHIN_S)
        return self._mean(0.0)

    async def settle(self, within_s: float, go_on: Callable[[str], None]) -> str | None:
        """Wait until the EKF's bias has settled and return None, or return a warning for the pilot if it has not.

        The wait ends early when the autopilot arms or restarts. `go_on` gets the progress; its errors end the wait.
        """
        loop = asyncio.get_running_loop()
        self._seen.clear()  # values from before the write do not count
        boots, give_up_s = self._vehicle.boots, loop.time() + within_s
        if await self.bias_rad_s() is None and self._vehicle.boots == boots:
            return message("ekf_not_settled", bias=_words(None))
        asked_s = loop.time()
        while True:
            if self._vehicle.boots != boots:
                return message("autopilot_restarted_meanwhile", autopilot="the autopilot", doing="its EKF settled")
            bias = self._mean(_AHRS_MEAN_S)
            if bias is not None and bias <= SETTLED_RAD_S:
                return None
            if self._vehicle.arm_state is ArmState.ARMED:
                return message("heading_may_turn", bias=_words(bias))
            if loop.time() >= give_up_s:
                return message("ekf_not_settled", bias=_words(bias))
            go_on(message("ekf_settling", seconds=f"{give_up_s - loop.time():.0f}"))
            silent_s = loop.time() - (self._seen[-1][0] if self._seen else asked_s)
            if min(silent_s, loop.time() - asked_s) > _FIRST_WITHIN_S:
                asked_s = loop.time()
                self._ask()
            await asyncio.sleep(_AHRS_LOOK_S)

    def stop(self) -> None:
        if self._asked and self._vehicle.alive:
            self._asked = False
            # 0: the firmware's own rate.
            self._vehicle.commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, _AHRS, 0.0)

    def _ask(self) -> None:
        self._asked = True
        self._vehicle.commands.request_message_interval(_AHRS, _AHRS_RATE_HZ)

    def _mean(self, at_least_s: float) -> float | None:
        """Average the last 2 s of readings (longer on a busy line), largest axis; None: too few readings."""
        now_s = asyncio.get_running_loop().time()
        taken: list[tuple[float, float, float, float]] = []
        for each in reversed(self._seen):
            if taken and (now_s - each[0] > _OLDEST_S or taken[0][0] - taken[-1][0] >= _AHRS_MEAN_S):
                break
            taken.append(each)
        if not taken or now_s - taken[0][0] > _OLDEST_S or taken[0][0] - taken[-1][0] < at_least_s:
            return None
        return float(np.max(np.abs(np.mean([each[1:] for each in taken], axis=0))))

    def _on_ahrs(self, message: mavlink.MAVLink_ahrs_message, t_s: float) -> None:
        rates = (message.omegaIx, message.omegaIy, message.omegaIz)
        if all(map(math.isfinite, rates)):
            self._seen.append((t_s, *rates))
            self._arrived.set()


def _words(bias_rad_s: float | None) -> str:
    return "bias unknown" if bias_rad_s is None else f"{bias_rad_s / DEG:.2f} deg/s"


HEADING_SIGMA_DEG: Final = 10.0
"""Sigma of the yaw if an autopilot's compass agrees with its gyros; near iron, or badly calibrated, it is larger."""
_RATE_HZ: Final = 1.0
_STEADY_DEG: Final = 2.0  # largest turn of yaw in `_STEADY_S` at rest; more means that the estimator has not settled
_STEADY_S: Final = 5.0
_UP_RATE_HZ: Final = 5.0
_UP_LEAST: Final = 4
_UP_LEAST_S: Final = 1.0
_UP_LOOK_S: Final = 0.2
_OLD_S: Final = 5.0
_MAGNETOMETER: Final[int] = mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG


class OwnCompass:
    """Health of the autopilot's own magnetometer, and its agreement with the estimator's yaw."""

    def __init__(self, vehicle: Vehicle, *, wanted: bool) -> None:
        self._has_compass_s = self._agrees_s = -math.inf
        rate_hz = _RATE_HZ if wanted else None
        vehicle.hear(mavlink.MAVLink_sys_status_message, self._on_status, rate_hz)
        self._vehicle = vehicle
        for firmware in FIRMWARES:
            if firmware.estimator_message is not None:
                vehicle.hear(firmware.estimator_message, self._on_estimator, rate_hz, firmware.name)

    def agrees(self, now_s: float) -> bool:
        return min(self._has_compass_s, self._agrees_s) >= now_s - _OLD_S

    def _on_status(self, message: mavlink.MAVLink_sys_status_message, t_s: float) -> None:
        fit = (
            message.onboard_control_sensors_present
            & message.onboard_control_sensors_enabled
            & message.onboard_control_sensors_health
            & _MAGNETOMETER
        )
        self._has_compass_s = t_s if fit else -math.inf

    def _on_estimator(self, message: Message, t_s: float) -> None:
        if isinstance(message, self._vehicle.kind.estimator_message or ()):
            self._agrees_s = t_s if 0.0 < self._vehicle.kind.compass_ratio(message) < 1.0 else -math.inf


class OwnAttitude:
    """Attitude reported by the autopilot; `wanted`: keep requesting the messages that the heading needs."""

    def __init__(self, vehicle: Vehicle, *, wanted: bool) -> None:
        self._vehicle, self._wanted = vehicle, wanted
        self._seen: deque[tuple[float, float, float, float]] = deque(maxlen=256)
        self._compass = OwnCompass(vehicle, wanted=wanted)
        vehicle.hear(mavlink.MAVLink_attitude_message, self._on_attitude, _RATE_HZ if wanted else None)

    def heading(self) -> OwnHeading | None:
        """Return the autopilot's yaw from true north; None while the yaw is not trustworthy."""
        now_s = asyncio.get_running_loop().time()
        seen = self._since(now_s - _STEADY_S)
        if len(seen) < 2 or not self._compass.agrees(now_s):
            return None
        last = seen[-1][3]
        turned = [math.remainder(yaw - last, 2.0 * math.pi) for _, _, _, yaw in seen]
        if max(turned) - min(turned) > _STEADY_DEG * DEG:
            return None
        # Without a position the autopilot does not know the declination.
        north_deg = 0.0 if self._vehicle.place.position is not None else UNKNOWN_DECLINATION_SIGMA_DEG
        return OwnHeading((last + sum(turned) / len(turned)) / DEG % 360.0, math.hypot(HEADING_SIGMA_DEG, north_deg))

    @contextlib.contextmanager
    def asked(self) -> Iterator[None]:
        commands, message_id = self._vehicle.commands, int(mavlink.MAVLINK_MSG_ID_ATTITUDE)
        commands.request_message_interval(message_id, _UP_RATE_HZ)
        try:
            yield
        finally:
            # 0: the firmware's own rate.
            interval_us = 1e6 / _RATE_HZ if self._wanted else 0.0
            commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)

    def up(self, since_s: float) -> Array | None:
        """Return the mean up vector since a time, (3,), vehicle FRD axes; None: less than a second of data."""
        seen = self._since(since_s)
        if len(seen) < _UP_LEAST or seen[-1][0] - seen[0][0] < _UP_LEAST_S:
            return None
        ups = [body_from_ned(roll, pitch, 0.0) @ (0.0, 0.0, -1.0) for _, roll, pitch, _ in seen]
        return np.asarray(np.mean(ups, axis=0))

    async def up_since(self, since_s: float) -> Array | None:
        """Wait a few seconds for the result of `up`; None: too few attitude messages arrive."""
        loop = asyncio.get_running_loop()
        give_up_s = loop.time() + _OLD_S
        while (found := self.up(since_s)) is None and loop.time() < give_up_s:
            await asyncio.sleep(_UP_LOOK_S)
        return found

    def _since(self, t_s: float) -> list[tuple[float, float, float, float]]:
        return [one for one in self._seen if one[0] >= t_s]

    def _on_attitude(self, message: mavlink.MAVLink_attitude_message, t_s: float) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        if all(map(math.isfinite, angles)):
            self._seen.append((t_s, *angles))
