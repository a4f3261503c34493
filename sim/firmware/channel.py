"""A MAVLink port of a double (sequence numbers, streams, bytes), and received commands and writes.

The firmware decides when streams are due.
"""

from __future__ import annotations

import abc
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Message = mavlink.MAVLink_message


@dataclass(slots=True)
class Stream:
    """One message type that is sent periodically."""

    interval_s: float
    next_s: float


class Channel(abc.ABC):
    """An `End` for tests/support/wire.py: `attach` sets the way to send, `receive` handles bytes."""

    UNSIGNED: tuple[int, ...] = (mavlink.MAVLINK_MSG_ID_RADIO, mavlink.MAVLINK_MSG_ID_RADIO_STATUS)
    """Messages that need no signature on a port that requires signatures."""

    def __init__(self, system_id: int, handle: Callable[[Channel, Message, float], None]) -> None:
        self.received: Counter[str] = Counter()
        """Number of received messages by name; "bad" counts invalid bytes."""
        self.sent: Counter[str] = Counter()
        self.streams: dict[int, Stream] = {}
        self.listing = False
        """True: a parameter list is being sent."""
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], None] | None = None
        self._handle = handle

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Set the function that sends bytes, or None to pull the plug."""
        self._transmit = transmit
        self._codec.buf = bytearray()
        self._codec.buf_index = 0

    @property
    def attached(self) -> bool:
        return self._transmit is not None

    def has_room(self, size: int) -> bool:
        """Return False where the carrier has a `has_room` that refuses this many bytes."""
        room: Callable[[int], bool] | None = getattr(self._transmit, "has_room", None)
        return room is None or room(size)

    def receive(self, data: bytes, t_s: float) -> None:
        """Handle bytes; never raises."""
        try:
            messages = self._codec.parse_buffer(data) or ()
        except Exception:  # noqa: BLE001 - the generated parser's own faults on garbage
            self.received["bad"] += 1
            self._codec.buf = bytearray()
            self._codec.buf_index = 0
            return
        for message in messages:
            name = message.get_type()
            if name == "BAD_DATA":
                self.received["bad"] += 1
                continue
            self.received[name] += 1
            self._handle(self, message, t_s)

    def send(self, message: Message) -> None:
        """Pack a message with this port's sequence number and send it; do nothing while unplugged."""
        if self._transmit is None:
            return
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.sent[message.get_type()] += 1
        self._transmit(data)

    def require_signatures(self, key: bytes, ticks: int, link_id: int) -> None:
        """Sign, and accept unsigned messages only of the kinds in `UNSIGNED`, as on every port but USB.

        Uses pymavlink's own signing, which is not the companion's.

        Args:
            key: 32 bytes.
            ticks: clock of the signatures, in 10 us since 2015; without GNSS, an autopilot's clock can be far behind.
            link_id: number of this port.
        """
        signing = self._codec.signing
        signing.secret_key, signing.timestamp, signing.link_id = key, ticks, link_id
        signing.sign_outgoing = True
        signing.allow_unsigned_callback = lambda _codec, message_id: message_id in self.UNSIGNED

    def forward(self, data: bytes) -> None:
        """Send another sender's packet unchanged."""
        if self._transmit is not None:
            self._transmit(data)

    @abc.abstractmethod
    def set_stream(self, message_id: int, interval_s: float | None, now_s: float) -> None:
        """Start, change or (None) stop a stream."""

    @abc.abstractmethod
    def due(self, now_s: float) -> list[int]:
        """Return the ids of messages that are due."""

    def next_due_s(self) -> float | None:
        return min((stream.next_s for stream in self.streams.values()), default=None)


class Command(NamedTuple):
    """A received COMMAND_LONG or COMMAND_INT, and the port for the answer."""

    channel: Channel
    number: int
    params: tuple[float, ...]
    system_id: int
    component_id: int
    loop_s: float


def command_of(
    channel: Channel, message: mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message, loop_s: float
) -> Command:
    """Return the common content of the two kinds; in COMMAND_INT x, y, z are params 5 to 7."""
    first = (message.param1, message.param2, message.param3, message.param4)
    if isinstance(message, mavlink.MAVLink_command_int_message):
        params = (*first, float(message.x), float(message.y), message.z)
    else:
        params = (*first, message.param5, message.param6, message.param7)
    return Command(channel, message.command, params, message.get_srcSystem(), message.get_srcComponent(), loop_s)


class Write(NamedTuple):
    """One received PARAM_SET; tests compare the companion's writes and their times with these records."""

    t_s: float
    """Time of receipt by the loop's clock."""
    name: str
    value: float
    armed: bool
    system_id: int
    component_id: int
