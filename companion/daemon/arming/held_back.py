"""What a calibration by itself has measured and not written, because it contradicts earlier ones.

It is not judged by what is measured meanwhile, since that is in doubt. What is in force stays so, the gate as it was,
until somebody asks for a calibration or the output shows something else.
"""

from __future__ import annotations

from typing import Final

import msgspec

from companion.daemon.calibrating.run import Key, in_short
from companion.estimation.records.validity import Finding, Held, Present, Why, worst_axis
from companion.estimation.solution.doubt import Doubt

_CHOSEN: Final = frozenset({Why.UNDONE, Why.CHANGED})
"""What a person has chosen; all else gives way to a doubt of what is measured."""


class _OnHold(msgspec.Struct, frozen=True):
    words: str
    seen: Held
    """What was measured: so long as the output stays there, measuring again would tell the same."""


class HeldBack:
    """The triads on hold, of one run of the daemon."""

    def __init__(self) -> None:
        self._kept: dict[Key, _OnHold] = {}

    def __contains__(self, key: Key) -> bool:
        """Whether a triad is on hold."""
        return key in self._kept

    @property
    def text(self) -> str | None:
        """What was measured and not written, and why, in one short line; None when nothing was."""
        if not self._kept:
            return None
        why = ", ".join(dict.fromkeys(each.words for each in self._kept.values()))
        return f"held back: {in_short(self._kept)} ({why})"

    def hold(self, key: Key, doubt: Doubt, seen: Held) -> None:
        """Put a triad on hold."""
        self._kept[key] = _OnHold(doubt.in_short, seen)

    def let_go(self, *, name: str | None = None, triad: str | None = None) -> None:
        """Judge again as ever: all, or those of one IMU, of one half, of both."""
        self._kept = {
            key: each
            for key, each in self._kept.items()
            if (name is not None and key[0] != name) or (triad is not None and key[1] != triad)
        }

    def still(self, key: Key, held: Held | Why, present: Present, end_s: float, most_s: float) -> bool:
        """Whether a triad stays on hold: not once the output shows what is in force, or something else again.

        After `most_s` it is tried again; `end_s` is now.
        """
        on_hold = self._kept.get(key)
        if on_hold is None:
            return False
        right = isinstance(held, Held) and worst_axis(held, present) is None
        again = end_s - on_hold.seen.confirmed_s > most_s
        if right or again or worst_axis(on_hold.seen, present) is not None:
            del self._kept[key]
            return False
        return True

    def left_of(self, key: Key, against: list[Finding]) -> list[Finding]:
        """What speaks against a triad all the same: a person's choice, and what was written and never seen right."""
        if key not in self._kept:
            return against
        return [finding for finding in against if finding.why in _CHOSEN or finding.why is Why.UNSEEN]
