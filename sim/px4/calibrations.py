"""PX4's own calibrations on command, with what they assume (autopilots 4.6, 9.3.2; PX4 `src/modules/commander`).

The command is acknowledged at the start; what came of it is only said in texts. None of them takes the Earth's rotation
out; the gyro calibration changes nothing below the threshold of 0.01 rad/s; the quick accelerometer calibration
compares with the estimator's attitude, which the same accelerometer made; the level calibration takes the aircraft for
level.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2, Array, angles_of, body_from_ned
from sim.px4.board import Board
from sim.px4.calibration import SensorCalibration
from sim.px4.vehicle_imu import VehicleImu

GYRO_TIME_S = 1.07
GYRO_TRIES = 20
LEVEL_TIME_S = 0.5
LINGERS_S = 0.6
"""Busy for so long after the last text, so that it gets through."""
QUICK_TIME_S = 0.01
_QUEUE = 8
"""Samples of an accelerometer that wait in its queue: all that the quick calibration averages."""
_MAX_ANGLE = 0.8
_INFO, _CRITICAL = mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_CRITICAL


class Calibrations:
    """The commander's worker: one job at a time."""

    def __init__(self, double: Board) -> None:
        self._double = double
        self.busy = False

    def restart(self) -> None:
        """A boot."""
        self.busy = False

    def gyros(self) -> None:
        """param1 = 1: mean of 250 samples of each gyro."""
        self._begin("gyro")
        for percent in range(0, 101, 10):
            self._double.later(percent / 100.0 * 0.99, functools.partial(self._progress, percent))
        self._double.later(GYRO_TIME_S, lambda: self._finish_gyros(1))

    def quick_accel(self) -> None:
        """param5 = 4: without a word."""
        self._occupy()
        self._double.later(QUICK_TIME_S, self._finish_quick)

    def level(self) -> None:
        """param5 = 2: the attitude of half a second becomes the board's offset."""
        self._begin("level")
        for percent in range(0, 101, 20):
            self._double.later(percent / 100.0 * LEVEL_TIME_S, functools.partial(self._progress, percent))
        self._double.later(LEVEL_TIME_S + 0.01, lambda: self._finish_level(1))

    def six_sides(self) -> None:
        """param5 = 1: nobody turns this aircraft over, so it fails."""
        self._begin("accel")
        self._double.later(LEVEL_TIME_S, lambda: self._end(_CRITICAL, "failed: accel"))

    def _occupy(self) -> None:
        self.busy = self._double.calibrating = True

    def _begin(self, what: str) -> None:
        self._occupy()
        self._double.say(_INFO, f"[cal] calibration started: 2 {what}")

    def _progress(self, percent: int) -> None:
        self._double.say(_INFO, f"[cal] progress <{percent}>")

    def _end(self, severity: int, words: str) -> None:
        self._double.say(severity, f"[cal] calibration {words}")
        self._double.later(LINGERS_S, self._free)

    def _free(self) -> None:
        self.busy = self._double.calibrating = False

    def _still(self, over_s: float) -> bool:
        t_s = self._double.aircraft.time_at(self._double.now_s())
        return self._double.aircraft.still_at(t_s) and self._double.aircraft.still_at(t_s - over_s)

    def _mean(self, imu: VehicleImu, over_s: float) -> Array:
        """Raw mean (6) over the time that ends now, with its white noise."""
        t_s = self._double.aircraft.time_at(self._double.now_s())
        mean: Array = imu.model.expected_block(np.linspace(t_s - over_s, t_s, 21)[1:]).mean(axis=0)
        return mean + self._double.random.standard_normal(6) * imu.density / math.sqrt(over_s)

    def _finish_gyros(self, tries: int) -> None:
        double = self._double
        if not self._still(GYRO_TIME_S):
            double.say(_CRITICAL, "motion, retrying..")
            if tries < GYRO_TRIES:
                double.later(GYRO_TIME_S, lambda: self._finish_gyros(tries + 1))
            else:
                double.say(_CRITICAL, "ERROR: Motion during calibration")
                self._end(_CRITICAL, "failed: gyro")
            return
        for imu in double.vehicle_imus:
            own = SensorCalibration("GYRO", imu.device_id, double.parameters, external=imu.external)
            own.set_offset(self._mean(imu, 1.0)[:3])
            own.save(imu.index)
        double.parameters_changed()
        self._end(_INFO, "done: gyro")

    def _finish_quick(self) -> None:
        double = self._double
        roll, pitch, yaw = double.estimated_angles_rad(double.now_s())
        expected = body_from_ned(roll, pitch, yaw) @ np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
        for imu in double.vehicle_imus:
            mean = self._mean(imu, _QUEUE * imu.interval_s)[3:]
            length = float(np.linalg.norm(mean))
            cosine = float(mean @ expected) / (length * STANDARD_GRAVITY_M_S2)
            near = math.degrees(math.acos(min(1.0, cosine))) <= 10.0
            offset = mean - (expected if near else mean / length * STANDARD_GRAVITY_M_S2)
            own = SensorCalibration("ACC", imu.device_id, double.parameters, external=imu.external)
            own.set_offset(offset)
            own.save(imu.index)
        double.parameters_changed()
        self._free()

    def _finish_level(self, tries: int) -> None:
        double, store = self._double, self._double.parameters
        again: Callable[[], None] = lambda: self._finish_level(tries + 1)  # noqa: E731
        if not self._still(LEVEL_TIME_S):
            if tries < 50:
                double.later(LEVEL_TIME_S, again)
            else:
                double.say(_CRITICAL, "motion during calibration")
                self._end(_CRITICAL, "failed: level")
            return
        roll, pitch, _ = double.estimated_angles_rad(double.now_s())
        old_x, old_y = (math.radians(store[f"SENS_BOARD_{axis}_OFF"]) for axis in "XY")
        turned = body_from_ned(old_x, old_y, 0.0).T @ body_from_ned(roll, pitch, 0.0).T
        roll, pitch, _ = angles_of(turned.T)
        if max(abs(roll), abs(pitch)) > _MAX_ANGLE:
            double.say(_CRITICAL, "excess roll angle" if abs(roll) > _MAX_ANGLE else "excess pitch angle")
            self._end(_CRITICAL, "failed: level")
            return
        store.set("SENS_BOARD_X_OFF", math.degrees(roll))
        store.set("SENS_BOARD_Y_OFF", math.degrees(pitch))
        double.parameters_changed()
        self._end(_INFO, "done: level")
