"""A row of messages: which of its streams are decoded many messages at once, and in which order all of it is taken."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.daemon.serial_devices import Role
from companion.protocols.base import Decoder
from companion.recording import topics
from companion.replay.blocks import SerialShare, Share
from companion.replay.telemetry import Telemetry, TelemetryShares

FEWEST: Final = 64
"""Messages of one stream among them for which it is worth while to look at all of them at once."""

Numbers = NDArray[np.int64]


def is_of(numbers: Numbers, known: Sequence[str], *begins: str) -> NDArray[np.bool_]:
    """Which of the messages are on a topic that begins so; `known` are the topics by their numbers."""
    found = np.array([topic.startswith(begins) for topic in known], dtype=np.bool_)
    return found[numbers]


class Row:
    """Messages in their order, among which no state is.

    Args:
        numbers: (n,) of the topic of each.
        data: the messages.
        known: all topics by their numbers.
    """

    def __init__(self, numbers: Numbers, data: Sequence[bytes], known: Sequence[str]) -> None:
        self.topics = known
        self.topic = ""
        """That is being looked at."""
        self._numbers = numbers
        self._data = data
        self._others = np.ones(len(data), dtype=np.bool_)
        """Which messages are taken one by one."""
        self._shares: list[Share] = []
        self._last = (-1, 0.0)
        """Place and time of the last message that is in a share and has a time of its own."""
        self._strange: list[tuple[int, str]] = []

    @property
    def strange(self) -> list[str]:
        """What is strange about samples, in their order."""
        return [words for _, words in sorted(self._strange)]

    @property
    def last_s(self) -> float | None:
        """The time of the last message, where it is in a share."""
        others = np.flatnonzero(self._others & ~is_of(self._numbers, self.topics, topics.IMU))
        place, t_s = self._last
        return t_s if place >= 0 and (len(others) == 0 or place > others[-1]) else None

    def share_serial(self, name: str, roles: Sequence[Role], decoder: Decoder) -> None:
        """Decode what came from a serial device, where that goes quicker together."""
        if len(roles) != 1 or not (roles[0].kind == "imu" or decoder.many == roles[0].kind):
            return
        places, data = self._of(topics.SERIAL + name)
        if len(places) < FEWEST:
            return
        share = SerialShare(roles[0], name, decoder, places, data)
        self._others[places] = False
        self._shares.append(share)
        self._last = max(self._last, (share.last_place, share.last_s))

    def share_telemetry(self, telemetry: Telemetry, imus: Collection[str]) -> None:
        """Decode what came over MAVLink of these IMUs."""
        counted = {name: self._of(topics.IMU + name) for name in imus}
        reads = self._of(topics.MAVLINK_IN)
        if len(reads[0]) + sum(len(places) for places, _ in counted.values()) < FEWEST:
            return
        found = TelemetryShares(telemetry, reads, counted)
        for places, _ in (reads, *counted.values()):
            self._others[places] = False
        self._shares += found.shares.values()
        self._last = max(self._last, (found.last_place, found.last_s))
        self._strange = found.strange

    def _of(self, topic: str) -> tuple[NDArray[np.intp], list[bytes]]:
        """Places and messages of one topic."""
        self.topic = topic
        if topic not in self.topics:
            return np.empty(0, dtype=np.intp), []
        places = np.flatnonzero(self._numbers == self.topics.index(topic))
        data = self._data
        return places, [data[place] for place in places.tolist()]

    def order(self) -> Iterator[tuple[int, list[Share], Share | None]]:
        """Place by place in their order: shares of which all until then is to be taken first, and whose it is.

        None: it is a message to be taken by itself; behind the last place, nobody's.
        """
        shares, others = self._shares, self._others
        pose = [share for share in shares if share.role.kind != "imu"]
        # Others' readings may pass samples that lie between two ends of seconds, whoever looks may not; and a field
        # asks for the tilt.
        readings = is_of(self._numbers, self.topics, topics.IMU, topics.MAVLINK_IN)
        serial = is_of(self._numbers, self.topics, topics.SERIAL)
        ends = {place: share for share in shares for place in (*share.ends, *share.one_by_one)}
        for place in sorted({*np.flatnonzero(others).tolist(), *ends}):
            share = ends.get(place)
            if share is None:
                yield place, ([] if readings[place] else pose if serial[place] else shares), None
            else:
                yield place, (pose if place in share.one_by_one else []), share
        yield len(self._data), shares, None
