"""Lists of event listeners, and a wait for an asyncio.Event with a time limit."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Generic, ParamSpec

logger = logging.getLogger(__name__)

P = ParamSpec("P")
Unsubscribe = Callable[[], None]


class Listeners(Generic[P]):
    """List of callbacks, called in the order of their subscription; a failing one does not stop the others."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[P, object]] = []

    def __len__(self) -> int:
        return len(self._callbacks)

    def add(self, callback: Callable[P, object]) -> Unsubscribe:
        self._callbacks.append(callback)

        def unsubscribe() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return unsubscribe

    def tell(self, *args: P.args, **kwargs: P.kwargs) -> int:
        """Call all listeners and return how many failed."""
        failed = 0
        for callback in tuple(self._callbacks):
            try:
                callback(*args, **kwargs)
            except Exception:
                failed += 1
                logger.exception("a listener failed on %.200s", args[0] if args else "nothing")
        return failed


async def comes(event: asyncio.Event, within_s: float) -> bool:
    """Wait until an event is set; return False on timeout."""
    if event.is_set():
        return True
    # Not asyncio.timeout, which cannot expire in a cancelled task before Python 3.11.4: clean-ups wait here too.
    waiting = asyncio.ensure_future(event.wait())
    try:
        return bool((await asyncio.wait([waiting], timeout=within_s))[0])
    finally:
        waiting.cancel()
