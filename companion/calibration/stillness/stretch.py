"""Which seconds belong to the still stretch under way.

A stretch begins with `min_still_s` good seconds in a row. From then on up to 20 % of the seconds of a window may be
rejected (a gust, a knock: the robust mean is for those), but never more than three in a row: then the aircraft was
moved, and a new stretch begins.
"""

from __future__ import annotations

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
        if good:
            if self.start is None:
                self.start = slot
            self.good += 1
            self._run = 0
            self.flags.append(True)
            self.begun = self.begun or self.good >= self._min_good
            return True
        self._run += 1
        self.flags.append(False)
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
