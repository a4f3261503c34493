"""A MAVLink wire in memory: two ends, delay, loss, duplicates, all seeded and on the event loop's clock."""

from __future__ import annotations

import asyncio
import math
import random

from sim.station import End

BUFFER_BYTES = 1024.0
"""Transmit buffer of a flight controller's UART."""


class Wire:
    """Carries bytes both ways between two ends.

    Args:
        one: the companion's end.
        other: the autopilot's.
        seed: of what is lost, doubled and late.
        delay_s: shortest and longest time under way.
        loss: probability per packet.
        duplicate: likewise.
        bytes_per_s: of a serial line, each way; what finds no room in BUFFER_BYTES is dropped, as by the UART of a
            flight controller.
    """

    def __init__(
        self,
        one: End,
        other: End,
        *,
        seed: int = 0,
        delay_s: tuple[float, float] = (0.001, 0.003),
        loss: float = 0.0,
        duplicate: float = 0.0,
        bytes_per_s: float = math.inf,
    ) -> None:
        self.loss, self.duplicate, self.delay_s = loss, duplicate, delay_s
        self.cut = False
        """True: nothing passes in either direction."""
        self.bytes_per_s = bytes_per_s
        self.dropped = 0
        """Packets for which a serial line had no room."""
        self._free_s: dict[int, float] = {}
        self._random = random.Random(seed)
        self._last_due_s: dict[int, float] = {}
        self._ends = (one, other)
        one.attach(_Way(self, other))
        other.attach(_Way(self, one))

    def unplug(self) -> None:
        for end in self._ends:
            end.attach(None)

    def carry_from_other(self, data: bytes) -> None:
        """Put a packet on the wire towards the companion's end, beside what the autopilot itself sends."""
        self._carry(data, self._ends[0])

    def has_room(self, size: int, to: End) -> bool:
        """Return True where so many bytes fit into the buffer of the sender's UART."""
        loop = asyncio.get_running_loop()
        return self._free_s.get(id(to), 0.0) - loop.time() + size / self.bytes_per_s <= BUFFER_BYTES / self.bytes_per_s

    def _carry(self, data: bytes, to: End) -> None:
        if self.cut or self._random.random() < self.loss:
            return
        loop = asyncio.get_running_loop()
        copies = 2 if self._random.random() < self.duplicate else 1
        for _ in range(copies):
            sent_s = max(loop.time(), self._free_s.get(id(to), 0.0)) + len(data) / self.bytes_per_s
            if sent_s - loop.time() > BUFFER_BYTES / self.bytes_per_s:
                self.dropped += 1
                continue
            self._free_s[id(to)] = sent_s
            due_s = sent_s + self._random.uniform(*self.delay_s)
            # A wire keeps the order; the loop runs timers of the very same instant in any order.
            due_s = max(due_s, self._last_due_s.get(id(to), 0.0) + 1e-6)
            self._last_due_s[id(to)] = due_s
            loop.call_at(due_s, self._deliver, data, to)

    def _deliver(self, data: bytes, to: End) -> None:
        if not self.cut:
            to.receive(data, asyncio.get_running_loop().time())


class _Way:
    """One direction, as it is given to the sender."""

    def __init__(self, wire: Wire, to: End) -> None:
        self._wire, self._to = wire, to

    def __call__(self, data: bytes) -> None:
        self._wire._carry(data, self._to)

    def has_room(self, size: int) -> bool:
        return self._wire.has_room(size, self._to)
