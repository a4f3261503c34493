"""What the rolling collector says of itself; nothing here changes anything."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from companion.calibration.collector.sources import Source, SourceStatus


class Obstacle(msgspec.Struct, frozen=True):
    """What is in the way of a measurement."""

    words: str
    """One line, as a pilot reads it."""
    moving: bool = False
    """Nothing but a movement, which a hand can end; no fault."""
    hold_still_s: int | None = None
    """Nothing but time: how long it has to stand still yet."""


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Where the collector stands."""

    still_s: float
    """Good seconds, common to all sources, of the stretch under way."""
    obstacle: Obstacle | None
    """None when still long enough and nothing is in the way."""
    enough: bool
    """The stop rule is met: `window` gives a result that more seconds would not better."""
    progress: float
    """0..1 towards `enough`; falls to 0 when the stretch breaks."""
    sources: tuple[SourceStatus, ...]

    @property
    def waiting_for(self) -> str | None:
        """The obstacle's words."""
        return None if self.obstacle is None else self.obstacle.words


class Glance(msgspec.Struct, frozen=True, kw_only=True):
    """What can be said of the stillness at once, without looking at the readings themselves."""

    obstacle: Obstacle | None
    """What is in the way at this moment, however long it has been still: it moves, or a source is silent or stuck."""
    still_s: float
    """As in `Status`."""
    steady_s: float
    """Good seconds without a bad one until now."""

    @property
    def moving(self) -> bool:
        """Whether a movement is in the way."""
        return self.obstacle is not None and self.obstacle.moving


def obstacle(sources: Sequence[Source], now_s: float, *, good_now: bool, min_good: int) -> Obstacle | None:
    """A silent source, or the latest second was not still; None when nothing is in the way."""
    if (silence := next(filter(None, (source.silence(now_s) for source in sources)), None)) is not None:
        return Obstacle(silence)
    if good_now:
        return None
    said = [source.verdict for source in sources if source.verdict.words]
    moving = not any(verdict.fault for verdict in said)
    if not said:
        return Obstacle(f"hold still {min_good} s", moving, min_good)
    words = said[0].words
    return Obstacle(words if said[0].fault else f"waiting for still: {words}", moving)


def settling(sources: Iterable[Source | None], slots: Sequence[int], needed: int, left_s: int) -> str | None:
    """What the mean of a pose sensor over these seconds and the next `left_s` has to wait for; None for nothing."""
    lacks = (source.lacks(slots, needed, left_s) for source in sources if source is not None)
    return next(filter(None, lacks), None)
