"""Ten thousand aircraft in one process: a connection each to a real broker, and of MQTT 3.1.1 just what they need.

Each has what its companion would keep, and behaves as it does: hello, items, again what is asked for or not confirmed.
A client library needs more than this whole process for each connection; one connection for many aircraft would spare
the broker what is to be measured.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import AsyncIterator, Iterable, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from sim.fleet.aircraft import Aircraft

AGAIN_S: Final = 30.0
CONNECTING: Final = 200
"""The most that are on their way to the broker at once."""
_CONNACK, _PUBLISH, _SUBACK = 2, 3, 9


class _Said(msgspec.Struct):
    epoch: str
    sequences: list[tuple[int, int]]


class Confirmed(NamedTuple):
    """When an item was published first, and when its confirmation came, in seconds of the monotonic clock."""

    told_s: float
    heard_s: float


class Light(asyncio.Protocol):
    def __init__(self, one: Aircraft, fleet: Fleet) -> None:
        self.one, self._fleet = one, fleet
        self._name = one.id.encode()
        self._transport: Any = None
        self._rest = b""
        self._mid = 0
        self.under_way: dict[int, tuple[float, float]] = {}
        """When it was told first and last, by sequence."""

    # --- what it says

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        head = b"\0\4MQTT\4\2\0\0"  # 3.1.1, a clean session, no keep-alive
        self._write(0x10, head + _text(b"light-" + self._name))

    def tell(self, sequences: Iterable[int]) -> None:
        now_s = time.monotonic()
        self._publish(b"hello", self.one.hello, retain=True)
        for sequence in sequences:
            self.under_way[sequence] = now_s, now_s
            self._publish(b"item", self.one.told[sequence])

    def again(self, sequences: Iterable[int]) -> None:
        now_s = time.monotonic()
        for sequence in sequences:
            self.under_way[sequence] = self.under_way.get(sequence, (now_s, now_s))[0], now_s
            self._publish(b"item", self.one.told[sequence])

    def _publish(self, what: bytes, payload: bytes, *, retain: bool = False) -> None:
        self._fleet.deliveries += what == b"item"
        self._mid = self._mid % 0xFFFF + 1
        topic = _text(b"fleet/" + self._name + b"/" + what)
        self._write(0x32 | retain, topic + self._mid.to_bytes(2, "big") + payload)

    def _write(self, kind: int, body: bytes) -> None:
        length, left = bytearray(), len(body)
        while True:
            left, low = divmod(left, 128)
            length.append(low | (0x80 if left else 0))
            if not left:
                break
        self._transport.write(bytes((kind,)) + bytes(length) + body)

    # --- what it hears

    def data_received(self, data: bytes) -> None:
        data, at = self._rest + data, 0
        while (packet := _packet(data, at)) is not None:
            kind, body, at = packet
            self._take(kind, body)
        self._rest = data[at:]

    def _take(self, kind: int, body: bytes) -> None:
        if kind >> 4 == _CONNACK:
            assert body[1] == 0, f"the broker refuses: {body[1]}"
            topics = (_text(b"fleet/" + self._name + b"/" + what) + b"\1" for what in (b"confirmed", b"wanted"))
            self._write(0x82, b"\0\1" + b"".join(topics))
        elif kind >> 4 == _SUBACK:
            self._fleet.arrived()
        elif kind >> 4 == _PUBLISH:
            end = 2 + int.from_bytes(body[:2], "big")
            if kind & 0x06:
                self._write(0x40, body[end : end + 2])
            self._heed(body[2:end], body[end + 2 if kind & 0x06 else end :])

    def _heed(self, topic: bytes, payload: bytes) -> None:
        said = msgspec.json.decode(payload, type=_Said)
        if said.epoch != self.one.epoch:
            return
        named = [number for first, last in said.sequences for number in range(first, last + 1)]
        if topic.endswith(b"/wanted"):
            self.one.confirmed.difference_update(named)
            self.again(number for number in named if number in self.one.told)
            return
        for sequence in named:
            if (told := self.under_way.pop(sequence, None)) is not None:
                self.one.confirmed.add(sequence)
                self._fleet.confirmed.append(Confirmed(told[0], time.monotonic()))
        if not self.under_way:
            self._fleet.free.set()

    def connection_lost(self, error: Exception | None) -> None:
        self._fleet.lost += not self._fleet.leaving

    def close(self) -> None:
        self._transport.abort()


class Fleet:
    """All of them; counts are since the last `forget`."""

    def __init__(self, fleet: Sequence[Aircraft]) -> None:
        self.lights = [Light(one, self) for one in fleet]
        self.confirmed: list[Confirmed] = []
        self.deliveries = self.lost = 0
        """Items published; connections lost."""
        self.free = asyncio.Event()
        self.leaving = False
        self._arriving = asyncio.Semaphore(CONNECTING)

    def arrived(self) -> None:
        self._arriving.release()

    @contextlib.asynccontextmanager
    async def at(self, port: int) -> AsyncIterator[None]:
        """With all of them at the broker on this computer."""
        loop = asyncio.get_running_loop()
        try:
            for light in self.lights:
                await self._arriving.acquire()
                await loop.create_connection(lambda light=light: light, "127.0.0.1", port)  # type: ignore[misc]
            for _ in range(CONNECTING):
                await self._arriving.acquire()
            yield
            assert self.lost == 0, f"the broker has thrown out {self.lost}"
        finally:
            self.leaving = True
            for light in self.lights:
                if light._transport is not None:
                    light.close()

    def begin_anew(self, number: int) -> None:
        """Start anew as with another memory card: no items, no confirmations."""
        self.confirmed, self.deliveries = [], 0
        for light in self.lights:
            light.under_way.clear()
            light.one.confirmed.clear()
            light.one.epoch = f"{number:016x}"
            light.one.told.clear()

    @property
    def under_way(self) -> int:
        """Number of aircraft with unconfirmed items."""
        return sum(bool(light.under_way) for light in self.lights)

    async def tell(self, sessions: Iterable[tuple[Light, list[int]]], at_once: int) -> None:
        """One session after another, `at_once` of them together, until all is confirmed."""
        waiting, busy = deque(sessions), set[Light]()
        repeating = asyncio.create_task(self._repeat())
        try:
            while waiting or busy:
                busy = {light for light in busy if light.under_way}
                while waiting and len(busy) < at_once:
                    light, sequences = waiting.popleft()
                    light.tell(sequences)
                    busy.add(light)
                self.free.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(0.05):
                        await self.free.wait()
        finally:
            repeating.cancel()

    async def tell_at(self, sessions: Sequence[tuple[Light, list[int]]], a_second: float) -> None:
        """Publish so many sessions a second until all are confirmed."""
        repeating, begun_s = asyncio.create_task(self._repeat()), time.monotonic()
        try:
            for number, (light, sequences) in enumerate(sessions):
                if (early_s := begun_s + number / a_second - time.monotonic()) > 0.0:
                    await asyncio.sleep(early_s)
                light.tell(sequences)
            while self.under_way:
                await asyncio.sleep(0.05)
        finally:
            repeating.cancel()

    async def _repeat(self) -> None:
        while True:
            await asyncio.sleep(1.0)
            before_s = time.monotonic() - AGAIN_S
            for light in self.lights:
                if late := [number for number, (_, last_s) in light.under_way.items() if last_s < before_s]:
                    light.again(late)


def _text(words: bytes) -> bytes:
    return len(words).to_bytes(2, "big") + words


def _packet(data: bytes, at: int) -> tuple[int, bytes, int] | None:
    """Kind, what is in it, and where the next begins; None: it is not there wholly."""
    length, shift, end = 0, 0, at + 1
    while True:
        if end >= len(data):
            return None
        length |= (data[end] & 0x7F) << shift
        shift, end = shift + 7, end + 1
        if not data[end - 1] & 0x80:
            break
    return None if end + length > len(data) else (data[at], data[end : end + length], end + length)
