"""A recording through the same decoders, collector and estimator, in the recorded order and at the recorded times.

Recomputed: every sample from its raw bytes, every batch, verdict of stillness and mean, pose, biases, sigmas and
covariances. Taken from the recording: when seconds were ended and readings forgotten, which of the autopilot's
messages counted (its offsets had to be known), place and date, the offsets in force, means found by a dither, how far
the heading has wandered, and all that only the autopilot can tell: what was written and read back, with which outcome.
"""

from __future__ import annotations

import datetime
import functools
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Final

import msgspec

from companion.autopilot.telemetry import imu_messages
from companion.autopilot.telemetry.imu_messages import ImuMessage, Reading
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.records.record import Record, from_json
from companion.calibration.solution.draft import Draft
from companion.config.sections import Config
from companion.configured import models
from companion.configured.models import Role, SerialDevice, collect, parts_of, serial_devices
from companion.errors import CalibrationRefusedError, StorageError
from companion.links.mavlink.link import MavlinkLink
from companion.protocols.decoding.base import Decoder
from companion.recording import journal, past, topics
from companion.recording.files import versions
from companion.recording.walk import Attachment, Message, Metadata, Recording
from companion.replay.calibrations import Calibrations, Replayed
from companion.samples import ImuSample

PENDING: Final = 4000
"""The most telemetry messages remembered that nobody has counted yet."""

_NOT_THE_SAME: Final = "a sample does not decode as it did"
_NOT_THERE: Final = "a sample is not in the MAVLink bytes"


class Telemetry:
    """Decodes what came over the link, and finds in it the samples that went into the collector."""

    def __init__(self) -> None:
        self._link = MavlinkLink()
        self._pending: dict[str, deque[tuple[float, Reading]]] = {}
        for each in {*sum(imu_messages.ARDUPILOT.values(), ()), *sum(imu_messages.PX4.values(), ())}:
            self._listen(each)

    def _listen(self, kind: ImuMessage) -> None:
        pending = self._pending[kind.kind.message] = deque(maxlen=PENDING)

        def take(message: Any, t_s: float) -> None:
            reading = kind.decode(message)
            if isinstance(reading, Reading):
                pending.append((t_s, reading))

        self._link.subscribe(kind.message, take)

    def receive(self, data: bytes | None, t_s: float) -> None:
        """Bytes that came; None: the link was opened anew."""
        if data is None:
            self._link.attach(None)
        else:
            self._link.receive(data, t_s)

    def sample(self, entry: topics.ImuEntry) -> tuple[ImuSample, str | None]:
        """The sample of the autopilot that was recorded so, from its message; and what is strange about that, if so."""
        pending = self._pending.get(entry.message or "")
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
            entry.t_s, entry.gyro_rad_s, entry.accel_m_s2, entry.temperature_degc, None, entry.t_device_s,
            shared_variance=entry.shared_variance,
        )  # fmt: skip
        # What PX4's bias was put back into is in no message.
        return sample, None if (entry.message or "").startswith("HIGHRES_IMU+") else _NOT_THERE


