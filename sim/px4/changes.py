"""How a change of a parameter reaches those who use it: at once at first, then at most once a second.

Every consumer in the firmware looks at `parameter_update` through a subscription that is held back to one second (PX4
`SubscriptionInterval.cpp`; autopilots 9.2: effect after 4 ms when it was quiet before, otherwise up to 1 s). After a
quiet time it lets two looks pass, then it waits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

INTERVAL_S = 1.0


class Clock(Protocol):
    """What a consumer needs of the double."""

    def now_s(self) -> float:
        """The loop's clock."""

    def later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do something after a delay, unless a reboot comes first."""


class Consumer:
    """One reader of parameters that looks every `period_s`, and at changes at most once a second."""

    def __init__(self, clock: Clock, period_s: float, action: Callable[[float], None]) -> None:
        self._clock, self._period_s, self._action = clock, period_s, action
        self._last_s = -math.inf
        self._pending = False
        self.looks = 0

    def restart(self) -> None:
        """A boot."""
        self._last_s, self._pending = -math.inf, False

    def notify(self) -> None:
        """Something has changed."""
        if self._pending:
            return
        self._pending = True
        now_s = self._clock.now_s()
        looks_s = (math.floor(now_s / self._period_s) + 1) * self._period_s
        self._clock.later(max(looks_s, self._last_s + INTERVAL_S) - now_s, self._look)

    def _look(self) -> None:
        self._pending = False
        now_s = self._clock.now_s()
        self._last_s = min(max(self._last_s + INTERVAL_S, now_s - INTERVAL_S), now_s)
        self.looks += 1
        self._action(now_s)
