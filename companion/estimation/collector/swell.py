"""Whether what keeps an aircraft from being still is a regular wave: then it is on a boat, and there is a way."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np

from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.units import DEG

WATCHED_S: Final = 40
_LEAST_RAD_S: Final = 0.1 * DEG
_SLOWEST_HZ: Final = 0.05
_FASTEST_HZ: Final = 1.0 / 3.0
_NARROW: Final = 0.25
"""Half the width of a wave's band, over its frequency; never below `_RESOLVED_HZ`."""
_RESOLVED_HZ: Final = 0.03
_FINER: Final = 4
"""Points of the spectrum to every one that is independent."""
_REGULAR: Final = 0.75
"""Share of the rates' power, of all axes, in one band. Waves of 3 to 14 s have it in nine of ten looks; hands have
many frequencies, on each axis others (BROAD's slow rotation: at most 0.72)."""


class Swell:
    """Looks at the latest seconds of one IMU."""

    def __init__(self) -> None:
        self._rates: deque[tuple[int, Floats]] = deque(maxlen=WATCHED_S)
        self._latest: tuple[int | None, bool] = None, False

    def add(self, batch: Batch | None) -> None:
        """Take a second; one that is missing begins anew."""
        if batch is None or (self._rates and batch.slot != self._rates[-1][0] + 1):
            self._rates.clear()
        if batch is not None:
            self._rates.append((batch.slot, batch.mean[:3]))

    @property
    def is_regular(self) -> bool:
        """Whether it is a regular wave; after a second that is missing as before, until there are enough again."""
        if len(self._rates) == WATCHED_S and self._latest[0] != self._rates[-1][0]:
            self._latest = self._rates[-1][0], self._is_regular()
        return self._latest[1]

    def _is_regular(self) -> bool:
        rates = np.array([rate for _, rate in self._rates])
        rates = rates - rates.mean(axis=0)
        if float(np.square(rates).sum()) / len(rates) < _LEAST_RAD_S**2:
            return False
        tapered, size = rates * np.hanning(len(rates))[:, None], _FINER * len(rates)
        power = np.square(np.abs(np.fft.rfft(tapered, size, axis=0))).sum(axis=1)
        frequencies = np.fft.rfftfreq(size)
        waves = np.where((frequencies >= _SLOWEST_HZ) & (frequencies <= _FASTEST_HZ), power, 0.0)
        middle = frequencies[waves.argmax()]
        band = np.abs(frequencies - middle) <= max(_NARROW * middle, _RESOLVED_HZ)
        return bool(power[band].sum() > _REGULAR * power.sum())
