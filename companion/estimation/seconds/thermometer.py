"""Check of an IMU's thermometer, second by second.

One that is in another unit or jumps is not believed: then the IMU counts as one without a thermometer. A constant
reading is no fault: a board comes to rest at some temperature, and a heater holds its IMU warm.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

LOWEST_DEGC: Final = -40.0
HIGHEST_DEGC: Final = 105.0
"""Widest range of IMUs' data sheets."""
_NONE_AFTER_S: Final = 10
_ADJACENT_S: Final = 3
JUMP_K: Final = 5.0
"""Change within a second that no board makes."""
_JUMPS: Final = 2
_WITHIN_S: Final = 600


class Thermometer:
    """The thermometer of one IMU."""

    def __init__(self) -> None:
        self._begin(math.inf)

    def _begin(self, slot: float) -> None:
        self.none = False
        """True for an IMU whose messages carry no temperature."""
        self.wrong = ""
        """Reason in one line why it is not believed; empty: it is, or there is none."""
        self._slot = slot
        """Second of the latest reading, or the first second."""
        self._degc: float | None = None
        self._jumps: deque[float] = deque(maxlen=_JUMPS)

    def believed(self, slot: int, degc: float | None) -> float | None:
        """Add the reading of one second; return it if it can be believed."""
        if slot < self._slot:
            self._begin(slot)
        if degc is None or not math.isfinite(degc):
            self.none = slot - self._slot >= _NONE_AFTER_S
            return None
        jumped = self._degc is not None and abs(degc - self._degc) > JUMP_K and slot - self._slot <= _ADJACENT_S
        if jumped:
            self._jumps.append(slot)
        self._slot, self._degc, self.none, wrong = slot, degc, False, ""
        if not LOWEST_DEGC <= degc <= HIGHEST_DEGC:
            allowed = f"{LOWEST_DEGC:g} to {HIGHEST_DEGC:g} degC"
            wrong = f"shows {degc:.2f}, allowed {allowed}: in another unit?"
        elif len(self._jumps) == _JUMPS and slot - self._jumps[0] <= _WITHIN_S:
            wrong = f"jumps: more than {JUMP_K:g} K within a second, again and again"
        self.wrong = f"its thermometer {wrong}; nothing is learned by it" if wrong else ""
        return None if wrong or jumped else degc
