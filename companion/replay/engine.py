"""A recording through the same decoders, collector and estimator, in the recorded order and at the recorded times.

Recomputed: every sample from its raw bytes, every batch, verdict of stillness and mean, pose, biases, sigmas and
covariances. Taken from the recording: when somebody looked at the collector or reset it, which of the autopilot's
messages counted (its offsets had to be known), place and date, the offsets in force, means found by a dither, and all
that only the autopilot can tell: what was written and read back, and with which outcome.
"""

from __future__ import annotations

import datetime
import gc
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.imu_calibration import ImuCalibration
from companion.calibration.record import Record, from_json
from companion.calibration.rolling import RollingCollector, Window
from companion.calibration.site import Whereabouts
from companion.config import Config
from companion.daemon.report import Draft
from companion.daemon.serial_devices import Role, collect, parts_of, serial_devices
from companion.errors import CalibrationRefusedError, StorageError
from companion.protocols.base import Decoder
from companion.recording import state, topics
from companion.recording.files import versions
from companion.recording.walk import Attachment, Messages, Metadata, Recording
from companion.replay.blocks import Share
from companion.replay.calibrations import Calibrations, Replayed
from companion.replay.rows import Numbers, Row, is_of
from companion.replay.telemetry import Telemetry
from companion.samples import Sample

__all__ = ["Replay", "Replayed", "Result"]

