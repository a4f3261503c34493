"""Listeners to an event, called in the order of their subscription; a failing one does not stop the others."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Generic, ParamSpec

logger = logging.getLogger(__name__)

P = ParamSpec("P")
Unsubscribe = Callable[[], None]


class Listeners(Generic[P]):
    """Callbacks of one kind."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[P, object]] = []

    def __len__(self) -> int:
        return len(self._callbacks)

    def add(self, callback: Callable[P, object]) -> Unsubscribe:
        """Tell the callback from now on; returns how to stop that."""
        self._callbacks.append(callback)

        def unsubscribe() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return unsubscribe

    def tell(self, *args: P.args, **kwargs: P.kwargs) -> int:
        """Call all of them; how many of them failed."""
        failed = 0
        for callback in tuple(self._callbacks):
            try:
                callback(*args, **kwargs)
            except Exception:
                failed += 1
                logger.exception("a listener failed on %.200s", args[0] if args else "nothing")
        return failed
