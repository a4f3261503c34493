"""The autopilot's IMU samples out of its raw bytes: which messages counted, the recording says.

Nearly always nothing but good frames came, and every sample that counted is the next one of its message. Then all that
a row of messages holds is decoded together; where it is not so, ever smaller parts of it are looked at, and the last of
them message by message, with the same result.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot import imu_messages
from companion.autopilot.imu_messages import ImuMessage, Reading
from companion.daemon.serial_devices import Role
from companion.links.mavlink import MavlinkLink
from companion.links.mavlink_bulk import frames_of
from companion.protocols.bulk import Floats, ImuBlock
from companion.recording import topics
from companion.replay.blocks import Places, Share
from companion.samples import ImuSample

PENDING: Final = 4000
"""Telemetry that nobody has counted yet is remembered so long."""
FEW_MESSAGES: Final = 32
"""So many are taken one by one where something about them is not regular."""

_NOT_THE_SAME: Final = "a sample does not decode as it did"
_NOT_THERE: Final = "a sample is not in the MAVLink bytes"


@dataclasses.dataclass(frozen=True, slots=True)
class _Readings:
    """Readings of one message that nobody has counted yet, in their order; (n,) of each."""

    t_s: Floats
    t_device_s: Floats
    rows: Floats
    """(n, 6) rad/s and m/s^2."""
    places: NDArray[np.int64]
    """Of the message in the row that completed each; negative: it was in one before."""

    def __len__(self) -> int:
        return len(self.t_s)

    def part(self, chosen: slice | NDArray[Any]) -> _Readings:
        return _Readings(self.t_s[chosen], self.t_device_s[chosen], self.rows[chosen], self.places[chosen])

    def then(self, more: _Readings) -> _Readings:
        if not len(self):
            return more
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(more), strict=True)
        return _Readings(*(np.concatenate(pair) for pair in pairs))


class _Pending:
    """The same, in the form in which they were asked for last."""

    def __init__(self) -> None:
        self._single: deque[tuple[float, Reading]] = deque(maxlen=PENDING)
        self._many: _Readings | None = None

    def single(self) -> deque[tuple[float, Reading]]:
        """One by one, to be taken from."""
        if (many := self._many) is not None:
            self._many = None
            times = zip(many.t_s.tolist(), many.t_device_s.tolist(), many.rows.tolist(), strict=True)
            for t_s, t_device_s, (gx, gy, gz, ax, ay, az) in times:
                self._single.append((t_s, Reading(t_device_s, (gx, gy, gz), (ax, ay, az), None)))
        return self._single

    def many(self) -> _Readings:
        """All of them."""
        if self._many is None:
            single = self._single
            rows = [reading.gyro_rad_s + reading.accel_m_s2 for _, reading in single]
            self._many = _Readings(
                np.array([t_s for t_s, _ in single]),
                np.array([reading.t_device_s for _, reading in single]),
                np.array(rows).reshape(-1, 6),
                np.full(len(single), -1),
            )
            single.clear()
        return self._many

    def keep(self, readings: _Readings) -> None:
        """Remember the last of these instead, of a row that is over."""
        kept = readings.part(slice(max(len(readings) - PENDING, 0), None))
        self._many = dataclasses.replace(kept, places=np.full(len(kept), -1))


class Telemetry:
    """Decodes what came over the link, and finds in it the samples that went into the collector.

    Args:
        half_received: the beginning of a frame that had come when the recording began.
        t_s: when that was.
    """

    def __init__(self, half_received: bytes, t_s: float) -> None:
        self._link = MavlinkLink()
        self._kinds = {*sum(imu_messages.ARDUPILOT.values(), ()), *sum(imu_messages.PX4.values(), ())}
        self._pending: dict[str, _Pending] = {}
        for each in self._kinds:
            self._listen(each)
        self._link.receive(half_received, t_s)

    def _listen(self, kind: ImuMessage) -> None:
        pending = self._pending[kind.kind.message] = _Pending()

        def take(message: Any, t_s: float) -> None:
            reading = kind.decode(message)
            if isinstance(reading, Reading):
                pending.single().append((t_s, reading))

        self._link.subscribe(kind.message, take)

    def receive(self, data: bytes | None, t_s: float) -> None:
        """Bytes that came; None: the link was opened anew."""
        if data is None:
            self._link.attach(None)
        else:
            self._link.receive(data, t_s)

    def sample(self, entry: topics.ImuEntry) -> tuple[ImuSample, str | None]:
        """The sample of the autopilot that was recorded so, from its message; and what is strange about that, if so."""
        found = self._pending.get(entry.message or "")
        pending = None if found is None else found.single()
        while pending:
            t_s, reading = pending.popleft()
            if reading.t_device_s == entry.t_device_s:
                sample = ImuSample(
                    t_s, reading.gyro_rad_s, reading.accel_m_s2, entry.temperature_degc, None, reading.t_device_s
                )
                # As the recording wrote it.
                again = msgspec.json.decode(topics.imu_json(sample, entry.message), type=topics.ImuEntry)
                return sample, _NOT_THE_SAME if again != entry else None
        sample = ImuSample(
            entry.t_s, entry.gyro_rad_s, entry.accel_m_s2, entry.temperature_degc, None, entry.t_device_s
        )
        return sample, _NOT_THERE

    def receive_many(
        self, reads: Sequence[topics.RawBytes], places: Places, entries: Mapping[str, _Entries]
    ) -> dict[str, _Counted] | None:
        """`receive` and `sample` of a row of messages, at once; None: it is not regular, and nothing was taken.

        Args:
            reads: what came, in its order.
            places: (n,) of these in the row.
            entries: the samples that counted, by IMU.
        """
        came = self._came(reads, places)
        if came is None:
            return None
        readings, rest = came
        counted: dict[str, _Counted] = {}
        left: dict[str, _Readings] = {}
        for name, own in entries.items():
            if not own.entries:
                continue
            message = own.entries[0].message
            if message not in readings or message in left:
                return None
            found = own.counted(readings[message])
            if found is None:
                return None
            counted[name], behind = found
            left[message] = readings[message].part(slice(behind, None))
        for message, all_of_it in readings.items():
            self._pending[message].keep(left.get(message, all_of_it))
        if reads:
            self._link.attach(None)
            if rest:
                self._link.receive(rest, reads[-1].t_s)
        return counted

    def _came(self, reads: Sequence[topics.RawBytes], places: Places) -> tuple[dict[str, _Readings], bytes] | None:
        """All readings that nobody has counted after these reads, by message, and the frame that is cut behind them."""
        pieces = [raw.data for raw in reads]
        before = self._link.half_received
        if None in pieces:
            return None
        data = b"".join((before, *pieces))  # type: ignore[arg-type] # none is None
        read = frames_of(data, {kind.message for kind in self._kinds})
        if read is None:
            return None
        frames, end = read
        read_ends = len(before) + np.cumsum([len(piece) for piece in pieces if piece is not None], dtype=np.int64)
        read_s = np.array([raw.t_s for raw in reads])
        found = {}
        for kind in self._kinds:
            message = kind.kind.message
            found[message] = self._pending[message].many()
            if kind.message not in frames:
                continue
            own = frames[kind.message]
            usable, t_device_s, rows = kind.decode_many(own.fields)
            by = np.searchsorted(read_ends, own.ends)
            found[message] = found[message].then(_Readings(read_s[by], t_device_s, rows, places[by]).part(usable))
        return found, data[end:]


@dataclasses.dataclass(frozen=True, slots=True)
class _Counted:
    """The samples of one IMU that counted in a row."""

    block: ImuBlock
    places: Places
    strange: Places
    """Of those that did not decode as they did."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Entries:
    """What the recording says of one IMU's samples in a row."""

    entries: Sequence[topics.ImuEntry]
    places: Places

    def part(self, first: int, last: int) -> _Entries:
        """Those from the place `first` in the row up to, without, `last`."""
        start, stop = np.searchsorted(self.places, (first, last)).tolist()
        return _Entries(self.entries[start:stop], self.places[start:stop])

    def counted(self, readings: _Readings) -> tuple[_Counted, int] | None:
        """The samples from these readings, and how many readings lie before what is left; None: one by one, please."""
        entries = self.entries
        message, warm = entries[0].message, entries[0].temperature_degc is not None
        device_s = [entry.t_device_s for entry in entries]
        if None in device_s or not len(readings):
            return None
        for entry in entries:
            if entry.message != message or (entry.temperature_degc is not None) != warm or entry.sequence is not None:
                return None
        if not (readings.t_device_s[1:] > readings.t_device_s[:-1]).all():
            return None
        wanted = np.array(device_s, dtype=np.float64)
        found = np.minimum(np.searchsorted(readings.t_device_s, wanted), len(readings) - 1)
        # What had come until then and nobody had forgotten.
        known = np.searchsorted(readings.places, self.places)
        if not (
            (readings.t_device_s[found] == wanted).all()
            and (found[1:] > found[:-1]).all()
            and ((found < known) & (found >= known - PENDING)).all()
        ):
            return None
        taken = readings.part(found)
        if not (taken.t_s[1:] >= taken.t_s[:-1]).all():
            return None
        rows = np.array([entry.gyro_rad_s + entry.accel_m_s2 for entry in entries])
        same = (topics.nine_digits(taken.rows) == rows).all(axis=1) & (
            taken.t_s == np.array([entry.t_s for entry in entries])
        )
        temperatures = np.array([entry.temperature_degc for entry in entries], dtype=np.float64) if warm else None
        if temperatures is not None and not np.isfinite(temperatures).all():
            return None
        block = ImuBlock(
            t_s=taken.t_s,
            rows=taken.rows,
            temperature_degc=temperatures,
            stamps=taken.t_device_s,
            breaks=0,
            reads=np.arange(len(entries)),
        )
        return _Counted(block, self.places, self.places[~same]), int(found[-1]) + 1


