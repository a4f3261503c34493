"""Does the compass turn while nothing else does? Then it is not the aircraft that turns, but the field.

It looks across still stretches: a jump of the heading ends a stretch (the aircraft may have been turned), and only
the gyros and the gradienter, still all the while, tell that it was not. So several calibrations in one pose are
compared with each other too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from companion.calibration.seconds.batch import Batch
from companion.calibration.stillness.gates import Verdict
from companion.physics.frames import wrap_deg

SMOOTHED_OVER: Final = 5
"""Seconds of headings behind a value, so that noise does not look like wandering."""
BLIND_S: Final = 5
"""So long may others say nothing (offsets are written, and readings forgotten) before it begins anew."""


class HeadingWatch:
    """The range of the heading since the gyros and the gradienter last moved."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._first_deg: float | None = None
        self._latest: deque[float] = deque(maxlen=SMOOTHED_OVER)
        self._range_deg: tuple[float, float] | None = None
        self._blind = 0

    def take(self, heading: Batch | None, others: Sequence[Verdict]) -> None:
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
        if self._first_deg is None:
            self._first_deg = value
        self._latest.append(wrap_deg(value - self._first_deg))
        if len(self._latest) == SMOOTHED_OVER:
            smooth_deg = sum(self._latest) / SMOOTHED_OVER
            low_deg, high_deg = self._range_deg or (smooth_deg, smooth_deg)
            self._range_deg = min(low_deg, smooth_deg), max(high_deg, smooth_deg)

    @property
    def wander_deg(self) -> float | None:
        """How far apart its headings lay; None until it has seen enough."""
        return None if self._range_deg is None else self._range_deg[1] - self._range_deg[0]
