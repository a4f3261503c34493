"""Floats of one of PX4's IMUs: HIGHRES_IMU, whose bias SCALED_IMU tells (`calibration.means.pairs`).

Both messages carry the same sample now and then: always where they are sent as fast as the IMU gives, else whenever
their phases meet, for which their intervals must differ. HIGHRES_IMU says when the sample was taken, SCALED_IMU when it
was published, in whole milliseconds; that is one to two milliseconds later, and samples are 2.5 ms apart or more. That
this makes true pairs, and of this IMU, the integers themselves confirm or contradict.
"""

from __future__ import annotations

import functools
import math
from typing import Final

import numpy as np

from companion.autopilot.telemetry.imu_messages import MRAD, Reading, StreamKind
from companion.calibration.means.pairs import LEAST_PAIRS, BiasTrack, Grid
from companion.physics.frames import Floats
from companion.physics.units import MG

UNLIKE: Final = 1.03
"""How much faster HIGHRES_IMU is asked for, so that at any two phases the same sample is due for both soon."""

LEAST_HZ: Final = 50.0
"""Below that too few samples meet to tell more than the integers: at 25 Hz one in ten."""

BLOCK_S: Final = 0.5
_PAIRS: Final = 2 * LEAST_PAIRS
"""In a block; it lasts until there are so many."""
_LONGEST_BLOCK_S: Final = 6.0
_PUBLISHED_S: Final = 0.003
"""After a sample was taken, at most."""
_WHOLE_MS: Final = 0.001
_SILENT_S: Final = 1.0
_CALM_S: Final = 20.0
"""After b has stepped: it is some seconds until the estimator is settled again, and until then verifying what was
written goes on in integers."""
_STEPS: Final = np.array([MRAD] * 3 + [MG] * 3)


@functools.cache
def floats_kind(integers: StreamKind) -> StreamKind:
    """What the samples come from, where that is HIGHRES_IMU with the bias that these integers tell."""
    return StreamKind(f"HIGHRES_IMU+{integers.message}", gyro_step_rad_s=0.0, accel_step_m_s2=0.0, truncates=False)


class Pairing:
    """Pairs two messages, and takes the bias back out of the floats."""

    def __init__(self) -> None:
        self._track = BiasTrack()
        self._floats: list[tuple[float, ...]] = []
        self._integers: list[tuple[float, ...]] = []
        self._begun_s = self._paired_s = self._float_s = -math.inf
        self._calm_s = 0.0
        self._known = self._paused = False
        self._bias = np.zeros(6)
        self._variances: tuple[float, ...] = ()

    @property
    def known(self) -> bool:
        """Whether `corrected` is to be used."""
        return self._known and not self._paused

    def pause(self, *, paused: bool) -> None:
        """While offsets are written b does nothing but step, and for some time after."""
        self._paused = paused
        self.forget()
        self._calm_s = math.inf

    def set_lines(self, steps: Floats, anchor: Floats) -> None:
        """Say where the sensor's own steps lie in its output, (6,) rad/s and m/s^2; 0: they are fine, or not known."""
        self._track.grid = Grid(steps / _STEPS, anchor / _STEPS) if steps.any() else None

    def add_floats(self, reading: Reading) -> None:
        """Take a HIGHRES_IMU."""
        t_s = reading.t_device_s
        if -_SILENT_S < t_s - self._float_s <= 0.0:
            return  # repeated, or late
        if t_s < self._float_s:
            self.forget()
        self._float_s = t_s
        self._floats.append((t_s, *reading.gyro_rad_s, *reading.accel_m_s2))
        if t_s - self._begun_s >= BLOCK_S:
            self._pair(t_s)

    def add_integers(self, reading: Reading) -> None:
        """Take the integers' message."""
        if self._floats:
            self._integers.append((reading.t_device_s, *reading.gyro_rad_s, *reading.accel_m_s2))
        if reading.t_device_s - self._float_s > _SILENT_S:
            self.forget()

    def corrected(self, reading: Reading) -> tuple[Reading, tuple[float, ...]]:
        """What the IMU said before the bias was taken off, and the variances of that bias (6), SI units."""
        row = (np.array(reading.gyro_rad_s + reading.accel_m_s2) + self._bias).tolist()
        gyro, accel = (row[0], row[1], row[2]), (row[3], row[4], row[5])
        return Reading(reading.t_device_s, gyro, accel, None), self._variances

    def forget(self) -> None:
        """Start anew."""
        self._floats, self._integers, self._known = [], [], False
        self._float_s = self._begun_s = self._paired_s = -math.inf
        self._track.forget()

    def _pair(self, now_s: float) -> None:
        """Give the track the pairs of a block that has ended, if there are enough."""
        floats, integers = np.array(self._floats), np.array(self._integers).reshape(-1, 7)
        at = np.searchsorted(floats[:, 0], integers[:, 0] + _WHOLE_MS, side="left") - 1
        fits = (at > 0) & (integers[:, 0] - floats[np.maximum(at, 0), 0] < _PUBLISHED_S)
        if fits.sum() < _PAIRS:
            if now_s - self._begun_s <= _LONGEST_BLOCK_S:
                return
            if self._begun_s > -math.inf:
                self.forget()
            self._floats, self._integers, self._begun_s = self._floats[-1:], [], now_s
            return
        at, integers = at[fits], np.rint(integers[fits, 1:] / _STEPS).astype(np.int64)
        values, restarts = floats[:, 1:] / _STEPS, self._track.restarts
        seconds = now_s - self._paired_s if self._paired_s > -math.inf else BLOCK_S
        self._track.add(values[at], integers, values[at - 1], seconds)
        # The newest float may be of an integer that is still to come.
        self._floats, self._integers = self._floats[-2:], [row for row in self._integers if row[0] > floats[-1, 0]]
        self._begun_s = self._paired_s = now_s
        if self._track.restarts > restarts or math.isinf(self._calm_s):
            self._calm_s = now_s + _CALM_S
        self._known = self._track.known and now_s >= self._calm_s
        self._bias = self._track.bias * _STEPS
        self._variances = tuple((self._track.variance * np.square(_STEPS)).tolist())
