"""Between the broker and aiomqtt: what the broker sends is judged before the library reads any of it.

The library takes a packet of whatever length, and as many as come. So the connection to the broker is ours, and the
library speaks to a local socket (its transport "unix") that gets only what passes here. Nothing of MQTT is decoded
but what a packet is, where it ends, and where its properties lie.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
import struct
from typing import Final, Self

from companion.errors import LinkError
from companion.links.system.connection import Budget, connect

CONNECT_DEADLINE_S: Final = 8.0
"""For the name, the connection and TLS together; a resolver whose first server is dead takes five."""
LEAVE_DEADLINE_S: Final = 1.0
MAX_PACKET_BYTES: Final = 64 * 1024
"""That the broker may send us; told to it where it speaks MQTT 5."""
MAX_GREETING_BYTES: Final = 1024
"""The longest greeting, the only packet whose properties the library decodes (some 30 us a byte on a PC)."""
BYTES_PER_S: Final = 64 * 1024
"""The rate that is taken for long; the rest waits at the broker."""
PACKET_COST_BYTES: Final = 256
"""What a packet counts beyond its length: even the shortest is work."""
FLOOD_S: Final = 4.0
"""A flood that lasts so long ends the connection, before the answer that is lost behind it is missed."""
QUIET_S: Final = 2.0
"""How long within bounds ends a flood."""

CONNACK: Final = 0x20
PUBLISH: Final = 0x30
PUBACK: Final = 0x40
SUBACK: Final = 0x90
PINGRESP: Final = 0xD0
DISCONNECT: Final = 0xE0
"""First bytes of all that a broker has to say to one that publishes and subscribes with QoS 0 and 1 (MQTT 5, 2.1)."""
_QOS: Final = 0x06
_QOS_2: Final = 0x04
_MQTT_5: Final = 5
_DIGITS: Final = 4


class BrokerFaultError(LinkError):
    """The broker sends what is not taken here."""


class NoGreetingError(LinkError):
    """What listens there took the connection and did not say what a broker says first."""


class MqttFilter:
    """A connection to a broker, and at `address` a local socket for the library; `async with` it."""

    def __init__(self, host: str, port: int, context: ssl.SSLContext | None, protocol: int) -> None:
        self._host, self._port, self._context, self._protocol = host, port, context, protocol
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._greeted = False
        self.fault: BaseException | None = None
        """Why the connection was ended here: a `BrokerFaultError`, a `NoGreetingError` or an `OSError`."""
        self.receipt = 0
        """The reason code of the broker's last receipt, which the library does not show; 128 or more: a refusal."""

    async def __aenter__(self) -> Self:
        """Reach the broker; raises OSError where that or TLS fails, UnicodeError where the host cannot be a name."""
        try:
            async with asyncio.timeout(CONNECT_DEADLINE_S):
                connection = socket.socket(fileno=await connect(self._host, self._port))
                reader, self._writer = await asyncio.open_connection(
                    sock=connection,
                    ssl=self._context,
                    server_hostname=self._host if self._context else None,
                    limit=MAX_PACKET_BYTES,
                )
        except BaseException:
            self._listener.close()
            raise
        # What waits in the kernel is memory, too.
        self._writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, MAX_PACKET_BYTES)
        # A name that the kernel makes up, in no folder: nothing is left behind, whatever ends us.
        self._listener.bind("")
        self._listener.listen()
        self._listener.setblocking(False)  # noqa: FBT003
        self._carrying = asyncio.get_running_loop().create_task(self._carry(reader, self._writer), name="mqtt filter")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Let the library's last words through, if it has left, and end both connections."""
        await asyncio.wait([self._carrying], timeout=LEAVE_DEADLINE_S)
        self._carrying.cancel()
        await asyncio.gather(self._carrying, return_exceptions=True)
        self._listener.close()
        await _close(self._writer)

    def hang_up(self) -> None:
        """Leave the broker without a word; the library is refused, or loses its connection."""
        self._writer.transport.abort()

    @property
    def address(self) -> str:
        """Where the library finds the broker."""
        return os.fsdecode(self._listener.getsockname())

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Until either side ends the connection, or the broker sends what is not taken."""
        library: asyncio.StreamWriter | None = None
        tasks: list[asyncio.Task[None]] = []
        try:
            from_library, library = await asyncio.open_connection(sock=await self._accepted())
            # It connects in a thread, which is done with its socket when it has spoken: nothing is said to it before.
            writer.write(await from_library.read(MAX_PACKET_BYTES))
            tasks += [
                asyncio.create_task(self._inwards(reader, library, writer), name="mqtt in"),
                asyncio.create_task(_outwards(from_library, writer), name="mqtt out"),
            ]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if tasks[0].done():
                self.fault = tasks[0].exception()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if library is not None:
                if not self._greeted:
                    # The library would wait to its deadline for a greeting that does not come: this one refuses.
                    library.write(b"\x20\x03\0\x88\0" if self._protocol >= _MQTT_5 else b"\x20\x02\0\x03")
                await _close(library)

    async def _accepted(self) -> socket.socket:
        """The library's connection; others on this computer can find the address, too, and are sent away."""
        while True:
            connection, _ = await asyncio.get_running_loop().sock_accept(self._listener)
            credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
            if struct.unpack("3i", credentials)[0] == os.getpid():
                return connection
            connection.close()

    async def _inwards(
        self, reader: asyncio.StreamReader, library: asyncio.StreamWriter, writer: asyncio.StreamWriter
    ) -> None:
        """Hand packets to the library until the broker ends the connection; what is not taken raises."""
        loop = asyncio.get_running_loop()
        budget, flood_since_s = Budget(BYTES_PER_S, BYTES_PER_S), 0.0
        library.transport.set_write_buffer_limits(0)
        try:
            while True:
                kind, body = await self._packet(reader)
                cost, now_s, before_s = len(body) + PACKET_COST_BYTES, loop.time(), budget.exceeded_s
                if not budget.spend(cost, now_s):
                    if before_s is None or now_s - before_s > QUIET_S:
                        flood_since_s = now_s
                    elif now_s - flood_since_s > FLOOD_S:
                        raise BrokerFaultError(f"the broker floods: too many messages for {FLOOD_S:.0f} s")
                    await asyncio.sleep(cost / BYTES_PER_S)
                # A broker that takes nothing of what is owed to it gets nothing more to be owed.
                await writer.drain()
                library.write(self._passed_on(kind, body))
                self._greeted = True
                await library.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            if not self._greeted:
                raise NoGreetingError("the broker closes the connection without a word") from None

    async def _packet(self, reader: asyncio.StreamReader) -> tuple[int, bytes]:
        """The next packet: its first byte, and its body."""
        (kind,) = await reader.readexactly(1)
        if not self._greeted and kind != CONNACK:
            raise NoGreetingError("what listens there does not speak MQTT")
        if self._greeted and not _is_wanted(kind):
            raise BrokerFaultError(f"the broker sends a packet that nobody asked for (0x{kind:02x})")
        digits = b""
        while not digits or digits[-1] & 0x80:
            if len(digits) == _DIGITS:
                raise BrokerFaultError("the broker sends a packet whose length has no end")
            digits += await reader.readexactly(1)
        length = _number(digits)
        most = MAX_PACKET_BYTES if self._greeted else MAX_GREETING_BYTES
        if length > most:
            raise BrokerFaultError(
                f"the broker sends a message of {_size(length)}; at most {most // 1024} kB are taken"
            )
        return kind, await reader.readexactly(length)

    def _passed_on(self, kind: int, body: bytes) -> bytes:
        """A packet as the library gets it: without properties."""
        if kind == PUBACK:
            self.receipt = body[2] if len(body) > 2 else 0
        try:
            at = _properties_at(kind, body)
            if self._protocol >= _MQTT_5 and len(body) > at:
                body = _without_properties(body, at)
        except ValueError:  # of which a text that is no UTF-8 is one
            raise BrokerFaultError(f"the broker sends a packet that is not MQTT (0x{kind:02x})") from None
        return bytes([kind]) + _digits(len(body)) + body


