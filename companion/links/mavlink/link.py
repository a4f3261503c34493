"""MAVLink on one link: packing, parsing, sequence numbers, and subscriptions.

The codec is pymavlink's dialect class; `mavutil` blocks, prints, and weighs 41 MiB. A transport hands received bytes
to `receive` and gives `attach` a function that sends.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Literal, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.signing import NEVER_SIGNED, Signing
from companion.links.system.listeners import Listeners, Unsubscribe

Codec = mavlink.MAVLink
Message = mavlink.MAVLink_message
Kind = type[Message]
M = TypeVar("M", bound=mavlink.MAVLink_message)
Handler = Callable[[M, float], None]
Direction = Literal["in", "out"]
Sender = tuple[int, int]

_COMPACT_BYTES = 4096
_ANYBODYS = frozenset(mavlink.mavlink_map[number].msgname for number in NEVER_SIGNED)


class MavlinkLink:
    """One MAVLink connection as one component sees it, under the system id of the autopilot that was latched."""

    def __init__(self, *, system_id: int = 1, component_id: int = 191) -> None:
        self.component_id = component_id
        self.turns = 0
        self.received: Counter[str] = Counter()
        """Messages by type, plus "bad" (failed checks), "unknown" (not in the dialect) and "handler error"."""
        self.sent = 0
        self.dropped = 0
        self.signing: Signing | None = None
        self.autopilot: Sender | None = None
        self._codec: Codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], object] | None = None
        self._settled: Callable[[], bool] = lambda: True
        self._attached = 0
        self._handlers: dict[str, Listeners[Message, float]] = {}
        self.on_bytes: Listeners[Direction, bytes | None, float | None] = Listeners()

    @property
    def system_id(self) -> int:
        """The system id under which we send."""
        return self._codec.srcSystem

    def join(self, autopilot: Sender) -> None:
        """Belong to this autopilot's vehicle from here on: we send under its system id."""
        self.autopilot = autopilot
        self._codec.srcSystem = autopilot[0]

    @property
    def half_received(self) -> bytes:
        """Bytes of a message that is not complete yet."""
        return bytes(self._codec.buf[self._codec.buf_index :])

    @property
    def connected(self) -> bool:
        """Whether a transport is attached; says nothing of a peer behind it."""
        return self._transmit is not None

    def turn(self) -> None:
        """Count a turn of the transport's loop."""
        self.turns += 1

    def attach(self, transmit: Callable[[bytes], object] | None, settled: Callable[[], bool] = lambda: True) -> None:
        """Give the function that sends (False: its buffer is full), or None, and the transport's part of `settled`."""
        self._transmit, self._settled = transmit, settled
        self._attached += 1
        self._forget_received()
        self.on_bytes.tell("in", None, None)

    def settled(self) -> bool:
        """Receive all that has come over the wire; False: more and more comes, or something still waits to leave."""
        return self._settled()

    def send(self, message: mavlink.MAVLink_message, allowed: Callable[[], bool] = lambda: True, /) -> bool:
        """Send a message now; False, and counted, when no transport is attached or its buffer is full.

        `allowed` is asked as the last thing before the bytes leave.
        """
        data = message.pack(self._codec)
        if self.signing is not None:
            data = self.signing.sign(data, message.crc_extra)
        if not allowed() or self._transmit is None:
            self.dropped += 1
            return False
        left = self._transmit(data) is not False
        if self.on_bytes:
            self.on_bytes.tell("out", data, None)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.dropped += not left
        self.sent += left
        return left

    def subscribe(self, kind: type[M], handler: Handler[M]) -> Unsubscribe:
        """Call `handler(message, t_s)` for every message of a kind, whoever sent it; returns how to stop that."""
        return self._handlers.setdefault(kind.msgname, Listeners()).add(handler)  # type: ignore[arg-type]

    def receive(self, data: bytes, t_s: float) -> None:
        """Take bytes of a stream that arrived at `t_s` (monotonic); never raises, whatever they are."""
        if self.on_bytes:
            self.on_bytes.tell("in", data, t_s)
        attached = self._attached
        for message in self._frames(data):
            self._dispatch(message, t_s)
            if self._attached != attached:
                return  # what came over another transport ends here
        # The codec frees its buffer only when a read happens to end on a frame's end; a busy serial link may not
        # do that for hours.
        if self._codec.buf_index > _COMPACT_BYTES:
            del self._codec.buf[: self._codec.buf_index]
            self._codec.buf_index = 0

    def receive_datagram(self, datagram: bytes, t_s: float, admit: Callable[[Sender], None]) -> None:
        """Parse a datagram of whole messages; `admit` learns each sender before its message has any effect.

        A radio's own messages are not admitted by anybody: they come without a signature.
        """
        if self.on_bytes:
            self.on_bytes.tell("in", datagram, t_s)
        frames = list(self._frames(datagram))
        if self.half_received:
            self.received["bad"] += 1
            self.on_bytes.tell("in", None, None)
        self._forget_received()
        for message in frames:
            if message.get_type() not in _ANYBODYS:
                admit((message.get_srcSystem(), message.get_srcComponent()))
            self._dispatch(message, t_s)

    def _frames(self, data: bytes) -> Iterator[Message]:
        """Messages that are whole and admitted."""
        message = self._next_message(data)
        while message is not None:
            if self._admits(message):
                yield message
            message = self._next_message(b"")

    def _admits(self, message: Message) -> bool:
        if message.get_type() == "BAD_DATA":
            self.received["bad"] += 1
            return False
        if isinstance(message, mavlink.MAVLink_unknown):
            # One counter for all: noise can look like any of 16 million message ids.
            self.received["unknown"] += 1
            return False
        return self.signing is None or self.signing.admits(message.get_msgbuf())

    def signed_on(self, message: Message) -> int | None:
        """The sender's link id in a message that is signed with our key; None where it is not, or nobody judges."""
        return None if self.signing is None else self.signing.link_id_of(message.get_msgbuf())

    def _next_message(self, data: bytes) -> mavlink.MAVLink_message | None:
        try:
            return self._codec.parse_char(data)
        except Exception:  # noqa: BLE001 - the generated parser's own faults must not reach the loop
            self.received["bad"] += 1
            self._forget_received()
            return None

    def _forget_received(self) -> None:
        self._codec.buf = bytearray()
        self._codec.buf_index = 0

    def _dispatch(self, message: Message, t_s: float) -> None:
        name = message.get_type()
        self.received[name] += 1
        if name in self._handlers and (failed := self._handlers[name].tell(message, t_s)):
            self.received["handler error"] += failed
