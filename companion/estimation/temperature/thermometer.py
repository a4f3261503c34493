"""Check of the IMUs' thermometers, second by second.

One that is in another unit or jumps is not believed: then the IMU counts as one without a thermometer. A constant
reading is no fault: a board comes to rest at some temperature, and a heater holds its IMU warm.
"""

from __future__ import annotations

import dataclasses
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


@dataclasses.dataclass(slots=True)
class _Shown:
    slot: int
    """Second of the latest reading, or the first second."""
    degc: float | None = None
    jumps: deque[int] = dataclasses.field(default_factory=lambda: deque(maxlen=_JUMPS))
    wrong: str = ""
    none: bool = False


class Thermometers:
    """Thermometers of all IMUs."""

    def __init__(self) -> None:
        self._of: dict[str, _Shown] = {}

    def believed(self, name: str, slot: int, degc: float | None) -> float | None:
        """Add the reading of one second; return it if it can be believed."""
        one = self._of.get(name)
        if one is None or slot < one.slot:
            one = self._of[name] = _Shown(slot)
        if degc is None or not math.isfinite(degc):
            one.none = slot - one.slot >= _NONE_AFTER_S
            return None
        jumped = one.degc is not None and abs(degc - one.degc) > JUMP_K and slot - one.slot <= _ADJACENT_S
        if jumped:
            one.jumps.append(slot)
        one.slot, one.degc, one.none, one.wrong = slot, degc, False, ""
        if not LOWEST_DEGC <= degc <= HIGHEST_DEGC:
            allowed = f"{LOWEST_DEGC:g} to {HIGHEST_DEGC:g} degC"
            one.wrong = f"shows {degc:.2f}, allowed {allowed}: in another unit?"
        elif len(one.jumps) == _JUMPS and slot - one.jumps[0] <= _WITHIN_S:
            one.wrong = f"jumps: more than {JUMP_K:g} K within a second, again and again"
        return None if one.wrong or jumped else degc

    def trouble(self, name: str) -> str:
        """Say in one line why a thermometer is not believed; empty: it is, or there is none."""
        one = self._of.get(name)
        return f"imu {name}: its thermometer {one.wrong}; nothing is learned by it" if one and one.wrong else ""

    def has_none(self, name: str) -> bool:
        """Return True for an IMU whose messages carry no temperature."""
        return name in self._of and self._of[name].none