AT_ONCE: Final = 16384
"""Messages that are gathered before they are replayed; half of them samples, they are some seconds of a 1 kHz IMU."""
AT_ONCE_BYTES: Final = 16 * 1024 * 1024
"""Of them; ours have a sixth of that."""
_UNUSABLE: Final = (msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""What a handler says of a message that nobody could have written."""
_raw: Final = msgspec.json.Decoder(topics.RawBytes)


class Result(msgspec.Struct, frozen=True):
    """What a recording gave."""

    calibrations: list[Replayed]
    estimate: Record | None
    """Of the last still stretch, where no calibration is in the recording."""
    seconds: float
    """Of recorded time."""
    cut_short: str | None
    notes: list[str]
    """What a reader should know: other versions, samples that do not decode as they did."""


class _State(msgspec.Struct, frozen=True):
    """What `StateEntry.state` holds."""

    collector: RollingCollector
    decoders: dict[str, Decoder]
    mavlink: bytes
    windows: list[tuple[int, Window]]
    where: Whereabouts
    offsets: dict[str, ImuCalibration | None]
    solved: dict[str, Any] | None


class Replay:
    """One pass over one recording.

    Args:
        recording: the file.
        in_blocks: what is regular is decoded and collected many samples at once; else one by one, which gives the same.
    """

    def __init__(self, recording: Recording, *, in_blocks: bool = True) -> None:
        self._recording = recording
        self._in_blocks = in_blocks
        self._gathered: list[Messages] = []
        self._how_many = self._bytes = 0
        self._config: Config | None = None
        self._versions: dict[str, str] = {}
        self._collector: RollingCollector | None = None
        self._decoders: dict[str, Decoder] = {}
        self._roles: dict[str, tuple[Role, ...]] = {}
        """Of each device, by the name that its bytes have."""
        self._autopilots: list[str] = []
        """IMUs whose samples come over MAVLink."""
        self._telemetry = Telemetry(b"", 0.0)
        self._calibrations = Calibrations()
        self._handlers: dict[str, Callable[[bytes], None] | None] = {}
        self._notes: list[str] = []
        self._strange: Counter[str] = Counter()
        self._first_s: float | None = None
        self._now_s = 0.0

    def run(self) -> Result:
        """Replay it to its end or to where it is cut.

        Raises:
            StorageError: one line: it is not one of ours, or it was made by a version whose state is not known here.
        """
        # Nothing here goes round in circles, however long it takes; looking for that among all the samples that are
        # held for a moment takes a tenth of the time, with the autopilot's a quarter.
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self._run()
        finally:
            if collecting:
                gc.enable()

    def _run(self) -> Result:
        for item in self._recording.runs(self._is_wanted):
            if isinstance(item, Messages):
                self._gather(item)
            elif isinstance(item, Metadata) and item.name == topics.METADATA:
                self._flush()
                self._versions = item.table
                if (found := item.table.get("format")) != topics.FORMAT_VERSION:
                    raise StorageError(
                        f"{self._recording.path}: found format {found}; allowed: {topics.FORMAT_VERSION} (recorded by"
                        f" companion {item.table.get('companion')})"
                    )
            elif isinstance(item, Attachment) and item.name == topics.CONFIG:
                self._flush()
                self._configure(item.data)
        self._flush()
        if self._collector is None:
            cut = self._recording.cut_short
            whose = f"{cut}, before anything was recorded" if cut else "an MCAP file, but not a recording of companion"
            raise StorageError(f"{self._recording.path}: {whose}; nothing to replay")
        notes = [*self._version_notes(), *self._notes, *(f"{words}: {n} times" for words, n in self._strange.items())]
        return Result(
            calibrations=self._calibrations.again,
            estimate=None if self._calibrations.again else self._estimate(self._collector),
            seconds=self._seconds,
            cut_short=self._recording.cut_short,
            notes=notes,
        )

    @property
    def _seconds(self) -> float:
        return 0.0 if self._first_s is None else self._now_s - self._first_s

    def _estimate(self, collector: RollingCollector) -> Record:
        """What a calibration would have found at the end."""
        unix_s = float(self._versions.get("unix_s", "0"))
        draft = Draft(datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC))
        return self._calibrations.estimate(collector, self._now_s, draft, self._seconds)

    def _version_notes(self) -> list[str]:
        ours = versions()
        others = [
            f"{name} {self._versions.get(name)}, here {ours[name]}"
            for name in ("companion", "numpy", "machine")
            if self._versions.get(name) != ours[name]
        ]
        return [f"recorded with {'; '.join(others)}: the last digits may differ"] if others else []

    def _configure(self, data: bytes) -> None:
        try:
            self._config = msgspec.json.decode(data, type=Config)
        except msgspec.MsgspecError as error:
            raise StorageError(f"{self._recording.path}: its configuration is of another version: {error}") from None
        self._calibrations.config = self._config
        self._roles = {device.name: device.roles for device in serial_devices(self._config)}
        self._autopilots = [imu.name for imu in self._config.imu if imu.source == "autopilot"]

    # --- what comes, in its order

    def _is_wanted(self, topic: str) -> bool:
        return self._config is None or self._handler_of(topic) is not None

    def _gather(self, messages: Messages) -> None:
        self._gathered.append(messages)
        self._how_many += len(messages.data)
        self._bytes += sum(map(len, messages.data))
        if self._how_many >= AT_ONCE or self._bytes >= AT_ONCE_BYTES:
            self._flush()

    def _flush(self) -> None:
        """Replay what has been gathered."""
        gathered, self._gathered, self._how_many, self._bytes = self._gathered, [], 0, 0
        if not gathered:
            return
        numbers = np.concatenate([each.numbers for each in gathered])
        data = list(itertools.chain.from_iterable(each.data for each in gathered))
        start = 0
        # A state brings other decoders.
        for state_at in np.flatnonzero(is_of(numbers, self._recording.topics, topics.STATE)).tolist():
            self._row(numbers[start:state_at], data[start:state_at])
            self._message(topics.STATE, data[state_at])
            start = state_at + 1
        self._row(numbers[start:], data[start:])

    def _row(self, numbers: Numbers, data: list[bytes]) -> None:
        """Replay messages among which no state is."""
        if self._collector is None or not data:
            return
        row = Row(numbers, data, self._recording.topics)
        if self._in_blocks:
            try:
                for name, roles in self._roles.items():
                    row.share_serial(name, roles, self._decoders[name])
                row.share_telemetry(self._telemetry, self._autopilots)
            except _UNUSABLE as error:
                raise self._unusable(row.topic, error) from None
        self._strange.update(row.strange)
        for place, looking, share in row.order():
            for each in looking:
                self._take_samples(each, place)
            if share is not None:
                self._take_samples(share, place)
                self._collect_singles(share, place)
            elif place < len(data):
                self._message(row.topics[numbers[place]], data[place])
        last_s = row.last_s
        if last_s is not None:
            self._at(last_s)

    def _take_samples(self, share: Share, place: int) -> None:
        """Give the collector what has come in a share up to the message at that place."""
        if self._collector is not None:
            try:
                share.collect(self._collector, place)
            except _UNUSABLE as error:
                raise self._unusable(share.topic, error) from None

    def _collect_singles(self, share: Share, place: int) -> None:
        try:
            self._collect((share.role,), share.one_by_one.get(place, ()))
        except _UNUSABLE as error:
            raise self._unusable(share.topic, error) from None

    def _unusable(self, topic: str, error: Exception) -> StorageError:
        return StorageError(f"{self._recording.path}: a message on {topic} cannot be used by this version ({error})")

    def _message(self, topic: str, data: bytes) -> None:
        try:
            handler = self._handlers[topic]
        except KeyError:
            handler = self._handlers[topic] = self._handler_of(topic)
        if handler is None or (self._collector is None and topic != topics.STATE):
            return
        try:
            handler(data)
        except _UNUSABLE as error:
            raise self._unusable(topic, error) from None

    def _handler_of(self, topic: str) -> Callable[[bytes], None] | None:
        known: dict[str, Callable[[bytes], None]] = {
            topics.STATE: self._take_state,
            topics.JOURNAL: self._take_event,
            topics.RECORD: self._take_record,
            topics.MAVLINK_IN: self._take_mavlink,
        }
        if topic in known:
            return known[topic]
        if topic.startswith(topics.SERIAL):
            name = topic.removeprefix(topics.SERIAL)
            return lambda data: self._take_serial(name, data)
        if topic.startswith(topics.IMU) and self._config is not None:
            name = topic.removeprefix(topics.IMU)
            if name in self._autopilots:
                return lambda data: self._take_telemetry(name, data)
        # Samples of serial devices come from their bytes.
        return None

    def _at(self, t_s: float) -> None:
        if self._first_s is None:
            self._first_s = t_s
        self._now_s = t_s

    def _take_state(self, data: bytes) -> None:
        if self._config is None:
            return
        entry = msgspec.json.decode(data, type=topics.StateEntry)
        self._at(entry.t_s)
        if entry.lost:
            self._notes.append(f"{entry.lost} messages were lost in recording; replayed from behind the gap")
        plain = state.from_json(entry.state)
        known = _State(**plain)
        self._collector, self._decoders = known.collector, known.decoders
        self._telemetry = Telemetry(known.mavlink, entry.t_s)
        self._calibrations.begin(known.windows, known.where, known.offsets, known.solved)

    def _take_serial(self, name: str, data: bytes) -> None:
        raw = _raw.decode(data)
        self._at(raw.t_s)
        decoder = self._decoders[name]
        if raw.data is None:
            decoder.interrupted()
            return
        self._collect(self._roles[name], decoder.receive(raw.data, raw.t_s))

    def _collect(self, roles: Sequence[Role], samples: Iterable[Sample]) -> None:
        for sample in samples:
            for role, part in parts_of(sample, roles):
                if self._collector is not None:
                    collect(self._collector, role, part)

    def _take_mavlink(self, data: bytes) -> None:
        raw = _raw.decode(data)
        self._at(raw.t_s)
        if not self._autopilots:
            return  # nobody takes a sample from it
        self._telemetry.receive(raw.data, raw.t_s)

    def _take_telemetry(self, name: str, data: bytes) -> None:
        """A sample of the autopilot that counted."""
        sample, strange = self._telemetry.sample(msgspec.json.decode(data, type=topics.ImuEntry))
        if strange is not None:
            self._strange[f"imu {name}: {strange}"] += 1
        if self._collector is not None:
            self._collector.add_imu(name, sample)

    def _take_event(self, data: bytes) -> None:
        entry = msgspec.json.decode(data, type=topics.JournalEntry)
        collector = self._collector
        if collector is None:
            return
        self._at(entry.t_s)
        if entry.event == "look":
            collector.glance(entry.t_s)
            return
        detail = state.from_json(entry.detail)
        match entry.event:
            case "window":
                try:
                    self._calibrations.measured(detail, collector.measurement(entry.t_s))
                except CalibrationRefusedError as error:
                    self._calibrations.measured(detail, error)
            case "reset":
                collector.reset(*detail)
            case "imu":
                collector.set_imu(detail)
            case "retarget":
                collector.retarget(detail)
            case "expect":
                collector.expect(gradienter=detail[0], compass=detail[1])
            case "place":
                self._calibrations.where = detail
            case "offsets":
                self._calibrations.offsets = detail
            case "solved":
                self._calibrations.solve(detail)

    def _take_record(self, data: bytes) -> None:
        entry = msgspec.json.decode(data, type=topics.RecordEntry)
        recorded = from_json(entry.record.encode())
        self._at(entry.t_s)
        self._calibrations.recorded(recorded)
