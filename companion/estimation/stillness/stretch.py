"""Seconds that count: those of the still stretch, and those of a pose sensor that follow no movement.

A stretch begins with `min_still_s` good seconds in a row. From then on up to 20 % of the seconds of a window may be
rejected (a gust, a knock), for which the mean is robust. More than three in a row end it: the aircraft was moved.

A gradienter, or a compass that averages, goes on moving after the aircraft has stopped: both follow the truth with a
time constant; the fluid of a field gradienter keeps a tenth of its error after every second (BEI INC manual; sensors
2.2 and 2.7). The gate sees only the steep beginning of that. So after every second that was not still by the IMUs, its
seconds count again once the largest error has died away to a tenth of its sigma. Those of the IMUs count meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

MAX_REJECTED: Final = 0.20
MAX_REJECTED_RUN: Final = 3


class Stretch:
    """Counts good and rejected seconds, and knows where the still stretch begins."""

    def __init__(self, min_good: int, max_slots: int) -> None:
        self._min_good = min_good
        self.flags: deque[bool] = deque(maxlen=max_slots)
        self.clear()

    def clear(self) -> None:
        """End the stretch."""
        self.start: int | None = None
        self.good = 0
        self.begun = False
        self.flags.clear()
        self._run = 0
        self._steady = 0

    def add(self, slot: int, *, good: bool) -> bool:
        """Add the next second; False when the stretch ends with it."""
        self._steady = self._steady + 1 if good else 0
        self.flags.append(good)
        if good:
            self.start = slot if self.start is None else self.start
            self.good, self._run = self.good + 1, 0
            self.begun = self.begun or self.good >= self._min_good
            return True
        self._run += 1
        rejected = self.flags.count(False)
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
        """True if the latest second was good."""
        return bool(self.flags) and self.flags[-1]

    @property
    def full(self) -> bool:
        """True if it fills the longest window."""
        return len(self.flags) == self.flags.maxlen


OFF_DEG: Final = 5.0
"""Largest error that a movement leaves in a pose sensor."""
_SHARE: Final = 0.1


class Settling:
    """Knows which seconds of a pose sensor are still the tail of a movement.

    The sensor follows the truth with the time constant `lag_s`, 0 for none; a tenth of `sigma_deg` may remain.
    """

    def __init__(self, lag_s: float, sigma_deg: float) -> None:
        self.left_s = 0
        """Seconds until its readings count again, as of the last second judged."""
        # Without a lag nothing follows, however exact the sensor is said to be.
        self._tail_s = math.ceil(lag_s * math.log(max(OFF_DEG / (_SHARE * sigma_deg), 1.0))) if lag_s > 0.0 else 0
        self._moved: int | None = None
        """Last second in which the aircraft moved."""

    def judge(self, slot: int, *, moved: bool) -> bool:
        """Judge whether the second counts, seconds ascending; `moved`: the IMUs were not still."""
        if moved:
            self._moved = slot
        self.left_s = 0 if self._moved is None else max(self._moved + 1 + self._tail_s - slot, 0)
        return self._tail_s == 0 or self._moved is None or slot > self._moved + self._tail_s
