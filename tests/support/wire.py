"""A MAVLink wire in memory: two ends, delay, loss, duplicates, all seeded and on the event loop's clock."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from typing import Protocol


class End(Protocol):
    """What a wire can be plugged into: companion.links.mavlink.MavlinkLink and the simulator's autopilots."""

    def attach(self, transmit: Callable[[bytes], None] | None) -> None: ...

    def receive(self, data: bytes, t_s: float) -> None: ...


class Wire:
    """Carries bytes both ways between two ends; `loss` and `duplicate` are probabilities per packet."""

    def __init__(
        self,
        one: End,
        other: End,
        *,
        seed: int = 0,
        delay_s: tuple[float, float] = (0.001, 0.003),
        loss: float = 0.0,
        duplicate: float = 0.0,
    ) -> None:
        self.loss, self.duplicate, self.delay_s = loss, duplicate, delay_s
        self.cut = False
        """True: nothing passes in either direction."""
        self._random = random.Random(seed)
        self._last_due_s: dict[int, float] = {}
        self._ends = (one, other)
        one.attach(lambda data: self._carry(data, other))
        other.attach(lambda data: self._carry(data, one))

    def unplug(self) -> None:
        """Take both ends off the wire."""
        for end in self._ends:
            end.attach(None)

    def _carry(self, data: bytes, to: End) -> None:
        if self.cut or self._random.random() < self.loss:
            return
        loop = asyncio.get_running_loop()
        copies = 2 if self._random.random() < self.duplicate else 1
        for _ in range(copies):
            due_s = loop.time() + self._random.uniform(*self.delay_s)
            # A wire keeps the order; the loop runs timers of the very same instant in any order.
            due_s = max(due_s, self._last_due_s.get(id(to), 0.0) + 1e-6)
            self._last_due_s[id(to)] = due_s
            loop.call_at(due_s, self._deliver, data, to)

    def _deliver(self, data: bytes, to: End) -> None:
        if not self.cut:
            to.receive(data, asyncio.get_running_loop().time())
