"""Other writers of offsets: the commanded gyro calibration, that in the background, and offsets learned in flight.

Autopilots 4.3, 4.6, 9.2, 9.3.2; PX4 `commander`, `GyroCalibration.cpp`, `VehicleIMU.cpp`, `EKF2.cpp` (2026-08). The
last two show only in the PARAM_VALUE that follows every change.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2, Array, body_from_ned
from sim.px4.board import PX4Board
from sim.px4.calibration import SensorCalibration
from sim.px4.vehicle_imu import VehicleImu

GYRO_TIME_S = 1.07
GYRO_TRIES = 20
LINGERS_S = 0.6
"""Time for which the calibration stays busy after the last text, so that the text gets through."""
_INFO, _CRITICAL = mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_CRITICAL


class CommandedCalibrations:
    """PX4's own calibrations on command: of the gyros, and of the compasses by a known heading.

    The command is acknowledged at the start; the result is only sent as texts. It does not subtract the Earth's
    rotation, and changes nothing below the threshold of 0.01 rad/s.
    """

    def __init__(self, double: PX4Board) -> None:
        self._double = double

    def gyros(self) -> None:
        """Calibrate with param1 = 1: mean of 250 samples of each gyro."""
        self._double.calibrating = True
        self._double.say(_INFO, "[cal] calibration started: 2 gyro")
        for percent in range(0, 101, 10):
            self._double.later(percent / 100.0 * 0.99, functools.partial(self._progress, percent))
        self._double.later(GYRO_TIME_S, lambda: self._finish_gyros(1))

    def compasses(self, yaw_rad: float) -> None:
        """Set offsets so that the field at this yaw and the estimated tilt is the Earth's; SCALE and ODIAG stay."""
        double, now_s = self._double, self._double.now_s()
        roll, pitch, _ = double.estimated_angles_rad(now_s)
        field = body_from_ned(roll, pitch, yaw_rad) @ double.aircraft.site.field_ned_gauss
        for index, own in enumerate(double.new_mags()):
            raw = 1e-3 * double.compass_reading(index, double.aircraft.time_at(now_s))
            own.set_offset(raw - np.linalg.solve(own.soft, own.rotation.T @ field))
            own.save(index)
        double.parameters_changed()
        double.say(_INFO, "Mag quick calibration finished")

    def _progress(self, percent: int) -> None:
        self._double.say(_INFO, f"[cal] progress <{percent}>")

    def _end(self, severity: int, words: str) -> None:
        self._double.say(severity, f"[cal] calibration {words}")
        self._double.later(LINGERS_S, self._free)

    def _free(self) -> None:
        self._double.calibrating = False

    def _still(self, over_s: float) -> bool:
        t_s = self._double.aircraft.time_at(self._double.now_s())
        return self._double.aircraft.still_at(t_s) and self._double.aircraft.still_at(t_s - over_s)

    def _mean(self, imu: VehicleImu, over_s: float) -> Array:
        """Return the raw mean (6) over the time that ends now, with its white noise."""
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


POLL_S = 0.5
SAMPLE_S = 0.02
"""Period of the samples of this calibration."""
QUIET_S = 5.0
MIN_COUNT = 100
MAX_VARIANCE = 0.001
MAX_MOVE_M_S2 = 0.5
MAX_KELVIN = 1.0
_SETTLES_S = 10.0
_QUIET_AFTER_CHANGE_S = 31.0
ACCEL_WORTH_M_S2, GYRO_WORTH_RAD_S = 0.05, 0.01


