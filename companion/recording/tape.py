"""The queue between the event loop, where things happen, and the thread that writes them to the disk."""

from __future__ import annotations

from typing import Final

from companion.recording.messages import START, Message, Start, encode

MOST_MESSAGES: Final = 12_000
"""The most messages that wait: 15 s of a 200 Hz IMU beside 100 Hz telemetry, longer than a memory card stalls."""
MOST_BYTES: Final = 2 * 1024 * 1024
"""The most bytes among them: 15 s of an IMU at 1 kHz have 1.4 MB."""


class Tape:
    """Bounded queue. What finds no room is dropped together with all that waits: no replay bridges a gap."""

    def __init__(self) -> None:
        self.is_on = False
        """True: messages are kept; states always are."""
        self.lost = 0
        """Messages dropped since `begin`; while there are any, nothing is taken."""
        self.lost_in_all = 0
        self._waiting: list[Message] = []
        self._bytes = 0
        self._states: dict[str, Message] = {}
        """The latest state by topic."""
        self._since_s = 0.0
        self._states_before: list[Message] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def begin(self, t_s: float) -> None:
        """Take messages from here on."""
        self._waiting = [(START, t_s, encode(Start(lost=self.lost))), *self._states.values()]
        self.is_on, self.lost, self._bytes = True, 0, 0
        self._since_s, self._states_before = t_s, []

    def end(self) -> None:
        """Take no more messages."""
        self.is_on, self.lost, self._bytes, self._waiting = False, 0, 0, []

    def drain(self, now_s: float) -> tuple[float, list[Message], list[Message]]:
        """Return all messages that wait, after their beginning and the states in force then."""
        batch = self._since_s, self._states_before, self._waiting
        self._since_s, self._states_before = now_s, list(self._states.values())
        self._waiting, self._bytes = [], 0
        return batch

    def put(self, topic: str, t_s: float, data: bytes) -> None:
        """Add a message."""
        if not self.is_on:
            return
        if self.lost:
            self._lose(1)
        elif len(self._waiting) >= MOST_MESSAGES or self._bytes + len(data) > MOST_BYTES:
            self._lose(len(self._waiting) + 1)
            self._waiting, self._bytes = [], 0
        else:
            self._bytes += len(data)
            self._waiting.append((topic, t_s, data))

    def put_state(self, topic: str, t_s: float, data: bytes) -> None:
        """Add a message that stays in force until the next on its topic, so that later files begin with it."""
        self._states[topic] = (topic, t_s, data)
        self.put(topic, t_s, data)

    def _lose(self, number: int) -> None:
        self.lost += number
        self.lost_in_all += number


_ID: Final = (256).to_bytes(3, "little")
"""Message id of SETUP_SIGNING in a MAVLink 2 header; MAVLink 1 has no such id."""
_ID_AT: Final = 7
_HEADER: Final = 10
_MARKER: Final = 0xFD


class KeyFilter:
    """Replaces the payload of SETUP_SIGNING by zeros: autopilots forward it to us, and a recording may be shared.

    For one direction of one link; give it all bytes in their order.
    """

    def __init__(self) -> None:
        self._before = b""
        self._left = 0
        """Bytes of such a payload that are still to come."""

    def __call__(self, data: bytes) -> bytes:
        """Return the same bytes without keys."""
        known = self._before + data
        self._before = known[1 - _HEADER :]
        if not self._left and _ID not in known:
            return data
        return self._blank(known, len(known) - len(data))

    def restart(self) -> None:
        """Forget what was half received: some bytes are missing here."""
        self._before, self._left = b"", 0

    def _blank(self, known: bytes, behind: int) -> bytes:
        out = bytearray(known)
        end = behind + self._left
        out[behind:end] = bytes(min(self._left, len(out) - behind))
        place = known.find(_ID)
        while place >= 0:
            start = place - _ID_AT
            if start >= 0 and known[start] == _MARKER:
                payload, end_here = start + _HEADER, start + _HEADER + known[start + 1]
                out[payload:end_here] = bytes(max(0, min(end_here, len(out)) - payload))
                end = max(end, end_here)
            place = known.find(_ID, place + 1)
        self._left = max(0, end - len(known))
        return bytes(out[behind:])