_UNUSABLE: Final = (
    msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip
"""What a handler says of a message that nobody could have written."""
_raw: Final = msgspec.json.Decoder(topics.RawBytes)


class Result(msgspec.Struct, frozen=True):
    """What a recording gave."""

    calibrations: list[Replayed]
    estimate: Record | None
    """Of the last still stretch, where no calibration is in the recording."""
    seconds: float
    cut_short: str | None
    notes: list[str]
    """What a reader should know: other versions, samples that do not decode as they did."""


class Replay:
    """One pass over one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._config: Config | None = None
        self._versions: dict[str, str] = {}
        self._collector: RollingCollector | None = None
        self._devices: list[SerialDevice] = []
        self._decoders: dict[str, Decoder] = {}
        self._roles: dict[str, tuple[Role, ...]] = {}
        """Of each device, by the name that its bytes have."""
        self._autopilots: list[str] = []
        self._telemetry = Telemetry()
        self._calibrations = Calibrations()
        self._handlers: dict[str, Callable[[bytes], None] | None] = {}
        self._notes: list[str] = []
        self._strange: Counter[str] = Counter()
        self._first_s: float | None = None
        self._past_bytes = 0
        self._now_s = 0.0

    def run(self) -> Result:
        """Replay it to its end or to where it is cut.

        Raises:
            StorageError: one line: it is not one of ours, or it was made by a version whose state is not known here.
        """
        for item in self._recording.items(self._is_wanted):
            if isinstance(item, Message):
                self._message(item.topic, item.data)
            elif isinstance(item, Metadata) and item.name == topics.METADATA:
                self._versions = item.table
                if (found := item.table.get("format")) != topics.FORMAT_VERSION:
                    raise StorageError(
                        f"{self._recording.path}: found format {found}; allowed: {topics.FORMAT_VERSION} (recorded by"
                        f" companion {item.table.get('companion')})"
                    )
            elif isinstance(item, Attachment) and item.name == topics.CONFIG:
                self._configure(item.data)
        if self._collector is None:
            cut = self._recording.cut_short
            whose = f"{cut}, before anything was recorded" if cut else "an MCAP file, but not a recording of companion"
            raise StorageError(f"{self._recording.path}: {whose}; nothing to replay")
        seconds = 0.0 if self._first_s is None else self._now_s - self._first_s
        estimate = None
        if not self._calibrations.again:
            unix_s = float(self._versions.get("unix_s", "0"))
            draft = Draft(datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC))
            estimate = self._calibrations.estimate(self._collector, self._now_s, draft, seconds)
        notes = [*self._version_notes(), *self._notes, *(f"{words}: {n} times" for words, n in self._strange.items())]
        return Result(self._calibrations.again, estimate, seconds, self._recording.cut_short, notes)

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
        self._devices = serial_devices(self._config)
        self._roles = {device.name: device.roles for device in self._devices}
        self._autopilots = [imu.name for imu in self._config.imu if imu.source == "autopilot"]

    # --- what comes, in its order

    def _is_wanted(self, topic: str) -> bool:
        return self._config is None or self._handler_of(topic) is not None

    def _message(self, topic: str, data: bytes) -> None:
        try:
            handler = self._handlers[topic]
        except KeyError:
            handler = self._handlers[topic] = self._handler_of(topic)
        if handler is None or (self._collector is None and topic != topics.START):
            return
        try:
            handler(data)
        except _UNUSABLE as error:
            raise StorageError(
                f"{self._recording.path}: a message on {topic} cannot be used by this version ({error})"
            ) from None

    def _handler_of(self, topic: str) -> Callable[[bytes], None] | None:
        known: dict[str, Callable[[bytes], None]] = {
            topics.START: self._start,
            topics.PAST: self._take_past,
            topics.JOURNAL: self._take_event,
            topics.RECORD: self._take_record,
            topics.MAVLINK_IN: self._take_mavlink,
        }
        if topic.startswith(topics.SERIAL):
            return functools.partial(self._take_serial, topic.removeprefix(topics.SERIAL))
        # Samples of serial devices come from their bytes.
        if topic.startswith(topics.IMU) and (name := topic.removeprefix(topics.IMU)) in self._autopilots:
            return functools.partial(self._take_telemetry, name)
        return known.get(topic)

    def _start(self, data: bytes) -> None:
        config = self._config
        if config is None:
            return
        entry = msgspec.json.decode(data, type=topics.StartEntry)
        self._now_s = entry.t_s
        if self._first_s is None:
            self._first_s = entry.t_s
        if entry.lost:
            self._notes.append(f"{entry.lost} messages were lost in recording; replayed from behind the gap")
        self._collector = RollingCollector(
            models.settings(config),
            (),
            models.gradienter_model(config.gradienter),
            models.compass_model(config.compass),
            on_deck=config.vehicle.platform == "deck",
        )
        self._decoders = {
            device.name: device.info.decoder(device.settings.seconds_per_byte) for device in self._devices
        }
        self._telemetry = Telemetry()
        self._calibrations.begin()

    def _take_past(self, data: bytes) -> None:
        entry = msgspec.json.decode(data, type=topics.PastEntry)
        self._past_bytes += len(entry.packed)
        if self._past_bytes > past.MOST_BYTES:
            raise ValueError(f"more than {past.MOST_BYTES} bytes of what was before")
        for topic, _, message in past.unpacked(entry.packed):
            self._message(topic, message)

    def _take_serial(self, name: str, data: bytes) -> None:
        raw = _raw.decode(data)
        self._now_s = raw.t_s
        decoder = self._decoders[name]
        if raw.data is None:
            decoder.interrupted()
            return
        for sample in decoder.receive(raw.data, raw.t_s):
            for role, part in parts_of(sample, self._roles[name]):
                if self._collector is not None:
                    collect(self._collector, role, part)

    def _take_mavlink(self, data: bytes) -> None:
        raw = _raw.decode(data)
        self._now_s = raw.t_s
        if not self._autopilots:
            return  # nobody takes a sample from it
        self._telemetry.receive(raw.data, raw.t_s)

    def _take_telemetry(self, name: str, data: bytes) -> None:
        """A sample of the autopilot that counted."""
        sample, strange = self._telemetry.sample(msgspec.json.decode(data, type=topics.ImuEntry))
        happened_before = self._first_s is not None and self._now_s < self._first_s
        if strange is not None and not happened_before:
            self._strange[f"imu {name}: {strange}"] += 1
        if self._collector is not None:
            self._collector.add_imu(name, sample)

    def _take_event(self, data: bytes) -> None:
        entry = msgspec.json.decode(data, type=topics.JournalEntry)
        collector = self._collector
        if collector is None:
            return
        self._now_s = entry.t_s
        if entry.event == "tick":
            collector.tick(entry.t_s)
            return
        detail = journal.decode(entry.event, entry.detail)
        match entry.event:
            case "window":
                try:
                    measurement = collector.measurement(entry.t_s)
                except CalibrationRefusedError as error:
                    self._calibrations.measured(detail.number, error)
                else:
                    # Heading and IMUs were watched for longer than their readings are known.
                    longer = {"wander_deg": detail.wander_deg, "begun_s": detail.begun_s, "turn": detail.turn}
                    self._calibrations.measured(detail.number, msgspec.structs.replace(measurement, **longer))
            case "reset":
                collector.reset(*detail)
            case "imu":
                collector.set_imu(detail)
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
        self._now_s = entry.t_s
        self._calibrations.recorded(recorded)
