"""Commands that the double handles, with ArduPilot's results; it answers all others with UNSUPPORTED."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.ardupilot.board import ArduPilotBoard
from sim.ardupilot.inertial import AVERAGED_S, GYRO_GIVES_UP_S, GYRO_TIME_S
from sim.ardupilot.messages import BUILDERS, version_message
from sim.ardupilot.parameters import Version, compass_names, since
from sim.earth import body_from_ned
from sim.firmware.channel import Command
from sim.firmware.compass import soft_matrix

ACCEPTED, DENIED, UNSUPPORTED, FAILED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_DENIED,
    mavlink.MAV_RESULT_UNSUPPORTED,
    mavlink.MAV_RESULT_FAILED,
)
ACK_DELAY_S = 0.003
REBOOT_DELAY_S = 0.7
"""Delay from the acknowledgement of a reboot command to the restart; until then the autopilot runs normally."""
_FORCE_ARM: dict[float, Version] = {2989.0: "4.3", 21196.0: "4.6"}
"""Magic numbers that force arming, each with the first firmware version that accepts it."""


class CommandServer:
    """Carries out commands; a handler returns the result, or None if the acknowledgement comes later."""

    def __init__(self, double: ArduPilotBoard) -> None:
        self._double = double
        self._handlers: dict[int, Callable[[Command], int | None]] = {
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_message_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
            mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: self._calibrate,
            mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            mavlink.MAV_CMD_RUN_PREARM_CHECKS: self._run_prearm_checks,
            mavlink.MAV_CMD_SET_EKF_SOURCE_SET: self._set_source_set,
            mavlink.MAV_CMD_FIXED_MAG_CAL_YAW: self._fix_compass_yaw,
        }

    def handle(self, command: Command) -> None:
        handler = self._handlers.get(command.number)
        result = UNSUPPORTED if handler is None else handler(command)
        if result is not None:
            self._acknowledge(command, result)

    def _acknowledge(self, command: Command, result: int, *, delay_s: float = ACK_DELAY_S) -> None:
        answer = mavlink.MAVLink_command_ack_message(
            command.number, result, 0, 0, command.system_id, command.component_id
        )
        self._double.soon(delay_s, lambda: self._double.answer(command.channel, answer))

    def _known(self, message_id: int) -> bool:
        if message_id == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU and not self._double.has_highres_imu:
            return False
        return message_id in BUILDERS

    def _set_message_interval(self, command: Command) -> int:
        double = self._double
        message_id, interval_us, where = int(command.params[0]), command.params[1], command.params[2]
        if not self._known(message_id):
            double.say(mavlink.MAV_SEVERITY_INFO, f"No ap_message for mavlink id ({message_id})")
            return DENIED
        if where != 0.0 or not math.isfinite(interval_us):
            return DENIED
        if interval_us in (0.0, -1.0):
            is_heartbeat = message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
            default = 1.0 if is_heartbeat and interval_us == 0.0 else None
            command.channel.set_stream(message_id, default, command.loop_s)
            return ACCEPTED
        if interval_us < 0.0:
            return DENIED
        interval_ms = int(interval_us / 1000.0)
        fastest_ms = double.fastest_interval_ms
        if interval_ms < fastest_ms:
            if since(double.version, "4.6"):
                double.say(
                    mavlink.MAV_SEVERITY_INFO,
                    f"Requested rate for message ID {message_id} too fast. Increase SCHED_LOOP_RATE",
                )
                return DENIED
            interval_ms = fastest_ms
        command.channel.set_stream(message_id, min(interval_ms, 60000) / 1000.0, command.loop_s)
        double.wake()
        return ACCEPTED

    def _request_message(self, command: Command) -> int:
        message_id = int(command.params[0])
        if not self._known(message_id):
            return FAILED
        message = BUILDERS[message_id](self._double, command.loop_s)
        if message is not None:
            self._double.answer(command.channel, message)
        return ACCEPTED

    def _request_capabilities(self, command: Command) -> int:
        if command.params[0] != 1.0:
            return FAILED
        self._double.answer(command.channel, version_message(self._double, command.loop_s))
        return ACCEPTED

    def _reboot(self, command: Command) -> int:
        if command.params[0] not in (1.0, 3.0):
            return UNSUPPORTED
        if self._double.armed:
            return FAILED
        self._double.later(REBOOT_DELAY_S, self._double.reboot)
        return ACCEPTED

    def _arm(self, command: Command) -> int:
        double = self._double
        if command.params[0] == 0.0:
            double.disarm()
            return ACCEPTED
        if command.params[0] != 1.0:
            return UNSUPPORTED
        word = _FORCE_ARM.get(command.params[1])
        forced = word is not None and since(double.version, word)
        failures = [] if forced else double.prearm_failures(command.loop_s)
        for failure in failures:
            double.say(mavlink.MAV_SEVERITY_CRITICAL, f"Arm: {failure}")
        if failures or double.calibrating:
            return FAILED
        double.arm()
        return ACCEPTED

    def _set_source_set(self, command: Command) -> int:
        if command.params[0] not in (1.0, 2.0, 3.0):
            return DENIED
        self._double.external_nav.choose(int(command.params[0]))
        return ACCEPTED

    def _fix_compass_yaw(self, command: Command) -> int:
        """Set offsets by the Earth's field at this yaw and the estimated tilt, armed or not (`mag_cal_fixed_yaw`)."""
        double, mask, t_s = self._double, int(command.params[1]), self._double.aircraft.time_at(command.loop_s)
        roll, pitch, _ = double.estimated_angles_rad(command.loop_s)
        body = body_from_ned(roll, pitch, math.radians(command.params[0]))
        for priority, (_, slot) in enumerate(double.compass_slots):
            in_use = double.parameters.effective[f"COMPASS_USE{priority + 1 if priority else ''}"]
            if not in_use or (mask and not mask >> priority & 1):
                continue
            offset, diagonal, beside = double.compass_correction(slot)
            uncorrected = np.linalg.solve(soft_matrix(diagonal, beside), double.compass_field(priority, t_s)) - offset
            new = 1e3 * body @ double.aircraft.site.field_ned_gauss - uncorrected
            for what, values in (("OFS", new.tolist()), ("DIA", (1.0, 1.0, 1.0)), ("ODI", (0.0, 0.0, 0.0))):
                names = compass_names(slot, what)
                for name, value in zip(names, values, strict=True):
                    double.parameters.set(name, value)
                double.announce(names)
        return ACCEPTED

    def _run_prearm_checks(self, command: Command) -> int:
        if self._double.armed:
            return mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        self.report_failures(command.loop_s)
        return ACCEPTED

    def report_failures(self, loop_s: float) -> None:
        for failure in self._double.prearm_failures(loop_s):
            self._double.say(mavlink.MAV_SEVERITY_CRITICAL, f"PreArm: {failure}")

    def _calibrate(self, command: Command) -> int | None:
        double = self._double
        gyros = command.params[0] == 1.0
        if double.armed:
            double.say(mavlink.MAV_SEVERITY_NOTICE, "Disarm to allow calibration")
            return FAILED
        if double.calibrating:
            if gyros and double.calibrations.gyros_ok:
                double.estimator.reset_gyro_bias()
                return ACCEPTED  # the real one says so too early, while offsets still read zero
            return FAILED
        if gyros:
            self._start_gyros(command)
            return None
        return UNSUPPORTED

    def _start_gyros(self, command: Command) -> None:
        double = self._double
        double.calibrating = True
        double.say(mavlink.MAV_SEVERITY_INFO, "Calibrating gyros")
        double.update_estimator(command.loop_s)
        double.calibrations.clear_gyros()
        if double.faults.reboot_while_calibrating:
            double.faults.reboot_while_calibrating = False
            double.later(GYRO_TIME_S / 2, double.reboot)
        double.later(GYRO_TIME_S, lambda: self._finish_gyros(command))

    def _finish_gyros(self, command: Command) -> None:
        double = self._double
        now_s = double.now_s()
        t_s = double.aircraft.time_at(now_s)
        still = double.aircraft.still_at(t_s) and double.aircraft.still_at(t_s - AVERAGED_S)
        still = still and not double.faults.gyro_calibration_fails
        if not still and now_s - command.loop_s < GYRO_GIVES_UP_S:
            double.later(0.25, lambda: self._finish_gyros(command))
            return
        double.announce(double.calibrations.gyros(t_s, converged=still))  # stored even when it has not converged
        double.calibrating = False
        if still:
            double.estimator.reset_gyro_bias()
        self._acknowledge(command, ACCEPTED if still else FAILED)
