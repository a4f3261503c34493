"""Messages that wait for the broker: bounded, whatever the broker does."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Final, Literal, NamedTuple

MAX_ANSWERS: Final = 64

Kind = Literal["kept", "answer", "passing"]


class Parcel(NamedTuple):
    """One message on its way."""

    kind: Kind
    topic: str
    payload: bytes
    droppable: bool = False

    @property
    def qos(self) -> int:
        """1: wait for the broker's receipt."""
        return 0 if self.kind == "passing" else 1

    @property
    def retain(self) -> bool:
        """True: the broker keeps it for later subscribers."""
        return self.kind == "kept"


class Outbox:
    """Three kinds of messages, each with its own way of staying small.

    - kept: retained at the broker. Of each topic only the latest value counts; it is remembered after it was sent,
      as a broker that has restarted may have lost it. Their topics are few and our own.
    - answers: each is sent, in order, also after the connection was lost in between. At most 64: then the oldest that
      may be dropped (a refusal) goes, and where none may, the oldest of all.
    - passing: telemetry. Of each topic only the latest value, and none without a connection.
    """

    def __init__(self) -> None:
        self._kept: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}
        self._answers: deque[Parcel] = deque()
        self._passing: dict[str, bytes] = {}
        self._filled = asyncio.Event()
        self.emptied = asyncio.Event()
        """Set while nothing waits."""
        self.emptied.set()
        self._open = False
        self.dropped = 0
        """Answers that were dropped."""

    def __len__(self) -> int:
        return len(self._unsent) + len(self._answers) + len(self._passing)

    def keep(self, topic: str, payload: bytes, *, again: bool = False) -> None:
        """Have the broker keep a payload; an empty one has it forget the topic. `again`: send it though it is kept."""
        if again or self._kept.get(topic) != payload:
            self._kept[topic] = payload
            self._unsent[topic] = None
            self._tell()

    def kept(self, topic: str) -> bytes | None:
        """Return the payload that the broker keeps under a topic."""
        return self._kept.get(topic)

    def answer(self, topic: str, payload: bytes, *, droppable: bool) -> None:
        """Send an answer once."""
        parcel = Parcel("answer", topic, payload, droppable)
        if len(self._answers) >= MAX_ANSWERS:
            self.dropped += 1
            oldest = next((index for index, old in enumerate(self._answers) if old.droppable), None)
            if oldest is None and droppable:
                return
            del self._answers[oldest or 0]
        self._answers.append(parcel)
        self._tell()

    def pass_on(self, topic: str, payload: bytes) -> None:
        """Send telemetry if there is a connection."""
        if self._open:
            self._passing[topic] = payload
            self._tell()

    def opened(self) -> None:
        """Start a connection: send all kept payloads again."""
        self._open = True
        self._unsent = dict.fromkeys(self._kept)
        self._tell()

    def closed(self) -> None:
        """End a connection, and drop telemetry."""
        self._open = False
        self._passing.clear()
        self._tell()

    async def next(self) -> Parcel:
        """Return the next parcel; it stays (telemetry apart) until `sent`."""
        while True:
            if self._unsent:
                topic = next(iter(self._unsent))
                return Parcel("kept", topic, self._kept[topic])
            if self._answers:
                return self._answers[0]
            if self._passing:
                topic = next(iter(self._passing))
                return Parcel("passing", topic, self._passing.pop(topic))
            self._filled.clear()
            await self._filled.wait()

    def sent(self, parcel: Parcel) -> None:
        """Remove a parcel that the broker has."""
        if parcel.kind == "kept":
            if self._kept[parcel.topic] == parcel.payload:
                self._unsent.pop(parcel.topic, None)
        elif parcel.kind == "answer" and self._answers and self._answers[0] is parcel:
            self._answers.popleft()
        self._tell()

    def _tell(self) -> None:
        if len(self):
            self._filled.set()
            self.emptied.clear()
        else:
            self.emptied.set()
