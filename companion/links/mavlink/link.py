"""MAVLink on one link: packing, parsing, sequence numbers, and subscriptions.

The codec is pymavlink's dialect class, because `mavutil` blocks, prints, and costs 41 MiB. A transport passes received
bytes to `receive` and its `send` to `attach`. Frames without a subscriber are not decoded (`kind_at`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.signing import NEVER_SIGNED, Signing
from companion.links.system.events import Listeners, Unsubscribe

Codec = mavlink.MAVLink
Message = mavlink.MAVLink_message
Kind = type[Message]
M = TypeVar("M", bound=mavlink.MAVLink_message)
Handler = Callable[[M, float], None]
Direction = Literal["in", "out"]
Sender = tuple[int, int]

_COMPACT_BYTES = 4096
_ANYBODYS = frozenset(mavlink.mavlink_map[number].msgname for number in NEVER_SIGNED)


def kind_at(data: bytes, at: int) -> tuple[Kind, int] | None:
    """Return the message type and end offset of a whole, valid, unsigned MAVLink 2 frame; None for anything else."""
    if len(data) - at < 12 or data[at] != mavlink.PROTOCOL_MARKER_V2 or data[at + 2]:
        return None
    end = at + 12 + data[at + 1]
    kind: Kind | None = mavlink.mavlink_map.get(int.from_bytes(data[at + 7 : at + 10], "little"))
    if kind is None or end > len(data):
        return None
    checksum = mavlink.x25crc(data[at + 1 : end - 2] + bytes((kind.crc_extra,))).crc
    return (kind, end) if checksum == int.from_bytes(data[end - 2 : end], "little") else None


class MavlinkLink:
    """One MAVLink connection of one component, which sends under the system id of its autopilot."""

    def __init__(self, *, system_id: int = 1, component_id: int = 191) -> None:
        self.component_id = component_id
        self.turns = 0
        self.received: Counter[str] = Counter()
        """Counts of messages by type, and of "bad" (failed checks), "unknown" (not in the dialect), "handler error"."""
        self.sent = 0
        self.dropped = 0
        self.signing: Signing | None = None
        self.autopilot: Sender | None = None
        self.fault: str | None = None  # Reason why the port or socket is not open; None while it is open
        self._codec: Codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], object] | None = None
        self._settled: Callable[[], bool] = lambda: True
        self._attached = 0
        self._handlers: dict[str, Listeners[Message, float]] = {}
        self.on_bytes: Listeners[Direction, bytes | None, float | None] = Listeners()

    @property
    def system_id(self) -> int:
        return self._codec.srcSystem

    def join(self, autopilot: Sender) -> None:
        """Send all later messages under the system id of this autopilot."""
        self.autopilot = autopilot
        self._codec.srcSystem = autopilot[0]

    def is_for_us(self, message: Any) -> bool:
        """Check that a message is for this component, or for all (target 0, as in answers of older firmware)."""
        return message.target_system in (0, self.system_id) and message.target_component in (0, self.component_id)

    @property
    def half_received(self) -> bytes:
        return bytes(self._codec.buf[self._codec.buf_index :])

    @property
    def connected(self) -> bool:
        return self._transmit is not None

    def turn(self) -> None:
        self.turns += 1

    def attach(self, transmit: Callable[[bytes], object] | None, settled: Callable[[], bool] = lambda: True) -> None:
        """Set or remove a transport. `transmit` sends (False: buffer full), `settled` receives all waiting data."""
        self._transmit, self._settled = transmit, settled
        self._attached += 1
        self._forget_received()
        self.on_bytes.tell("in", None, None)

    def settled(self) -> bool:
        """Receive all waiting data. Return False if more keeps coming or output is still waiting to be sent."""
        return self._settled()

    def send(self, message: mavlink.MAVLink_message, allowed: Callable[[], bool] = lambda: True, /) -> bool:
        """Send a message now; False: not allowed, no transport is attached, or its buffer is full.

        `allowed` is called last, directly before the bytes are sent.
        """
        data = message.pack(self._codec)
        if self.signing is not None:
            data = self.signing.sign(data, message.crc_extra)
        if not allowed() or self._transmit is None:
            self.dropped += 1
            return False
        left = self._transmit(data) is not False
        self.on_bytes.tell("out", data, None)
        self._codec.seq = (self._codec.seq + 1) % 256
        self.dropped += not left
        self.sent += left
        return left

    def subscribe(self, kind: type[M], handler: Handler[M]) -> Unsubscribe:
        return self._handlers.setdefault(kind.msgname, Listeners()).add(handler)  # type: ignore[arg-type]

    def receive(self, data: bytes, t_s: float) -> None:
        """Handle bytes of a stream that arrived at `t_s` (monotonic). Never raises, whatever the bytes contain."""
        self.on_bytes.tell("in", data, t_s)
        attached = self._attached
        for name, _, message in self._frames(data):
            self._dispatch(name, message, t_s)
            if self._attached != attached:
                return  # a handler replaced the transport: drop the remaining bytes of the old one
        # The codec frees its buffer only when a read happens to end at the end of a frame. On a busy serial link that
        # may not happen for hours.
        if self._codec.buf_index > _COMPACT_BYTES:
            del self._codec.buf[: self._codec.buf_index]
            self._codec.buf_index = 0

    def receive_datagram(self, datagram: bytes, t_s: float, admit: Callable[[Sender], None]) -> None:
        """Handle a datagram of whole messages; `admit` is called with each sender before its message has any effect.

        `admit` is not called for a telemetry radio's own messages, which carry no signature.
        """
        self.on_bytes.tell("in", datagram, t_s)
        frames = list(self._frames(datagram))
        if self.half_received:
            self.received["bad"] += 1
            self.on_bytes.tell("in", None, None)
        self._forget_received()
        for name, sender, message in frames:
            if name not in _ANYBODYS:
                admit(sender)
            self._dispatch(name, message, t_s)

    def _frames(self, data: bytes) -> Iterator[tuple[str, Sender, Message | None]]:
        """Yield name, sender and message of each valid frame; the message is None if nobody has subscribed to it.

        From the first frame that `kind_at` does not recognise, the codec gets all remaining bytes.
        """
        if self._codec.buf:
            data = self.half_received + data
            self._forget_received()
        at = 0
        while self.signing is None and (found := kind_at(data, at)) is not None:
            kind, end = found
            message = None
            if self._handlers.get(kind.msgname):
                try:
                    message = self._codec.decode(bytearray(data[at:end]))
                except mavlink.MAVError:
                    break
            yield kind.msgname, (data[at + 5], data[at + 6]), message
            at = end
        if at == len(data):
            return
        message = self._next_message(data[at:])
        while message is not None:
            if self._admits(message):
                yield message.get_type(), (message.get_srcSystem(), message.get_srcComponent()), message
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
        """Return the link id of a message that is signed with our key; None for other messages or without signing."""
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

    def _dispatch(self, name: str, message: Message | None, t_s: float) -> None:
        self.received[name] += 1
        if message is not None and name in self._handlers and (failed := self._handlers[name].tell(message, t_s)):
            self.received["handler error"] += failed
