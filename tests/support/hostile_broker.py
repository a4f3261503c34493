"""A broker that takes every connection and then sends whatever its attack is made of.

It serves real connections on a loopback port, and is polite until its attack begins.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
import struct
from collections.abc import AsyncIterator, Callable, Iterator

Attack = Callable[[], Iterator[bytes]]
"""What is sent after the greeting, piece by piece; at its end the connection stays open."""

CHUNK: bytes = bytes(1 << 16)


def variable(number: int) -> bytes:
    """A length as MQTT writes it."""
    out = bytearray()
    while True:
        number, low = divmod(number, 128)
        out.append(low | (128 if number else 0))
        if not number:
            return bytes(out)


def packet(kind: int, body: bytes = b"") -> bytes:
    """A packet with its true length; `kind` is its first byte."""
    return bytes([kind]) + variable(len(body)) + body


def publish(topic: bytes, payload: bytes = b"", *, qos: int = 0, number: int = 1, properties: bytes = b"") -> bytes:
    """A PUBLISH in MQTT 5."""
    head = struct.pack("!H", len(topic)) + topic + (struct.pack("!H", number) if qos else b"")
    return packet(0x30 | qos << 1, head + variable(len(properties)) + properties + payload)


def huge(kind: int, length: int) -> Iterator[bytes]:
    """A packet of so many bytes, all of which are sent."""
    yield bytes([kind]) + variable(length) + b"\0\1a"
    for _ in range(0, length, len(CHUNK)):
        yield CHUNK


class HostileBroker:
    """Listens on `port`; `async with` its `listening`.

    Args:
        attack: what each connection gets.
        level: of MQTT; a client that speaks 5 to one of level 4 is told so.
        greets: whether it accepts the connection and grants both subscriptions first, as a good broker does.
        reads: whether it goes on reading what the client sends.
        context: for TLS.
    """

    def __init__(
        self,
        attack: Attack,
        *,
        level: int = 5,
        greets: bool = True,
        reads: bool = True,
        context: ssl.SSLContext | None = None,
    ) -> None:
        self.attack, self.level, self.greets, self.reads, self.context = attack, level, greets, reads, context
        self.port = 0
        self.connections = 0
        self.sent = 0
        """Bytes of the attack that the kernel took, over all connections."""

    @contextlib.asynccontextmanager
    async def listening(self) -> AsyncIterator[HostileBroker]:
        """Serve."""
        tasks: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

        def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            tasks[asyncio.create_task(self._serve(reader, writer))] = writer

        server = await asyncio.start_server(accept, "127.0.0.1", 0, ssl=self.context)
        self.port = server.sockets[0].getsockname()[1]
        try:
            yield self
        finally:
            server.close()
            for task, writer in tasks.items():
                task.cancel()
                writer.transport.abort()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        reading: asyncio.Task[None] | None = None
        try:
            _, connect = await _packet_from(reader)
            if connect[6] != self.level:
                writer.write(packet(0x20, b"\0\x84\0"))
                await writer.drain()
                return
            if self.greets:
                writer.write(packet(0x20, b"\0\0\0"[: self.level - 2]))
                for _ in range(2):
                    await self._polite(reader, writer)
            if self.reads:
                reading = asyncio.create_task(self._for_ever_polite(reader, writer))
            for piece in self.attack():
                writer.write(piece)
                await writer.drain()
                self.sent += len(piece)
            await asyncio.get_running_loop().create_future()
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client has had enough
        finally:
            if reading is not None:
                reading.cancel()
            writer.transport.abort()

    async def _for_ever_polite(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            while True:
                await self._polite(reader, writer)

    async def _polite(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one packet of the client as it wants it."""
        kind, body = await _packet_from(reader)
        if kind == 0x82:
            writer.write(packet(0x90, body[:2] + b"\0" * (self.level == 5) + b"\1"))
        elif kind == 0xC0:
            writer.write(packet(0xD0))
        elif kind & 0xF6 == 0x32:
            (length,) = struct.unpack_from("!H", body)
            writer.write(packet(0x40, body[2 + length : 4 + length]))


async def _packet_from(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    (kind,) = await reader.readexactly(1)
    length = shift = 0
    while True:
        (byte,) = await reader.readexactly(1)
        length |= (byte & 127) << shift
        shift += 7
        if not byte & 128:
            return kind, await reader.readexactly(length)
