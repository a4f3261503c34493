"""What the rolling collector says of itself."""

from __future__ import annotations

import msgspec

from companion.calibration.collector.sources import SourceStatus


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Where the collector stands."""

    still_s: float
    """Good seconds, common to all sources, of the stretch under way."""
    waiting_for: str | None
    """One line for people; None when still long enough and nothing is in the way."""
    enough: bool
    """The stop rule is met: `window` gives a result that more seconds would not better."""
    progress: float
    """0..1 towards `enough`; falls to 0 when the stretch breaks."""
    sources: tuple[SourceStatus, ...]
    restarted_because: str
    """Argument of the last reset; empty before any."""


class Glance(msgspec.Struct, frozen=True, kw_only=True):
    """What can be said of the stillness at once, without looking at the readings themselves."""

    obstacle: str | None
    """What is in the way at this moment, however long it has been still: it moves, or a source is silent or stuck."""
    moving: bool
    """Whether the obstacle is a movement, which a hand can end, and no fault."""
    still_s: float
    """As in `Status`."""
    steady_s: float
    """Good seconds without a bad one until now."""
