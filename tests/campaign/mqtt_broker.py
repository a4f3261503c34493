"""A small MQTT broker on the campaign's loop (3.1.1 and 5, as far as the daemon uses them), and its bad manners.

Written from the OASIS documents "MQTT Version 3.1.1" and "MQTT Version 5.0", section 3; real brokers are elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Final

from tests.campaign import loopback

CONNECT, PUBLISH, SUBSCRIBE, PINGREQ = 1, 3, 8, 12
_V5: Final = 5


class Broker:
    """Listens on a port of its own; `start` and `stop` it as often as you like."""

    def __init__(self) -> None:
        self.port = loopback.new_port()
        self.refuses = False
        """Connections are refused: "not authorised"."""
        self.deaf = False
        """Nothing is answered or acknowledged any more."""
        self.heard: list[tuple[str, bytes]] = []
        self.connections = 0
        self._server: asyncio.Server | None = None
        self._clients: dict[asyncio.StreamWriter, int] = {}
        self._handlers: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Listen."""
        self._server = await asyncio.start_server(self._serve, sock=loopback.listen(self.port))

    async def stop(self) -> None:
        """As a power cut: every connection is gone, nobody listens."""
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in [*self._clients]:
            writer.transport.abort()
        self._clients.clear()
        for task in [*self._handlers]:
            task.cancel()
        await asyncio.gather(*self._handlers, return_exceptions=True)

    def publish(self, topic: str, payload: bytes, *, retained: bool = False) -> None:
        """To every client that has subscribed."""
        for writer, version in self._clients.items():
            name = topic.encode()
            body = len(name).to_bytes(2, "big") + name + (b"\0" if version == _V5 else b"") + payload
            if not writer.is_closing():
                writer.write(_packet(0x30 | retained, body))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._handlers.add(task)
        try:
            await self._converse(reader, writer)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        except asyncio.CancelledError:
            pass
        finally:
            self._handlers.discard(task)
            self._clients.pop(writer, None)
            writer.transport.abort()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        version = 4
        while True:
            kind, flags, body = await _read(reader)
            if self.deaf:
                continue
            if kind == CONNECT:
                version = body[6]
                self.connections += 1
                code = (0x87 if version == _V5 else 5) if self.refuses else 0
                writer.write(_packet(0x20, bytes([0, code]) + (b"\0" if version == _V5 else b"")))
                if self.refuses:
                    return
            elif kind == SUBSCRIBE:
                self._clients[writer] = version
                topics = _topics(body, version)
                writer.write(_packet(0x90, body[:2] + (b"\0" if version == _V5 else b"") + b"\1" * topics))
            elif kind == PUBLISH:
                topic, payload = self._take(flags, body, version, writer)
                self.heard.append((topic, payload))
                del self.heard[:-200]
                if topic.endswith("/status"):
                    self.publish(topic, payload)
            elif kind == PINGREQ:
                writer.write(_packet(0xD0, b""))

    def _take(self, flags: int, body: bytes, version: int, writer: asyncio.StreamWriter) -> tuple[str, bytes]:
        size = int.from_bytes(body[:2], "big")
        topic, rest = body[2 : 2 + size].decode(), body[2 + size :]
        if flags & 0x06:
            writer.write(_packet(0x40, rest[:2]))
            rest = rest[2:]
        if version == _V5:
            rest = rest[1 + rest[0] :]
        return topic, rest


def _topics(body: bytes, version: int) -> int:
    at, found = 2, 0
    if version == _V5:
        at += 1 + body[2]
    while at < len(body):
        at += 2 + int.from_bytes(body[at : at + 2], "big") + 1
        found += 1
    return found


def _packet(first: int, body: bytes) -> bytes:
    size, length = len(body), b""
    while True:
        size, digit = divmod(size, 128)
        length += bytes([digit | (0x80 if size else 0)])
        if not size:
            return bytes([first]) + length + body


async def _read(reader: asyncio.StreamReader) -> tuple[int, int, bytes]:
    first = (await reader.readexactly(1))[0]
    size = shift = 0
    while True:
        digit = (await reader.readexactly(1))[0]
        size |= (digit & 0x7F) << shift
        shift += 7
        if not digit & 0x80:
            break
    with contextlib.suppress(MemoryError):
        return first >> 4, first & 15, await reader.readexactly(size)
    raise ConnectionError("too large")
