"""A deck: every stream in, second by second; what is known of them together can be worked out elsewhere."""

from __future__ import annotations

import math
from typing import Final

from companion.estimation.deck.estimate import MAX_S, DeckWork
from companion.estimation.deck.stream import KEPT_SHOWN, Stream
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.units import DEG

EVERY_S: Final = {180: 10, 600: 30, MAX_S: 60}
"""By how many seconds there are at most, how often a window ends: an estimate of more costs more, and tells less that
is new."""
KEPT_S: Final = MAX_S + 2 * max(EVERY_S.values())
"""What a window that is the latest until the next one may begin with."""


class Deck:
    """Collects what `DeckWork` needs. Pure: time comes in with the samples."""

    def __init__(self, gradienter: GradienterModel | None, compass: CompassModel | None) -> None:
        self._gradienter, self._compass = gradienter, compass
        self._streams: dict[str, Stream] = {}
        self._headings: dict[int, float] = {}
        self._tilts: dict[int, tuple[Floats, Floats]] = {}

    def set_imu(self, imu: ImuInput) -> None:
        """Add an IMU, or begin anew with one whose stream is another now."""
        self._streams[imu.name] = Stream(imu, self._gradienter, KEPT_S)

    def forget(self, imu: str | None) -> None:
        """Drop what was measured, of one IMU or of all."""
        for name, stream in self._streams.items():
            if imu is None or name == imu:
                stream.clear()
        if imu is None:
            self._headings.clear()

    def take_imu(self, name: str, batch: Batch, times: Floats, rows: Floats) -> None:
        """The samples (n, 6) of one second of an IMU, in its own axes."""
        stream = self._streams[name]
        stream.take(batch, times, rows)
        if batch.slot in self._tilts:
            stream.compare(batch.slot, *self._tilts[batch.slot])

    def take_tilt(self, batch: Batch, times: Floats, rows: Floats) -> None:
        """The readings (n, 2) of one second of the gradienter."""
        self._tilts[batch.slot] = times, rows
        while len(self._tilts) > KEPT_SHOWN:
            del self._tilts[next(iter(self._tilts))]
        for stream in self._streams.values():
            stream.compare(batch.slot, times, rows)

    def take_heading(self, batch: Batch, times: Floats, rows: Floats) -> None:
        """The headings (n, 1) of one second, degrees."""
        self._headings[batch.slot] = float(batch.mean[0]) * DEG
        while len(self._headings) > KEPT_S:
            del self._headings[next(iter(self._headings))]

    def slots(self, since_s: float | None = None) -> range:
        """The seconds that all IMUs have in common and that begin after `since_s`, up to the last end by `EVERY_S`."""
        ends = [(one.seconds[0].slot, one.seconds[-1].slot) for one in self._streams.values() if one.seconds]
        if not ends or len(ends) < len(self._streams):
            return range(0)
        begin, now = max(first for first, _ in ends), min(last for _, last in ends) + 1
        if since_s is not None:
            begin = max(begin, math.ceil(since_s))
        end = max(min(now, begin + length) // every * every for length, every in EVERY_S.items() if length < MAX_S)
        end = max(end, now // EVERY_S[MAX_S] * EVERY_S[MAX_S])
        first = max(end - MAX_S, begin)
        return range(first, max(end, first))

    @property
    def seconds(self) -> int:
        """How many there are in common, to the last."""
        counts = [len(stream.seconds) for stream in self._streams.values()]
        return min(counts, default=0)

    def work(
        self,
        slots: range,
        horizon_s: float,
        reference_deg: tuple[float, float] | None = None,
        since_s: float | None = None,
    ) -> DeckWork:
        """What is to be worked out of these seconds; holds nothing that changes later."""
        streams = self._streams.values()
        return DeckWork(
            imus=[stream.imu for stream in streams],
            seconds=[[one for one in stream.seconds if one.slot in slots] for stream in streams],
            levels=[{slot: one for slot, one in stream.levels.items() if slot in slots} for stream in streams],
            headings={slot: heading for slot, heading in self._headings.items() if slot in slots},
            slots=slots,
            gradienter=self._gradienter,
            compass=self._compass,
            horizon_s=horizon_s,
            reference_deg=reference_deg,
            since_s=since_s,
        )
