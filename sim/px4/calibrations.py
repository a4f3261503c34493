"""PX4's own gyro calibration on command (autopilots 4.6, 9.3.2; PX4 `src/modules/commander`).

The command is acknowledged at the start; what came of it is only said in texts. It does not take the Earth's rotation
out, and changes nothing below the threshold of 0.01 rad/s.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array
from sim.px4.board import Board
from sim.px4.calibration import SensorCalibration
from sim.px4.vehicle_imu import VehicleImu

GYRO_TIME_S = 1.07
GYRO_TRIES = 20
LINGERS_S = 0.6
"""Busy for so long after the last text, so that it gets through."""
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
