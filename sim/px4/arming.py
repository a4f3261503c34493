"""PX4's checks before arming and their reports; its request for authorisation.

Facts: PX4 `HealthAndArmingChecks`, `ArmAuthorization.cpp`, `mavlink_command_sender.cpp` (2026-08), autopilots 4.4, 5.2,
9.2, and runs of the firmware.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.px4.board import PX4Board
from sim.px4.calibration import Kind, find_slot
from sim.px4.port import PX4Port

WATCH_S = 0.5
REPORT_EVERY_S = 2.0
NOT_AUTHORIZED = ""
"""Name of the failure for which the autopilot has no text of its own."""
_SENSORS: tuple[tuple[Kind, str], ...] = (("ACC", "Accel"), ("GYRO", "Gyro"))
_BIAS_ALARM = 0.75
"""Alarm threshold of a bias, as a share of the estimator's limit."""


class Checks:
    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self._reported: list[str] = []
        self._reported_s = -math.inf

    def restart(self) -> None:
        """Handle a boot: from now on the checks run by themselves."""
        self._reported, self._reported_s = [], -math.inf
        self._double.later(WATCH_S, self._watch)

    def failures(self, loop_s: float) -> list[str]:
        """Return the failures in the firmware's words without the prefix; the authorisation is not included."""
        double, store = self._double, self._double.parameters
        t_s = double.aircraft.time_at(loop_s)
        found = [
            f"{words} {imu.index} uncalibrated"
            for imu in double.vehicle_imus
            for kind, words in _SENSORS
            if find_slot(store, kind, imu.device_id) is None
        ]
        first, *others = (imu.corrected(t_s) for imu in double.vehicle_imus)
        for number, output in enumerate(others, 1):
            if np.linalg.norm(output[3:] - first[3:]) > store["COM_ARM_IMU_ACC"]:
                found.append(f"Accel {number} inconsistent - check cal")
            if np.linalg.norm(output[:3] - first[:3]) > store["COM_ARM_IMU_GYR"]:
                found.append(f"Gyro {number} inconsistent - check cal")
        double.update_estimators(loop_s)
        estimator = double.vehicle_imus[0].estimator
        if np.abs(estimator.accel_bias_m_s2).max() > _BIAS_ALARM * store["EKF2_ABL_LIM"]:
            found.append("High Accelerometer Bias")
        if np.abs(estimator.gyro_bias_rad_s).max() > _BIAS_ALARM * store["EKF2_GYR_B_LIM"]:
            found.append("High Gyro Bias")
        if store["COM_ARMABLE"] < 1:
            found.append("Vehicle is in safety configuration")
        return found

    def report(self, failures: list[str], now_s: float) -> bool:
        """Report failures that differ from the last report, if that report is 2 s old; return True if reported.

        For a report, the real firmware runs all checks again; during an arm request, it requests authorisation again.
        """
        if failures == self._reported or now_s < self._reported_s + REPORT_EVERY_S:
            return False
        self._reported, self._reported_s = failures, now_s
        for failure in filter(None, failures):
            self._double.say(mavlink.MAV_SEVERITY_CRITICAL, f"Preflight Fail: {failure}")
        return True

    def _watch(self) -> None:
        now_s = self._double.now_s()
        self._double.later(WATCH_S, self._watch)
        if not self._double.armed and not self._double.commander.blocked:
            self.report(self.failures(now_s), now_s)


REQUEST = mavlink.MAV_CMD_ARM_AUTHORIZATION_REQUEST
RETRY_S, RETRIES = 0.5, 3
ANY_COMPONENT = 0
_DENIALS = {
    2: "Arm auth: Denied, waypoint {} have a invalid value",
    3: "Arm auth: Denied by timeout in authorizer",
    4: "Arm auth: Denied because airspace is in use",
    5: "Arm auth: Denied because of bad weather",
}
_TELLS_NOTHING = 1
Verdict = Callable[[bool], None]


@dataclass(slots=True)
class Request:
    """One COMMAND_LONG 3001 and its repetitions."""

    target_system: int
    rounds: int = 0
    """Number of half seconds since the request was sent."""
    answered: bool = False


