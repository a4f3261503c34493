"""A MAVLink wire that does whatever wires, radios and neighbours do; all seeded."""

from __future__ import annotations

import asyncio
import contextvars
import random
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.station import End
from tests.support.wire import Wire

Packet = mavlink.MAVLink_message


class RoughWire(Wire):
    """A `Wire` that gets worse on request: every field may be changed at any time."""

    def __init__(self, one: End, other: End, *, seed: int = 0) -> None:
        super().__init__(one, other, seed=seed)
        self.reorder = 0.0
        """Probability that a packet is overtaken by those of the next 0.2 s."""
        self.tear = 0.0
        """Probability that the second half of a packet never comes."""
        self.flip = 0.0
        """Probability that a byte of a packet is another one."""
        self.late_s = 0.0
        """All packets are late by so much."""
        self.change: Callable[[bytes, bool], bytes | None] | None = None
        """Changes a packet under way (True: to the companion); None: lost."""
        self.context = contextvars.copy_context()
        """In which the companion's end gets its packets."""
        self.seen: Callable[[bytes, bool, float], None] = lambda data, inbound, t_s: None
        """Called with everything the companion sends and receives."""

    def inject(self, data: bytes) -> None:
        """Put bytes on the wire towards the companion's end, now."""
        loop = asyncio.get_running_loop()
        loop.call_later(0.0005, self._deliver, data, self._ends[0])

    def _carry(self, data: bytes, to: End) -> None:
        inbound = to is self._ends[0]
        if not inbound:
            self.seen(data, False, asyncio.get_running_loop().time())
        if self.change is not None:
            changed = self.change(data, inbound)
            if changed is None:
                return
            data = changed
        rough = self._random.random
        if self.tear and rough() < self.tear:
            data = data[: max(1, int(len(data) * rough()))]
        if self.flip and rough() < self.flip:
            at = int(rough() * len(data))
            data = data[:at] + bytes([data[at] ^ (1 << int(rough() * 8))]) + data[at + 1 :]
        if self.reorder and rough() < self.reorder and not self.cut:
            asyncio.get_running_loop().call_later(0.2 * rough(), self._deliver, data, to)
            return
        self.delay_s = (0.001 + self.late_s, 0.003 + self.late_s)
        super()._carry(data, to)

    def _deliver(self, data: bytes, to: End) -> None:
        if not self.cut and to is self._ends[0]:
            self.seen(data, True, asyncio.get_running_loop().time())
        if to is self._ends[0]:
            # What the daemon starts while it handles a message is the daemon's, and counted with it.
            self.context.run(super()._deliver, data, to)
        else:
            super()._deliver(data, to)


class Stranger:
    """Another station on the network: packs messages under any ids."""

    def __init__(self, wire: Callable[[], RoughWire], system: int, component: int) -> None:
        self._wire = wire
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, message: Packet, *, version_1: bool = False) -> bytes:
        data: bytes = message.pack(self._codec, force_mavlink1=version_1)
        self._codec.seq = (self._codec.seq + 1) % 256
        return data

    def say(self, message: Packet) -> None:
        self._wire().inject(self.pack(message))

    def beat(self, *, kind: int = mavlink.MAV_TYPE_QUADROTOR, autopilot: int = 3, armed: bool = False) -> None:
        self.say(mavlink.MAVLink_heartbeat_message(kind, autopilot, 128 if armed else 0, 0, 4, 3))


def malformed(chance: random.Random) -> bytes:
    """Bytes that begin as MAVLink does and are none, or are what nobody expects."""
    kind = chance.randrange(8)
    payload = chance.randbytes(chance.randrange(0, 256))
    if kind == 0:  # the largest there is, checksum wrong
        return b"\xfd\xff\x00\x00\x01\x01\x01" + chance.randbytes(3 + 255 + 2)
    if kind == 1:  # flags that nobody knows
        return b"\xfd" + bytes([len(payload), chance.randrange(2, 256), 0, 1, 1, 1, 0, 0, 0]) + payload + b"\0\0"
    if kind == 2:  # a message of no dialect
        return b"\xfd" + bytes([len(payload), 0, 0, 1, 1, 1, 0xEE, 0xEE, 0xEE]) + payload + b"\x12\x34"
    if kind == 3:  # version 1, any length, any message
        return b"\xfe" + bytes([len(payload), 1, 1, 1, chance.randrange(256)]) + payload + b"\x12\x34"
    if kind == 4:  # a heartbeat of our autopilot, right but for its checksum
        return b"\xfd\x09\x00\x00\x01\x01\x01\x00\x00\x00" + bytes([0, 0, 0, 0, 2, 3, 128, 4, 3]) + b"\xff\xff"
    if kind == 5:  # a header and nothing
        return b"\xfd"
    if kind == 6:
        return payload
    # A right message whose payload is longer than it may be: from a newer dialect.
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    text = mavlink.MAVLink_statustext_message(6, b"a newer autopilot", 0, 0)
    body = text.pack(codec)[10:-2] + b"\x01\x02\x03"
    head = bytes([len(body), 0, 0, chance.randrange(256), 1, 1, 253, 0, 0])
    crc = mavlink.x25crc(head + body + bytes([text.crc_extra])).crc
    return b"\xfd" + head + body + bytes([crc & 255, crc >> 8])
