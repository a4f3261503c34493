"""Readings of an aircraft's IMUs for a firmware that asks frame by frame.

Drawing noise sample by sample would cost more than everything else at 1000 frames a second, so readings are made some
20 ms ahead, at once. Therefore a motion must be added to the aircraft at least that long before it starts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.earth import Array
from sim.imu_model import ImuModel

BLOCK_S = 0.02
"""Time by which readings are made in advance."""
JUMP_S = 0.25
"""Lag of aircraft time behind the wall clock at which it jumps instead of running faster."""
_SLOWEST, _FASTEST = 0.8, 1.25
_BLOCKS_KEPT = 30_000


class Sample(NamedTuple):
    t_s: float
    """Aircraft time."""
    readings: tuple[list[float], ...]
    """Readings per IMU: three rates (rad/s) and three specific forces (m/s^2), in the sensor's axes."""
    angles_rad: tuple[float, float, float]
    """True roll, pitch, heading."""


class SampleBlocks:
    """Samples one frame apart, whose aircraft time follows the wall clock.

    A firmware's simulated time runs beside the wall clock, a little behind it on a busy machine; the serial devices of
    the same aircraft live on the wall clock. So that both see the same motions, aircraft time runs at 0.8 to 1.25 times
    the firmware's speed, and jumps when it is `JUMP_S` late. On a motionless aircraft none of this shows.
    """

    def __init__(self, aircraft: VirtualAircraft, imus: Sequence[ImuModel]) -> None:
        self._aircraft, self._imus = aircraft, tuple(imus)
        self._next_s: float | None = None
        self._samples: list[Sample] = []
        self._at = 0
        self.jumps = 0
        """Number of jumps, each because the machine was too slow."""
        self._track: deque[tuple[float, float]] = deque(maxlen=_BLOCKS_KEPT)
        self._own_s = 0.0

    def next(self, interval_s: float, now_s: float) -> Sample:
        """Return the next sample, `interval_s` (firmware time) after the last; `now_s` is aircraft time by the wall."""
        if self._at == len(self._samples):
            self._fill(interval_s, now_s)
        sample = self._samples[self._at]
        self._at += 1
        return sample

    def restart(self) -> None:
        """Drop the prepared samples: the firmware has started anew."""
        self._next_s, self._samples, self._at = None, [], 0
        self._track.clear()
        self._own_s = 0.0

    def aircraft_times(self, own_s: Array) -> Array:
        """Return aircraft times for instants of the firmware's clock since its start, in the last ten minutes."""
        own, aircraft = np.array([*self._track, (self._own_s, self._next_s)]).T
        times: Array = np.interp(own_s, own, aircraft)
        return times

    def _fill(self, interval_s: float, now_s: float) -> None:
        start_s = now_s if self._next_s is None else self._next_s
        late_s = now_s - start_s
        if late_s > JUMP_S:
            self.jumps += 1
            start_s, late_s = now_s, 0.0
        step_s = interval_s * min(max(1.0 + late_s, _SLOWEST), _FASTEST)
        count = max(1, round(BLOCK_S / interval_s))
        self._track.append((self._own_s, start_s))
        self._own_s += count * interval_s
        times: Array = start_s + step_s * np.arange(1, count + 1, dtype=np.float64)
        self._next_s = float(times[-1])
        # The noise of a reading belongs to the firmware's interval: that is what its filters average over.
        readings = [imu.read(times, interval_s).tolist() for imu in self._imus]
        first = np.array(self._aircraft.angles_rad(start_s))
        last = np.array(self._aircraft.angles_rad(self._next_s))
        shares = np.arange(1, count + 1)[:, None] / count
        angles = (first + (last - first) * shares).tolist()
        self._samples = [
            Sample(t_s, rows, (roll, pitch, heading))
            for t_s, rows, (roll, pitch, heading) in zip(
                times.tolist(), zip(*readings, strict=True), angles, strict=True
            )
        ]
        self._at = 0
