"""PX4's commands and their results, and its requests to arm (autopilots 4.4, 4.6, 5.2, 9.2).

Facts: PX4 `mavlink_receiver.cpp`, `Commander.cpp`, `HealthAndArmingChecks` (2026-08) and runs of the firmware.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Command
from sim.px4.arming import NOT_AUTHORIZED, ArmAuthorization, Checks
from sim.px4.board import PX4Board
from sim.px4.messages import BUILDERS
from sim.px4.port import HEARTBEAT
from sim.px4.rivals import CommandedCalibrations

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    mavlink.MAV_RESULT_DENIED,
    mavlink.MAV_RESULT_UNSUPPORTED,
    mavlink.MAV_RESULT_FAILED,
)
ACK_DELAY_S = (0.003, 0.010)
REBOOT_DELAY_S = 0.4
DOWN_S = 3.0
QUEUE = 8
"""Maximum number of commands that wait while the commander waits for an authorisation; further ones are lost."""
_UNANSWERED = {
    mavlink.MAV_CMD_PREFLIGHT_SET_SENSOR_OFFSETS,
    mavlink.MAV_CMD_PREFLIGHT_UAVCAN,
    mavlink.MAV_CMD_DO_MOUNT_CONTROL,
    mavlink.MAV_CMD_DO_SET_ROI,
}
"""Commands of parts of the firmware that this double does not have: not acknowledged at all."""


class Commander:
    """Carries out commands; a handler returns the result, or None if the acknowledgement comes later or never."""

    def __init__(
        self,
        double: PX4Board,
        checks: Checks,
        calibrations: CommandedCalibrations,
        authorization: ArmAuthorization,
    ) -> None:
        self._double, self._checks, self._calibrations = double, checks, calibrations
        self._authorization = authorization
        self._at_the_port: dict[int, Callable[[Command], int | None]] = {
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_message_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
        }
        self._handlers: dict[int, Callable[[Command], int | None]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_or_disarm,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: self._run_prearm_checks,
            mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: self._calibrate,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            mavlink.MAV_CMD_FIXED_MAG_CAL_YAW: self._fix_compass_yaw,
        }
        self.restart()

    def restart(self) -> None:
        self.blocked = False
        """True: the commander waits for an authorisation, and does nothing else."""
        self._waiting: deque[Command | int] = deque(maxlen=QUEUE)

    def handle(self, command: Command) -> None:
        """Carry out a command and acknowledge; commands for the commander wait while it is blocked."""
        at_port = self._at_the_port.get(command.number)
        if at_port is not None:
            self._acknowledge(command, at_port(command))
        elif self.blocked:
            self._waiting.append(command)
        else:
            self._carry_out(command)

    def receives_own_request(self, number: int) -> None:
        """Answer a command that the autopilot sent to its own system id with UNSUPPORTED, addressed to nobody (0/0)."""
        if self.blocked:
            self._waiting.append(number)
        else:
            self._answer_self(number)

    def _carry_out(self, command: Command) -> None:
        if command.number not in _UNANSWERED:
            handler = self._handlers.get(command.number)
            self._acknowledge(command, UNSUPPORTED if handler is None else handler(command))

    def _answer_self(self, number: int) -> None:
        answer = mavlink.MAVLink_command_ack_message(number, UNSUPPORTED, 0, 0, 0, 0)
        for port in self._double.ports:
            if port.seen:
                self._double.answer(port, answer)

    def _acknowledge(self, command: Command, result: int | None) -> None:
        """Acknowledge on every port on which the requester was heard."""
        if result is None:
            return
        double, target = self._double, (command.system_id, command.component_id)
        answer = mavlink.MAVLink_command_ack_message(command.number, result, 0, 0, *target)

        def send() -> None:
            for port in double.ports:
                if port.has_seen(*target):
                    double.answer(port, answer)

        double.soon(float(double.random.uniform(*ACK_DELAY_S)), send, lane="acknowledgements")

    # What a port does itself.

    def _set_message_interval(self, command: Command) -> int:
        message_id, interval_us, *others = command.params
        port = command.channel
        number = int(message_id + 0.5) if math.isfinite(message_id) else 0
        used = [value for value in (others[0], others[1], others[4]) if math.isfinite(value) and int(value + 0.5)]
        if number == HEARTBEAT or used or number not in BUILDERS or math.isnan(interval_us):
            return FAILED
        interval_s: float | None = interval_us / 1e6
        if abs(interval_us) <= 1e-5:
            interval_s = 0.0
        elif interval_us < 0.0:
            interval_s = None
        port.set_stream(number, interval_s, command.loop_s)
        self._double.wake()
        return ACCEPTED

    def _request_message(self, command: Command) -> int:
        number = round(command.params[0]) if math.isfinite(command.params[0]) else 0
        message = self._double.build(number, command.loop_s) if number in BUILDERS else None
        if message is None:
            return DENIED
        self._double.answer(command.channel, message)
        return ACCEPTED

    # What the commander does.

    def _arm_or_disarm(self, command: Command) -> int | None:
        double, action = self._double, command.params[0]
        if action not in (0.0, 1.0):
            double.say(mavlink.MAV_SEVERITY_CRITICAL, f"Unsupported ARM_DISARM param: {action:.3f}\t")
            return None
        if action == 0.0:
            double.disarm()
            return ACCEPTED
        if double.armed:
            return ACCEPTED
        if double.calibrating:
            double.say(mavlink.MAV_SEVERITY_CRITICAL, "Arming denied: calibrating\t")
            return TEMPORARILY_REJECTED
        self.blocked = True
        self._check(lambda failures: self._first_check_done(command, failures))  # param2 = 21196 changes nothing
        return None

    def _check(self, done: Callable[[list[str]], None]) -> None:
        """Run all checks of an arm request; pass the failures on, with the authorisation as the last."""
        failures = self._checks.failures(self._double.now_s())
        authorization = self._authorization
        if authorization.required:
            authorization.check(lambda given: done(failures if given else [*failures, NOT_AUTHORIZED]))
        else:
            done(failures)

    def _first_check_done(self, command: Command, failures: list[str]) -> None:
        if failures and self._checks.report(failures, self._double.now_s()):
            # To put failures into words all checks run once more, and with them the question for authorisation.
            self._check(lambda again: self._arming_done(command, armed=not again))
        else:
            self._arming_done(command, armed=not failures)

    def _arming_done(self, command: Command, *, armed: bool) -> None:
        double = self._double
        if armed:
            double.arm()
        else:
            double.say(mavlink.MAV_SEVERITY_CRITICAL, "Arming denied: Resolve system health failures first\t")
        self._acknowledge(command, ACCEPTED if armed else TEMPORARILY_REJECTED)
        self.blocked = False
        while self._waiting and not self.blocked:
            waiting = self._waiting.popleft()
            if isinstance(waiting, int):
                self._answer_self(waiting)
            else:
                self._carry_out(waiting)

    def _run_prearm_checks(self, command: Command) -> int:
        for failure in self._checks.failures(command.loop_s):
            self._double.say(mavlink.MAV_SEVERITY_CRITICAL, f"Preflight Fail: {failure}")
        return ACCEPTED

    def _calibrate(self, command: Command) -> int:
        double = self._double
        if double.armed or double.calibrating:
            return TEMPORARILY_REJECTED
        if command.params[0] == 1.0:
            self._calibrations.gyros()
        elif command.params[3] != 0.0:
            return UNSUPPORTED
        return ACCEPTED

    def _fix_compass_yaw(self, command: Command) -> int:
        if self._double.armed or self._double.calibrating:
            return TEMPORARILY_REJECTED
        yaw_deg = round(command.params[0]) if math.isfinite(command.params[0]) else 0
        self._calibrations.compasses(math.radians(yaw_deg))
        return ACCEPTED

    def _reboot(self, command: Command) -> int:
        action = command.params[0]
        if action == 0.0:
            return ACCEPTED
        if action not in (1.0, 3.0) or self._double.armed:
            return DENIED
        self._double.later(REBOOT_DELAY_S, lambda: self._double.reboot(DOWN_S))
        return ACCEPTED