class BackgroundGyroCalibration:
    """IMU_GYRO_CAL_EN: runs from boot on; on a disarmed, motionless aircraft it replaces offsets that are far wrong."""

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self.running = False
        self.commits = 0
        """Number of times that offsets were written."""
        self._begin(0.0)

    def restart(self, loop_s: float) -> None:
        """Handle a boot: the parameter has an effect only now."""
        self.running = bool(self._double.parameters["IMU_GYRO_CAL_EN"])
        self._begin(loop_s)
        if self.running:
            self._double.later(POLL_S, self._poll)

    def parameters_updated(self, loop_s: float) -> None:
        """Read the parameters again and start again; nothing is written in the next 5 s."""
        for calibration in self._own:
            calibration.parameters_update()
        self._changed_s = loop_s
        self._reset(loop_s)

    def _begin(self, loop_s: float) -> None:
        store = self._double.parameters
        self._own = [
            SensorCalibration("GYRO", imu.device_id, store, external=imu.external) for imu in self._double.vehicle_imus
        ]
        self._changed_s = -math.inf
        self._reference: list[Array | None] = [None] * len(self._own)
        self._temperature = [math.nan] * len(self._own)
        self._reset(loop_s)

    def _reset(self, loop_s: float) -> None:
        self._since_s = self._until_s = loop_s
        self._samples: list[list[Array]] = [[] for _ in self._own]

    def _poll(self) -> None:
        double, now_s = self._double, self._double.now_s()
        double.later(POLL_S, self._poll)
        if double.armed or double.calibrating or not self._collect(now_s):
            self._reset(now_s)
            return
        if now_s - self._changed_s <= QUIET_S:
            return
        if len(self._samples[0]) * POLL_S / SAMPLE_S <= MIN_COUNT:
            return
        moments = [self._moments(samples) for samples in self._samples]
        if any(np.linalg.norm(variance) > MAX_VARIANCE for _, variance in moments):
            self._reset(now_s)
            return
        taken = False
        for own, (mean, variance) in zip(self._own, moments, strict=True):
            worth = bool(((mean - own.offset) ** 2 > variance).any()) or not own.calibrated
            taken |= worth and own.set_offset(mean)
        if taken:
            for index, own in enumerate(self._own):
                own.save(index)
            self.commits += 1
            double.parameters_changed()
            self._reset(now_s)

    def _collect(self, now_s: float) -> bool:
        """Collect samples since the last call; return False if something moved or warmed up."""
        double = self._double
        times = np.arange(self._until_s + SAMPLE_S, now_s + SAMPLE_S / 2.0, SAMPLE_S)
        self._until_s = now_s
        if not len(times):
            return True
        start_s, end_s = double.aircraft.time_at(float(times[0])), double.aircraft.time_at(now_s)
        for number, imu in enumerate(double.vehicle_imus):
            grid = np.linspace(start_s, end_s, len(times))
            noise = double.random.standard_normal((len(times), 6)) * (imu.density / math.sqrt(imu.interval_s))
            block = imu.model.expected_block(grid) + noise
            if not self._is_still(number, block[:, 3:], imu.model.temperature_degc(end_s)):
                return False
            mean = block[:, :3].mean(axis=0)
            self._samples[number].append(np.concatenate((mean, block[:, :3].var(axis=0))))
        return True

    def _is_still(self, number: int, force: Array, degc: float) -> bool:
        reference = self._reference[number]
        if reference is None or np.linalg.norm(force - reference, axis=1).max() > MAX_MOVE_M_S2:
            self._reference[number] = force[-1]
            return reference is None
        if not abs(degc - self._temperature[number]) <= MAX_KELVIN:
            first = math.isnan(self._temperature[number])
            self._temperature[number] = degc
            return first
        return bool(np.linalg.norm(force, axis=1).max() <= 1.3 * STANDARD_GRAVITY_M_S2)

    @staticmethod
    def _moments(parts: list[Array]) -> tuple[Array, Array]:
        """Return mean and variance of all samples from those of equally long sections."""
        table = np.array(parts)
        means, variances = table[:, :3], table[:, 3:]
        return means.mean(axis=0), variances.mean(axis=0) + means.var(axis=0)


class LearnedOffsets:
    """SENS_IMU_AUTOCAL: biases estimated while armed become the offsets at disarming.

    A sensor without a slot gets one in the same way on the ground.
    """

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self.commits = 0
        """Number of times that offsets were written."""
        self._quiet_until_s = -math.inf

    def restart(self) -> None:
        """Handle a boot: a sensor without a slot gets one as soon as its estimator has settled."""
        self._quiet_until_s = -math.inf
        self._double.later(_SETTLES_S + 1.0, self._claim)

    def calibration_changed(self, loop_s: float) -> None:
        """Handle a changed offset: nothing is learned for half a minute; then a sensor without a slot gets one."""
        self._quiet_until_s = loop_s + _QUIET_AFTER_CHANGE_S
        if not all(imu.calibrated for imu in self._double.vehicle_imus):
            self._double.later(_QUIET_AFTER_CHANGE_S + _SETTLES_S, self._claim)

    def disarmed(self, loop_s: float, armed_for_s: float) -> None:
        """Handle a disarm by the pilot."""
        if armed_for_s > 1.0:
            self._commit(loop_s, self._double.vehicle_imus)

    def _claim(self) -> None:
        if not self._double.armed:
            without = [imu for imu in self._double.vehicle_imus if not imu.calibrated]
            self._commit(self._double.now_s(), without)

    def _commit(self, loop_s: float, imus: Sequence[VehicleImu]) -> None:
        double = self._double
        if not double.parameters["SENS_IMU_AUTOCAL"] or loop_s <= self._quiet_until_s:
            return
        double.update_estimators(loop_s)
        t_s = double.aircraft.time_at(loop_s)
        written = [self._save(imu, t_s) for imu in imus]
        if any(written):
            self.commits += 1
            double.parameters_changed()

    def _save(self, imu: VehicleImu, t_s: float) -> bool:
        estimator, written = imu.estimator, False
        for own, bias, since_s, worth, forget in (
            (
                imu.accel,
                estimator.accel_bias_m_s2,
                estimator.accel_steady_since_s,
                ACCEL_WORTH_M_S2,
                estimator.forget_accel_bias,
            ),
            (
                imu.gyro,
                estimator.gyro_bias_rad_s,
                estimator.gyro_steady_since_s,
                GYRO_WORTH_RAD_S,
                estimator.forget_gyro_bias,
            ),
        ):
            if t_s - since_s < _SETTLES_S:
                continue
            learned = own.rotation.T @ bias / own.scale
            if (np.linalg.norm(learned) > worth or not own.calibrated) and own.set_offset(own.offset + learned):
                written |= own.save(imu.index)
                forget()
        return written
