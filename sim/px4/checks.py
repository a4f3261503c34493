"""The checks before arming, and when PX4 puts what they find into words: on a change, at most every 2 s.

Facts: PX4 `HealthAndArmingChecks` (2026-08), autopilots 4.4, 5.2, 9.2, and a run of the firmware.
"""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.px4.board import Board
from sim.px4.calibration import Kind, find_slot

WATCH_S = 0.5
REPORT_EVERY_S = 2.0
NOT_AUTHORIZED = ""
"""The failure that has no words of its own."""
_SENSORS: tuple[tuple[Kind, str], ...] = (("ACC", "Accel"), ("GYRO", "Gyro"))
_BIAS_ALARM = 0.75
"""Part of the estimator's limits."""


class Checks:
    """What stands against arming."""

    def __init__(self, double: Board) -> None:
        self._double = double
        self._reported: list[str] = []
        self._reported_s = -math.inf

    def restart(self) -> None:
        """A boot: from now on they run by themselves."""
        self._reported, self._reported_s = [], -math.inf
        self._double.later(WATCH_S, self._watch)

    def failures(self, loop_s: float) -> list[str]:
        """In the firmware's words without the prefix; the authorisation apart."""
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
        """Say them, if they are others than the last ones said and those are 2 s old; whether it did.

        The real one runs all its checks a second time for that, and in an arm request asks for authorisation again.
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