def _is_wanted(kind: int) -> bool:
    """Whether a packet after the greeting, by its first byte, is one that a broker has to send us."""
    if kind & 0xF0 == PUBLISH:
        return kind & _QOS < _QOS_2
    return kind in (PUBACK, SUBACK, PINGRESP, DISCONNECT)


def _properties_at(kind: int, body: bytes) -> int:
    """Where the properties begin, of which nothing is made here; behind the body: nowhere.

    The library takes long to decode them. A topic that is none, at which it would stumble, is a ValueError.
    """
    if kind & 0xF0 != PUBLISH:
        return {PUBACK: 3, SUBACK: 2, DISCONNECT: 1}.get(kind, len(body))
    end = 2 + int.from_bytes(body[:2])
    topic = body[2:end].decode()
    end += 2 if kind & _QOS else 0
    if not topic or end > len(body) or "+" in topic or "#" in topic:
        raise ValueError(topic)
    return end


def _without_properties(body: bytes, at: int) -> bytes:
    digits = next((size for size in range(1, _DIGITS + 1) if body[at + size - 1 : at + size] < b"\x80"), _DIGITS)
    end = at + digits + _number(body[at : at + digits])
    if end > len(body):
        raise ValueError(end)
    return body[:at] + b"\0" + body[end:]


def _number(digits: bytes) -> int:
    """A length as MQTT writes it: seven bits a byte, the lowest first."""
    return sum((byte & 0x7F) << 7 * place for place, byte in enumerate(digits))


def _digits(number: int) -> bytes:
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*digits, number])


def _size(length: int) -> str:
    return f"{length / 1e6:.0f} MB" if length >= 1e6 else f"{length / 1e3:.1f} kB"


async def _outwards(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(ConnectionError):
        while data := await reader.read(MAX_PACKET_BYTES):
            writer.write(data)
            await writer.drain()


async def _close(side: asyncio.StreamWriter) -> None:
    """Close, and wait until the other side has what was written, if it takes it."""
    side.close()
    try:
        async with asyncio.timeout(LEAVE_DEADLINE_S):
            await side.wait_closed()
    except (OSError, TimeoutError):
        side.transport.abort()
