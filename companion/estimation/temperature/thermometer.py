"""Check of the IMUs' thermometers, second by second.

One that is stuck, in another unit or jumping is not believed: then the IMU counts as one without a thermometer. A
constant reading alone is no fault: a board comes to rest at some temperature, many parts show steps of 1 K or 1/8 K,
and a heater holds its IMU warm.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Final

LOWEST_DEGC: Final = -40.0
HIGHEST_DEGC: Final = 105.0
"""Widest range of IMUs' data sheets."""
_USUAL_DEGC: Final = (10.0, 60.0)
_NONE_AFTER_S: Final = 10
_ADJACENT_S: Final = 3
JUMP_K: Final = 5.0
"""Change within a second that no board makes."""
_JUMPS: Final = 2
_WITHIN_S: Final = 600
_SAME_K: Final = 1e-6
_STUCK_S: Final = 60
_STUCK_ALONE_S: Final = 3 * 3600
_MOVED_K: Final = 3.0
_MOVED_FAR_K: Final = 10.0
"""Change of another IMU beside a stuck thermometer with fine steps, and with coarse ones."""
_HEATED_DEGC: Final = 38.0
"""Least temperature that a heater may hold: autopilots heat to 45 degC and more."""
_FINE_K: Final = 0.006
"""Least distance of a reading with fine steps from eighths and tenths of a kelvin, rounded to hundredths."""


@dataclasses.dataclass(slots=True)
class _Shown:
    slot: int
    """Second of the latest reading, or the first second."""
    degc: float | None = None
    since: int = 0
    """Second since which it has shown this value."""
    beside: dict[str, float] = dataclasses.field(default_factory=dict)
    """Readings of the other IMUs at that second."""
    jumps: deque[int] = dataclasses.field(default_factory=lambda: deque(maxlen=_JUMPS))
    wrong: str = ""
    none: bool = False


class Thermometers:
    """Thermometers of all IMUs: one reveals a fault of another."""

    def __init__(self) -> None:
        self._of: dict[str, _Shown] = {}

    def believed(self, name: str, slot: int, degc: float | None) -> float | None:
        """Add the reading of one second; return it if it can be believed."""
        one = self._of.get(name)
        if one is None or slot < one.slot:
            one = self._of[name] = _Shown(slot, since=slot)
        if degc is None or not math.isfinite(degc):
            one.none = slot - one.slot >= _NONE_AFTER_S
            return None
        before, gap_s = one.degc, slot - one.slot
        one.slot, one.degc, one.none = slot, degc, False
        if before is None or abs(degc - before) > _SAME_K:
            one.since, one.beside = slot, {}
        for other, shown in self._of.items():
            if other != name and shown.degc is not None and not shown.wrong:
                one.beside.setdefault(other, shown.degc)
        jumped = before is not None and gap_s <= _ADJACENT_S and abs(degc - before) > JUMP_K
        if jumped:
            one.jumps.append(slot)
        one.wrong = self._wrong(one)
        return None if one.wrong or jumped else degc

    def trouble(self, name: str) -> str:
        """Say in one line why a thermometer is not believed; empty: it is, or there is none."""
        one = self._of.get(name)
        return (
            f"imu {name}: its thermometer {one.wrong}; nothing is learned by it"
            if one is not None and one.wrong
            else ""
        )

    def has_none(self, name: str) -> bool:
        """Return True for an IMU whose messages carry no temperature."""
        return name in self._of and self._of[name].none

    def _wrong(self, one: _Shown) -> str:
        degc = one.degc or 0.0
        if not LOWEST_DEGC <= degc <= HIGHEST_DEGC:
            return f"shows {degc:.2f}, allowed {LOWEST_DEGC:g} to {HIGHEST_DEGC:g} degC{_unit(degc)}"
        if len(one.jumps) == _JUMPS and one.slot - one.jumps[0] <= _WITHIN_S:
            return f"jumps: more than {JUMP_K:g} K within a second, again and again"
        lasts_s = one.slot - one.since
        fine = all(abs(degc * steps - round(degc * steps)) > _FINE_K * steps for steps in (8, 10))
        if lasts_s >= _STUCK_S and (fine or degc < _HEATED_DEGC):
            for other, then_degc in one.beside.items():
                moved_k = abs((self._of[other].degc or 0.0) - then_degc)
                if not self._of[other].wrong and moved_k >= (_MOVED_K if fine else _MOVED_FAR_K):
                    return f"is stuck at {degc:.2f} degC, while that of {other} moved by {moved_k:.0f} K"
        if fine and lasts_s >= _STUCK_ALONE_S:
            return f"is stuck at {degc:.2f} degC for {lasts_s / 3600.0:.0f} h"
        return ""


def _unit(shown: float) -> str:
    """Guess the unit in which it would be a usual temperature."""
    low, high = _USUAL_DEGC
    units = {
        "kelvin": shown - 273.15,
        "degF": (shown - 32.0) / 1.8,
        "tenths": shown / 10.0,
    }
    likely = [unit for unit, degc in units.items() if low <= degc <= high]
    return f" (in {' or '.join(likely)}?)" if likely else ""
