"""Whether what keeps an aircraft from being still is a regular wave: then it is on a boat, and there is a way."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from companion.calibration.seconds.batch import Batch
from companion.physics.units import DEG

WATCHED_S: Final = 40
HINT: Final = '; on a boat? set vehicle.platform = "deck"'
_LEAST_RAD_S: Final = 0.1 * DEG
_PERIODS_S: Final = range(3, 21)
_LIKENESS: Final = 0.4
"""Correlation of the rates with themselves a period later; half a period later with the other sign, as much."""


class Swell:
    """Looks at the latest seconds of one IMU."""

    def __init__(self) -> None:
        self._rates: deque[tuple[int, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]] = deque(maxlen=WATCHED_S)
        self._known: tuple[int, bool] | None = None

    def add(self, batch: Batch | None) -> None:
        """Take a second; one that is missing begins anew."""
        if batch is None or (self._rates and batch.slot != self._rates[-1][0] + 1):
            self._rates.clear()
        if batch is not None:
            self._rates.append((batch.slot, batch.mean[:3]))

    @property
    def hint(self) -> str:
        """What to add to the words that say how it moves; empty where there is no regular wave."""
        if len(self._rates) < WATCHED_S:
            return ""
        last = self._rates[-1][0]
        if self._known is None or self._known[0] != last:
            self._known = last, self._is_regular()
        return HINT if self._known[1] else ""

    def _is_regular(self) -> bool:
        rates = np.array([rate for _, rate in self._rates])
        rates = rates - rates.mean(axis=0)
        # The axis that moves most.
        rate = rates[:, int(np.square(rates).sum(axis=0).argmax())]
        power = float(rate @ rate) / len(rate)
        if power < _LEAST_RAD_S**2:
            return False
        like = [float(rate[lag:] @ rate[:-lag]) / (len(rate) - lag) / power for lag in range(1, _PERIODS_S.stop)]
        for period in _PERIODS_S:
            # Sampled once a second, half of a short period lies between two lags.
            half = min(like[(period // 2) - 1], like[(period + 1) // 2 - 1])
            if like[period - 1] > _LIKENESS and half < -_LIKENESS:
                return True
        return False