_reads: Final = msgspec.json.Decoder(topics.RawBytes)
_entries: Final = msgspec.json.Decoder(topics.ImuEntry)


class TelemetryShares:
    """What the autopilot's IMUs have in a row of messages: a share of each.

    Args:
        telemetry: decodes the link's bytes.
        reads: places in the row and messages of what came over the link.
        counted: the same of the samples that counted, by IMU.

    Raises:
        msgspec.MsgspecError: a message is none of its kind; nothing has been decoded.
    """

    def __init__(
        self,
        telemetry: Telemetry,
        reads: tuple[Places, Sequence[bytes]],
        counted: Mapping[str, tuple[Places, Sequence[bytes]]],
    ) -> None:
        self.strange: list[tuple[int, str]] = []
        """Places of samples about which something is strange, and what."""
        self._telemetry = telemetry
        self._places = reads[0]
        self._reads = [_reads.decode(data) for data in reads[1]]
        self._counted = {
            name: _Entries([_entries.decode(each) for each in data], places) for name, (places, data) in counted.items()
        }
        self.shares = {name: Share(Role(name, "imu"), topics.IMU + name) for name in counted}
        places = [self._places, *(own.places for own in self._counted.values())]
        self._all = np.sort(np.concatenate(places))
        self.last_place = int(self._places[-1]) if len(self._places) else -1
        self.last_s = self._reads[-1].t_s if self._reads else 0.0
        if counted:
            self._decode(0, len(self._all))

    def _decode(self, start: int, stop: int) -> None:
        """Decode messages, counted among those of all these topics: as many at once as are regular."""
        if start == stop:
            return
        first, last = int(self._all[start]), int(self._all[stop - 1]) + 1
        begin, end = np.searchsorted(self._places, (first, last)).tolist()
        entries = {name: own.part(first, last) for name, own in self._counted.items()}
        reads, places = self._reads[begin:end], self._places[begin:end]
        found = self._telemetry.receive_many(reads, places, entries)
        if found is not None:
            for name, counted in found.items():
                self.shares[name].wait(counted.block, counted.places)
                self.strange += [(place, f"imu {name}: {_NOT_THE_SAME}") for place in counted.strange.tolist()]
        elif stop - start <= FEW_MESSAGES:
            self._one_by_one(reads, places, entries)
        else:
            middle = (start + stop) // 2
            self._decode(start, middle)
            self._decode(middle, stop)

    def _one_by_one(self, reads: Sequence[topics.RawBytes], places: Places, entries: Mapping[str, _Entries]) -> None:
        came: dict[int, topics.RawBytes | tuple[str, topics.ImuEntry]] = dict(zip(places.tolist(), reads, strict=True))
        for name, own in entries.items():
            came.update(zip(own.places.tolist(), ((name, entry) for entry in own.entries), strict=True))
        for place in sorted(came):
            item = came[place]
            if isinstance(item, topics.RawBytes):
                self._telemetry.receive(item.data, item.t_s)
                continue
            name, entry = item
            sample, strange = self._telemetry.sample(entry)
            self.shares[name].one_by_one[place] = [sample]
            if strange is not None:
                self.strange.append((place, f"imu {name}: {strange}"))
