"""One MAVLink port of the double: its own sequence numbers, streams and bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Message = mavlink.MAVLink_message
MAX_INTERVALS = 10
"""Different stream intervals that one port can keep; the next one gets the nearest of these."""


@dataclass(slots=True)
class Stream:
    """One message that is sent by itself."""

    interval_s: float
    next_s: float


class Channel:
    """An `End` as tests/support/wire.py means it: attach how to send, receive what came."""

    def __init__(self, system_id: int, handle: Callable[[Channel, Message, float], None]) -> None:
        self.received: Counter[str] = Counter()
        """Messages by name, and "bad" for bytes that are none."""
        self.sent: Counter[str] = Counter()
        self.streams: dict[int, Stream] = {}
        """By message id."""
        self.listing = False
        """A parameter list is under way: streams go at a quarter of their rate."""
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=1)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], None] | None = None
        self._handle = handle

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Give the function that sends bytes, or None to pull the plug."""
        self._transmit = transmit
        self._codec.buf = bytearray()
        self._codec.buf_index = 0

    @property
    def attached(self) -> bool:
        """Whether anything is plugged in."""
        return self._transmit is not None

    def receive(self, data: bytes, t_s: float) -> None:
        """Take bytes; never raises, whatever they are."""
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
        """Pack with this port's sequence number and send; nothing happens when nothing is plugged in."""
        if self._transmit is None:
            return
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.sent[message.get_type()] += 1
        self._transmit(data)

    def forward(self, data: bytes) -> None:
        """Send somebody else's packet unchanged."""
        if self._transmit is not None:
            self._transmit(data)

    def set_stream(self, message_id: int, interval_s: float | None, now_s: float) -> None:
        """Start, change or (None) stop a stream; an interval beyond the ten kept becomes the nearest of them."""
        if interval_s is None:
            self.streams.pop(message_id, None)
            return
        kept = {stream.interval_s for other, stream in self.streams.items() if other != message_id}
        if interval_s not in kept and len(kept) >= MAX_INTERVALS:
            wanted_s = interval_s
            interval_s = min(kept, key=lambda value: abs(value - wanted_s))
        self.streams[message_id] = Stream(interval_s, now_s + interval_s)

    def due(self, now_s: float) -> list[int]:
        """Message ids whose time has come; a stream that fell behind skips, it never bursts."""
        due = []
        for message_id, stream in self.streams.items():
            if stream.next_s <= now_s + 1e-9:
                due.append(message_id)
                interval = stream.interval_s * (4.0 if self.listing else 1.0)
                stream.next_s += interval
                if stream.next_s <= now_s:
                    stream.next_s = now_s + interval
        return due

    def next_due_s(self) -> float | None:
        """When the next stream wants to be sent."""
        return min((stream.next_s for stream in self.streams.values()), default=None)