class ArmAuthorization:
    """State of the arming authorisation, for the checks before arming."""

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self.requests = 0
        """Requests sent since the start, without repetitions."""
        self.restart()

    def restart(self) -> None:
        self._state: Literal["idle", "waiting", "approved"] = "idle"
        self._until_s = 0.0
        self._verdict: Verdict | None = None
        self._open: list[Request] = []
        self._question = 0

    @property
    def required(self) -> bool:
        """True if the autopilot requires authorisation (COM_ARM_AUTH_REQ)."""
        return bool(self._double.parameters["COM_ARM_AUTH_REQ"])

    def check(self, verdict: Verdict) -> None:
        """Check the authorisation: at once in the two-step method, otherwise at the answer or the timeout."""
        double, now_s = self._double, self._double.now_s()
        if self._state == "approved" and now_s > self._until_s:
            self._state = "idle"
        if self._state != "idle":
            verdict(self._state == "approved")
            return
        self._state = "waiting"
        self._question += 1
        question = self._question
        timeout_s = float(double.parameters["COM_ARM_AUTH_TO"])
        self._until_s = now_s + timeout_s
        double.later(timeout_s, lambda: self._time_out(question))
        two_steps = double.parameters["COM_ARM_AUTH_MET"] == 1
        self._verdict = None if two_steps else verdict
        self._send(int(double.parameters["COM_ARM_AUTH_ID"]))
        if two_steps:
            double.say(mavlink.MAV_SEVERITY_INFO, "Arm auth: Requesting authorization...")
            verdict(False)  # noqa: FBT003 - the verdict's only argument

    def acknowledged(self, message: mavlink.MAVLink_command_ack_message) -> None:
        """Handle a COMMAND_ACK addressed to this component or to all; an answer of any sender counts."""
        if message.command != REQUEST:
            return
        for request in self._open:
            if request.target_system == message.get_srcSystem():
                request.answered = True  # the oldest that is still kept, though it may have been answered before
                break
        if self._state != "waiting" or message.target_system != self._double.system_id:
            return
        double, result = self._double, message.result
        if result == mavlink.MAV_RESULT_IN_PROGRESS:
            return  # the time-out goes on
        if result == mavlink.MAV_RESULT_ACCEPTED:
            seconds = message.result_param2
            double.say(mavlink.MAV_SEVERITY_INFO, f"Arm auth: Authorized for the next {seconds} seconds")
            self._until_s = double.now_s() + seconds
            self._finish(approved=True)
            return
        if result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED:
            double.say(mavlink.MAV_SEVERITY_CRITICAL, "Arm auth: Temporarily rejected")
        elif message.progress != _TELLS_NOTHING:
            text = _DENIALS.get(message.progress, "Arm auth: Denied")
            double.say(mavlink.MAV_SEVERITY_CRITICAL, text.format(message.result_param2))
        self._finish(approved=False)

    def _time_out(self, question: int) -> None:
        if self._state == "waiting" and question == self._question:
            self._double.say(mavlink.MAV_SEVERITY_CRITICAL, "Arm auth: No response")
            self._finish(approved=False)

    def _finish(self, *, approved: bool) -> None:
        self._state = "approved" if approved else "idle"
        verdict, self._verdict = self._verdict, None
        if verdict is not None:
            verdict(approved)

    def _send(self, target_system: int) -> None:
        self.requests += 1
        request = Request(target_system)
        self._open.append(request)
        for port in self._double.ports:
            self._transmit(request, port, 0)
        self._double.later(RETRY_S, lambda: self._retry(request))
        if target_system == self._double.system_id:
            self._double.commander.receives_own_request(REQUEST)

    def _transmit(self, request: Request, port: PX4Port, confirmation: int) -> None:
        if confirmation <= RETRIES:
            self._double.answer(
                port,
                mavlink.MAVLink_command_long_message(
                    request.target_system, ANY_COMPONENT, REQUEST, confirmation, 0, 0, 0, 0, 0, 0, 0
                ),
            )

    def _retry(self, request: Request) -> None:
        """Repeat a request every half second: the first port begins each repetition, the other follows 0.5 s later."""
        if request.answered or request.rounds > RETRIES:
            self._open.remove(request)
            return
        companion, ground = self._double.ports
        if request.rounds:
            self._transmit(request, companion, request.rounds)
        request.rounds += 1
        self._transmit(request, ground, request.rounds)
        self._double.later(RETRY_S, lambda: self._retry(request))
