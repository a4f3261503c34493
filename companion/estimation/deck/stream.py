"""One IMU on a platform that moves, beside the gradienter: what is kept of its seconds.

They must follow one another without a gap: a gyro that was not heard for a while has turned nobody knows how far.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import msgspec
import numpy as np

from companion.estimation.deck.fluid import Fluid, Level, level
from companion.estimation.deck.smoother import Passage, passage
from companion.estimation.means.pose import GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats

LONGEST_GAP_S: Final = 0.5
_SETTLED_LAGS: Final = 10.0
KEPT_SHOWN: Final = 4
"""Seconds that wait for the gradienter's readings."""


class ImuSecond(msgspec.Struct, frozen=True):
    """What is kept of one second of one IMU."""

    slot: int
    passage: Passage
    samples: int
    mean: Floats
    """(6,) of rates and forces in the sensor's axes."""
    variance: Floats
    temperature_degc: float | None
    white2: float
    """N^2 of the gyros, from second differences of neighbouring samples; the mean of the axes."""
    shared_variance: Floats = np.zeros(6)
    """As in `Batch`; (6,), the sensor's axes."""


class Stream:
    """One IMU's seconds without a gap."""

    def __init__(self, imu: ImuInput, gradienter: GradienterModel | None, keep: int) -> None:
        self.imu, self._gradienter = imu, gradienter
        self.seconds: deque[ImuSecond] = deque(maxlen=keep)
        self.levels: dict[int, Level] = {}
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self.seconds.clear()
        self.levels.clear()
        self._last: Floats | None = None
        self._shown: dict[int, tuple[Floats, Floats]] = {}
        self._fluid = None if self._gradienter is None else Fluid(self._gradienter)
        self._settled_s = math.inf

    def take(self, batch: Batch, times: Floats, rows: Floats) -> None:
        """One second of samples (n, 7): time, rates, forces, in the vehicle's axes."""
        own = np.column_stack([times, self._in_vehicle(rows)])
        last = self._last
        gap_s = max(float(np.diff(times).max(initial=0.0)), 0.0 if last is None else float(own[0, 0] - last[0]))
        if gap_s > LONGEST_GAP_S:
            self.clear()
            last = None
        self._last = own[-1]
        if self._fluid is not None:
            if last is None:
                self._settled_s = float(times[0]) + _SETTLED_LAGS * self._fluid.lag_s
            self._shown[batch.slot] = times, self._fluid.follow(times, own[:, 4:])
            while len(self._shown) > KEPT_SHOWN:
                del self._shown[next(iter(self._shown))]
        if last is None:
            return
        whole = np.vstack([last, own])
        rates = whole[:, 1:4]
        step_s = float(np.median(np.diff(whole[:, 0]).tolist()))
        second = rates[2:] - 2.0 * rates[1:-1] + rates[:-2]
        white2 = float(np.square(second).mean()) / 6.0 * step_s if len(second) else 0.0
        self.seconds.append(
            ImuSecond(
                slot=batch.slot,
                passage=passage(whole[:, 0], rates, whole[:, 4:]),
                samples=batch.n,
                mean=batch.mean,
                variance=batch.variance,
                temperature_degc=batch.temperature_degc,
                white2=white2,
                shared_variance=batch.shared_variance,
            )
        )
        while self.levels and next(iter(self.levels)) < self.seconds[0].slot:
            del self.levels[next(iter(self.levels))]

    def compare(self, slot: int, times: Floats, tilts: Floats) -> None:
        """What the gradienter said in a second."""
        shown = self._shown.get(slot)
        if shown is None or shown[0][0] < self._settled_s:
            return
        found = level(*shown, times, tilts)
        if found is not None:
            self.levels[slot] = found

    def _in_vehicle(self, rows: Floats) -> Floats:
        imu = self.imu
        if imu.truncates:
            # Toward zero: on a platform that moves by more than a step, half a step away is what was cut off.
            steps = np.repeat([imu.gyro_step_rad_s, imu.accel_step_m_s2], 3)
            rows = rows + np.sign(rows) * steps / 2.0
        return np.hstack([rows[:, :3] @ imu.rotation.T, rows[:, 3:] @ imu.rotation.T])
