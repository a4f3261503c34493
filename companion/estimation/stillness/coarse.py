"""Steps in a stream of floats: some logs round, some parts have few digits.

Where noise is smaller than a step, seconds without any change and seconds that toggle between two values are both
rest: neither is a stuck sensor or a motion.
"""

from __future__ import annotations

import math
from typing import Final

from companion.estimation.seconds.batch import Batch

_FEW: Final = 4
"""Levels in one second of a stream whose noise is of the size of its steps, at most."""
_TIMES_EACH: Final = 4
"""Readings a level, at least: few samples are never the same, and no steps."""
_ENOUGH: Final = 3
"""Seconds of few levels with the same step: one in which a stream freezes may look like that too."""
_ROUNDED: Final = 0.05
"""Of a step: the last digit of a log in other units."""
STUCK_S: Final = 60
"""A stream with steps may show one value for so long; then it is stuck."""


class Steps:
    """The steps of one IMU's six channels, and when each triad last changed in steps.

    `told` are those of a stream of integers; 0 where nobody knows.
    """

    def __init__(self, told: list[float]) -> None:
        self.told = told
        self._seen = [math.inf] * len(told)
        self._times = [0] * len(told)
        self._changed = [-math.inf, -math.inf]

    @property
    def sizes(self) -> list[float]:
        """What is told, or was seen; 0 where there is none."""
        return [
            told or (seen if times >= _ENOUGH else 0.0)
            for told, seen, times in zip(self.told, self._seen, self._times, strict=True)
        ]

    def add(self, batch: Batch) -> None:
        """Take the next second."""
        for channel, levels in enumerate(batch.distinct.tolist()):
            if 2 <= levels <= _FEW and levels * _TIMES_EACH <= batch.n:
                self._add(channel, float(batch.high[channel] - batch.low[channel]) / (levels - 1))
                if self._times[channel] >= _ENOUGH:
                    self._changed[channel // 3] = batch.slot
            elif levels > _FEW:
                self._times[channel] = 0

    def _add(self, channel: int, step: float) -> None:
        seen = self._seen[channel]
        ratio = max(step, seen) / min(step, seen)
        if self._times[channel] == 0 or not abs(ratio - round(ratio)) <= _ROUNDED:
            self._seen[channel], self._times[channel] = step, 1
        else:
            self._seen[channel] = min(step, seen)
            self._times[channel] += 1

    def excuse(self, batch: Batch, triad: int) -> bool:
        """Whether a second without any change of a triad (0 gyro, 1 accelerometer) may be rest."""
        return 0 <= batch.slot - self._changed[triad] <= STUCK_S
