"""Which seconds count: those of the still stretch under way, and of a pose sensor those that follow no movement.

A stretch begins with `min_still_s` good seconds in a row. From then on up to 20 % of the seconds of a window may be
rejected (a gust, a knock: the robust mean is for those), but never more than three in a row: then the aircraft was
moved, and a new stretch begins.

A gradienter, or a compass that averages, goes on moving after the aircraft has stopped: both follow the truth with a
time constant; the fluid of a field gradienter is left with a tenth of what is missing after every second (BEI INC
manual; sensors 2.2 and 2.7). The gate on its movement sees only the steep beginning of that. So whenever the IMUs
say that a second was not still, what the sensor is off by at its end is taken from its own readings, and its seconds
count again once that has died away to a tenth of its sigma. The IMUs' own seconds count meanwhile: nobody who stands
still waits longer.

And a compass that turns while nothing else does shows that not the aircraft turns, but the field.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.estimation.seconds.batch import Batch
from companion.estimation.stillness.gates import Verdict
from companion.physics.frames import Floats, wrap_deg

MAX_REJECTED: Final = 0.20
MAX_REJECTED_RUN: Final = 3


class Stretch:
    """Counts good and rejected seconds, and knows where the still stretch begins."""

    def __init__(self, min_good: int, max_slots: int) -> None:
        self._min_good = min_good
        self.flags: deque[bool] = deque(maxlen=max_slots)
        self.clear()

    def clear(self) -> None:
        """There is no stretch."""
        self.start: int | None = None
        self.good = 0
        self.begun = False
        self.flags.clear()
        self._run = 0
        self._steady = 0

    def add(self, slot: int, *, good: bool) -> bool:
        """Take the next second; False when the stretch broke with it."""
        self._steady = self._steady + 1 if good else 0
        self.flags.append(good)
        if good:
            self.start = slot if self.start is None else self.start
            self.good, self._run = self.good + 1, 0
            self.begun = self.begun or self.good >= self._min_good
            return True
        self._run += 1
        rejected = len(self.flags) - sum(self.flags)
        if not self.begun or self._run > MAX_REJECTED_RUN or rejected > MAX_REJECTED * len(self.flags):
            was = self.start is not None
            self.clear()
            return not was
        return True

    @property
    def steady(self) -> int:
        """Good seconds in a row until now."""
        return min(self._steady, len(self.flags))

    @property
    def good_now(self) -> bool:
        """Whether the latest second was good."""
        return bool(self.flags) and self.flags[-1]

    @property
    def full(self) -> bool:
        """Whether it fills the longest window."""
        return len(self.flags) == self.flags.maxlen


UNKNOWN_DEG: Final = 5.0
"""What it may be off by after a movement during which nothing was heard of it."""
_SHARE: Final = 0.1
_CHANCE: Final = 4.0
"""Standard deviations that the lowest or highest of a second's readings may lie off by chance."""


class Settling:
    """Knows which of a pose sensor's seconds are still the tail of a movement.

    It follows the truth with the time constant `lag_s`, 0 being at once, and a tenth of `sigma_deg` may be left.
    """

    def __init__(self, lag_s: float, sigma_deg: float, *, circle: bool = False) -> None:
        self.left_s = 0
        """Seconds until its readings count again, as of the last second judged."""
        self._lag_s, self._sigma_deg = lag_s, sigma_deg
        self._circle = circle
        self._moved: int | None = None
        """The last second in which the aircraft moved, while its tail may last."""
        self._before: tuple[Floats, Floats, float] | None = None
        """Of that second: lowest and highest reading, and by how much less they may show than there was at its end."""
        self._after: tuple[Floats, Floats, float] | None = None
        """Of the second after it."""

    def judge(self, slot: int, batch: Batch | None, *, moved: bool) -> bool:
        """Whether what the sensor said in that second, after those before, counts; `moved`: the IMUs were not still."""
        if self._lag_s <= 0.0:
            return True
        if moved:
            self._moved, self._after = slot, None
            self._before = None if batch is None else (batch.low, batch.high, 1.0)
            self.left_s = self._seconds(UNKNOWN_DEG)
            return False
        if self._moved is None:
            return True
        if slot == self._moved + 1 and batch is not None:
            # What its first reading shows had a pause between two readings to decay.
            self._after = (batch.low, batch.high, math.exp(min(1.0 / (batch.n * self._lag_s), 50.0)))
        self.left_s = max(self._seconds(self._off_deg(batch)) - (slot - self._moved - 1), 0)
        if self.left_s == 0 and batch is not None:
            self._moved = None
        return self._moved is None

    def _seconds(self, off_deg: float) -> int:
        """Whole seconds until so much has died away."""
        remains = off_deg / (_SHARE * self._sigma_deg)
        return math.ceil(self._lag_s * math.log(remains)) if remains > 1.0 else 0

    def _off_deg(self, batch: Batch | None) -> float:
        """What it was off by when the aircraft stopped, from where it is now; beyond its own noise."""
        if batch is None or self._before is None:
            return UNKNOWN_DEG
        noise = _CHANCE * np.sqrt(batch.white)
        found = 0.0
        for low, high, faded in filter(None, (self._before, self._after)):
            excursion = np.maximum(np.abs(self._turn(low - batch.mean)), np.abs(self._turn(high - batch.mean)))
            found = max(found, float((excursion - noise).max()) * faded)
        return found

    def _turn(self, difference: Floats) -> Floats:
        return np.asarray(np.mod(difference + 180.0, 360.0) - 180.0) if self._circle else difference


SMOOTHED_OVER: Final = 5
"""Seconds of headings behind a value, so that noise does not look like wandering."""
BLIND_S: Final = 5
"""How long others may say nothing (offsets are written, readings forgotten) before it begins anew."""


class HeadingWatch:
    """The range of the heading since the gyros and the gradienter last moved."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._first_deg: float | None = None
        self._latest: deque[float] = deque(maxlen=SMOOTHED_OVER)
        self._range_deg: tuple[float, float] | None = None
        self._blind = 0

    def add_second(self, heading: Batch | None, others: Sequence[Verdict]) -> None:
        """One second: its heading, where one came, and what the gates of all other sources said."""
        if any(not verdict.still and not verdict.fault for verdict in others) or not others:
            self._begin()
            return
        if any(verdict.fault for verdict in others):
            self._blind += 1
            return
        if self._blind > BLIND_S:
            self._begin()
        self._blind = 0
        if heading is None:
            return
        value = float(heading.mean[0])
        self._first_deg = value if self._first_deg is None else self._first_deg
        self._latest.append(wrap_deg(value - self._first_deg))
        if len(self._latest) == SMOOTHED_OVER:
            smooth_deg = sum(self._latest) / SMOOTHED_OVER
            low_deg, high_deg = self._range_deg or (smooth_deg, smooth_deg)
            self._range_deg = min(low_deg, smooth_deg), max(high_deg, smooth_deg)

    @property
    def wander_deg(self) -> float | None:
        """How far apart its headings lay; None until it has seen enough."""
        return None if self._range_deg is None else self._range_deg[1] - self._range_deg[0]
