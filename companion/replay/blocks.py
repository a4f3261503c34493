"""Shares of a row of messages, thousands of readings at once; what comes of them is the same as message by message.

First every share is decoded, on which nothing but its own decoder has a say. Then the samples go into the collector,
and there the order matters in two places only: whoever looks at it must find what had come until then, and seconds must
end in their order. In between, samples of one source do not touch another's; but a field takes the tilt before it.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.rolling import RollingCollector
from companion.daemon.serial_devices import Role
from companion.protocols.base import Decoder
from companion.protocols.bulk import Block, ImuBlock
from companion.recording import topics
from companion.samples import Sample

FEW_READS: Final = 16
"""So many are read one by one where something about them is not regular; around them is what is."""

_reads: Final = msgspec.json.Decoder(topics.RawBytes)

Places = NDArray[np.intp]


@dataclasses.dataclass(slots=True)
class _Waiting:
    """A block that has not gone into the collector yet, or in part."""

    block: Block
    places: Places
    """(n,) of the message that completed each of its samples."""
    taken: int = 0


class Share:
    """What one stream has in a row of messages.

    Args:
        role: that takes its samples.
        topic: its messages'.
    """

    def __init__(self, role: Role, topic: str) -> None:
        self.role = role
        self.topic = topic
        self.one_by_one: dict[int, list[Sample]] = {}
        """Samples that came of reads that were not regular, by the place of their message."""
        self.ends: list[int] = []
        """Places of messages with which a second may end."""
        self._waiting: deque[_Waiting] = deque()

    def wait(self, block: Block, places: Places) -> None:
        """Keep a block until it may go into the collector."""
        seconds = np.floor(block.t_s)
        self.ends += places[np.flatnonzero(np.diff(seconds, prepend=seconds[0] - 1.0))].tolist()
        self._waiting.append(_Waiting(block, places))

    def collect(self, collector: RollingCollector, place: int) -> None:
        """Give the collector what has come up to and with the message at that place."""
        waiting = self._waiting
        while waiting:
            item = waiting[0]
            stop = int(item.places.searchsorted(place, side="right"))
            if stop > item.taken:
                self._add(collector, item.block, item.taken, stop)
                item.taken = stop
            if stop < len(item.block):
                return
            waiting.popleft()

    def _add(self, collector: RollingCollector, block: Block, start: int, stop: int) -> None:
        if isinstance(block, ImuBlock):
            collector.add_block(self.role.name, block, start, stop)
        elif self.role.kind == "gradienter":
            collector.add_tilts(block, start, stop)
        else:
            collector.add_headings(block, start, stop)


class SerialShare(Share):
    """The reads of one serial device.

    Args:
        role: the only one that it has.
        name: the device's.
        decoder: its own.
        places: (n,) of its messages in the row, at least one.
        data: these messages.

    Raises:
        msgspec.MsgspecError: one is none of raw bytes; nothing has been decoded.
    """

    def __init__(
        self,
        role: Role,
        name: str,
        decoder: Decoder,
        places: Places,
        data: Iterable[bytes],
    ) -> None:
        super().__init__(role, topics.SERIAL + name)
        self.last_place = int(places[-1])
        self._decoder = decoder
        self._many = decoder.many == role.kind
        self._places = places
        raws = list(map(_reads.decode, data))
        self.last_s = raws[-1].t_s
        reads, times = [raw.data for raw in raws], [raw.t_s for raw in raws]
        start = 0
        gaps = [index for index, data in enumerate(reads) if data is None] if None in reads else []
        for gap in [*gaps, len(reads)]:
            self._decode(reads[start:gap], times[start:gap], start)  # type: ignore[arg-type] # None only at a gap
            if gap < len(reads):
                decoder.interrupted()
            start = gap + 1

    def _decode(self, reads: Sequence[bytes], times: Sequence[float], first: int) -> None:
        """Decode reads, of which the first is the device's read `first`: as many at once as are regular."""
        if not reads:
            return
        block = self._decoder.receive_many(reads, times) if self._many else None
        if block is not None:
            self.wait(block, self._places[first + block.reads])
        elif len(reads) <= FEW_READS or not self._many:
            for index, (data, t_s) in enumerate(zip(reads, times, strict=True), first):
                self.one_by_one[int(self._places[index])] = self._decoder.receive(data, t_s)
        else:
            half = len(reads) // 2
            self._decode(reads[:half], times[:half], first)
            self._decode(reads[half:], times[half:], first + half)
