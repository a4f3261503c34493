"""What is in the way of a measurement right now, in the words that a pilot reads; nothing here changes anything."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from companion.calibration.collector.sources import Source


def obstacle(sources: Sequence[Source], now_s: float, *, good_now: bool, min_good: int) -> str | None:
    """A silent source, or the latest second was not still; None when nothing is in the way.

    Args:
        sources: in the order in which they are named.
        now_s: the samples' clock.
        good_now: the latest second was still for all of them.
        min_good: still seconds that are needed.
    """
    for source in sources:
        if (silence := source.silence(now_s)) is not None:
            return silence
    if good_now:
        return None
    for source in sources:
        if words := source.verdict.words:
            return words if source.verdict.fault else f"waiting for still: {words}"
    return f"hold still {min_good} s"


def is_moving(sources: Sequence[Source], now_s: float, *, good_now: bool) -> bool:
    """Whether nothing but a movement is in the way."""
    faulty = any(
        source.silence(now_s) is not None or (source.verdict.fault and source.verdict.words) for source in sources
    )
    return not faulty and not good_now


def settling(sources: Iterable[Source | None], slots: Sequence[int], needed: int, left_s: int) -> str | None:
    """What the mean of a pose sensor over these seconds and the next `left_s` has to wait for; None for nothing."""
    lacks = (source.lacks(slots, needed, left_s) for source in sources if source is not None)
    return next(filter(None, lacks), None)
