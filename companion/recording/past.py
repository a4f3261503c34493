"""The seconds before now, packed in memory: a recording begins with them, so that a replay knows what the daemon knew.

They cover what a calibration is made of: the longest still stretch, and what it takes to know that it is one. What is
not needed for that (what was sent, samples that come again from their bytes) is left out.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import msgspec

from companion.recording import topics
from companion.recording.journal import Entry, in_force_key
from companion.recording.walk import decompressed

LEARNED_S: Final = 65.0
"""Seconds kept beyond the longest stretch: what the gates on stillness learn from, and the tail of a movement."""
MOST_BYTES: Final = 8 * 1024 * 1024
"""The most bytes kept, packed: 125 s of an IMU at 1 kHz are 5 MB."""
IN_FORCE: Final = frozenset({"imu", "expect", "place", "offsets"})
BREATH: Final = 64
"""Messages made between two rests, in which an event loop that waits for the interpreter's lock gets it."""
BREATH_S: Final = 2e-4
"""Length of a rest; with zero the lock would come back before anybody else wakes up."""

Message = tuple[str, float, bytes]
"""Topic, time, JSON."""


def breathing(items: Iterable[Any]) -> Iterator[Any]:
    """The items, with a rest now and then in which others may run."""
    for number, item in enumerate(items):
        yield item
        if number % BREATH == BREATH - 1:
            time.sleep(BREATH_S)


MOST_UNPACKED: Final = 8 * 1024 * 1024
"""The most bytes of one second, unpacked: more than may wait in the journal."""
_NOT_IN_IT: Final = frozenset({topics.PAST, topics.START, topics.RECORD})


class Past:
    """What has been in the journal lately. Used by one thread at a time.

    `replayed_imus`: those whose samples a replay takes from their messages: the autopilot's.
    """

    def __init__(self, longest_stretch_s: float, replayed_imus: Iterable[str]) -> None:
        self._keep_s = longest_stretch_s + LEARNED_S
        self._left_out = (topics.MAVLINK_OUT, topics.RECORD, topics.GRADIENTER, topics.COMPASS)
        self._imus = frozenset(topics.IMU + name for name in replayed_imus)
        self._seconds: deque[tuple[float, bytes, dict[str, Message]]] = deque()
        """When each ended, its messages, and what came into force in it."""
        self._in_force: dict[str, Message] = {}
        """Before the first of them."""
        self._bytes = 0

    def messages(self, entries: Sequence[Entry]) -> list[Message]:
        """The entries as messages."""
        return [(topic, t_s, function(*arguments)) for topic, t_s, function, arguments in breathing(entries)]

    def keep(self, entries: Sequence[Entry], messages: Sequence[Message], until_s: float) -> None:
        """Remember what happened until now; a start forgets what was before."""
        import zstandard

        changes: dict[str, Message] = {}
        wanted: list[Message] = []
        for (_, _, _, arguments), message in zip(entries, messages, strict=True):
            topic = message[0]
            if topic == topics.START:
                self.forget()
                changes, wanted = {}, []
            elif topic == topics.JOURNAL and arguments[1] in IN_FORCE:
                changes[in_force_key(arguments[1], arguments[2])] = message
                wanted.append(message)
            elif topic not in self._left_out and (not topic.startswith(topics.IMU) or topic in self._imus):
                wanted.append(message)
        packed = zstandard.compress(msgspec.msgpack.encode(wanted), 1)
        self._seconds.append((until_s, packed, changes))
        self._bytes += len(packed)
        while self._seconds and (self._bytes > MOST_BYTES or self._seconds[0][0] < until_s - self._keep_s):
            _, oldest, changed = self._seconds.popleft()
            self._bytes -= len(oldest)
            self._in_force.update(changed)

    def forget(self) -> None:
        """There is a gap behind it."""
        self._seconds.clear()
        self._in_force.clear()
        self._bytes = 0

    def beginning(self, t_s: float) -> list[Message]:
        """What a recording that begins at `t_s` begins with: its start, what is in force, each second in a piece."""
        start: Message = (topics.START, t_s, msgspec.json.encode(topics.StartEntry(t_s, 0)))
        past = [
            (topics.PAST, ended_s, msgspec.json.encode(topics.PastEntry(ended_s, packed)))
            for ended_s, packed, _ in self._seconds
        ]
        return [start, *self._in_force.values(), *past]


def unpacked(packed: bytes) -> list[Message]:
    """The messages of a second.

    Raises:
        ValueError: it is nothing that this version could have written.
    """
    found = msgspec.msgpack.decode(decompressed(packed, MOST_UNPACKED), type=list[Message])
    if any(topic in _NOT_IN_IT for topic, _, _ in found):
        raise ValueError("a second holds what it may not")
    return found
