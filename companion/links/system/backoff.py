"""How long to wait before the next attempt: doubling up to a cap."""

from __future__ import annotations


class Backoff:
    """Delays 0.2, 0.4, 0.8 ... s up to a cap; `reset` after an attempt that was worth something.

    There is no jitter: what is retried here is one device or one server by one client, so nothing gathers into a
    herd, and a fixed rhythm is easier to recognise in a log.
    """

    def __init__(self, first_s: float = 0.2, cap_s: float = 2.0) -> None:
        self._first_s, self._cap_s = first_s, cap_s
        self._next_s = first_s

    def next_s(self) -> float:
        """The delay to wait now; the one after it is twice as long, at most the cap."""
        delay_s = self._next_s
        self._next_s = min(delay_s * 2.0, self._cap_s)
        return delay_s

    def reset(self) -> None:
        """Begin again at the first delay."""
        self._next_s = self._first_s
