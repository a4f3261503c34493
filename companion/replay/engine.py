"""A recording through the same decoders, collector and estimator, in the recorded order and at the recorded times.

Recomputed: every sample from its raw bytes, every batch, verdict of stillness and mean, pose, biases, sigmas and
covariances. Taken from the recording: when somebody looked at the collector or reset it, which of the autopilot's
messages counted (its offsets had to be known), place and date, the offsets in force, means found by a dither, and all
that only the autopilot can tell: what was written and read back, and with which outcome.
"""

from __future__ import annotations

import datetime
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot.imu_calibration import ImuCalibration
from companion.calibration.joint import weigh
from companion.calibration.measurement import Measurement
from companion.calibration.prior import Expectation
from companion.calibration.record import AlignmentUsed, Record, from_json
from companion.calibration.request import What
from companion.calibration.rolling import RollingCollector, Window
from companion.calibration.site import Whereabouts
from companion.calibration.solve import ImuSolution, Solution, solve_at
from companion.config import Config
from companion.daemon import models
from companion.daemon.alignment import aligned
from companion.daemon.course import in_words
from companion.daemon.plan import whole_of
from companion.daemon.report import Draft
from companion.daemon.serial_devices import Role, collect, parts_of, serial_devices
from companion.errors import CalibrationRefusedError, StorageError
from companion.physics.frames import Array
from companion.protocols.base import Decoder
from companion.recording import state, topics
from companion.recording.files import versions
from companion.recording.walk import Attachment, Messages, Metadata, Recording
from companion.replay.again import record_again, refined_window
from companion.replay.blocks import SerialImu
from companion.replay.compare import Difference, differences
from companion.replay.telemetry import Telemetry
from companion.samples import Sample

AT_ONCE: Final = 16384
"""Messages that are gathered before they are replayed; half of them samples, they are some seconds of a 1 kHz IMU."""
FEWEST: Final = 64
"""Reads of one IMU among them for which it is worth while to look at all of them at once."""
_UNUSABLE: Final = (msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""What a handler says of a message that nobody could have written."""
_raw: Final = msgspec.json.Decoder(topics.RawBytes)

WINDOWS_KEPT: Final = 4000
"""Means that were taken, for a calibration that may come of them."""


class Replayed(msgspec.Struct, frozen=True):
    """One calibration again."""

    record: Record
    differences: list[Difference]
    not_recomputed: str | None
    """Why its estimates were taken from the recording, if so."""


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
        self._config: Config | None = None
        self._versions: dict[str, str] = {}
        self._collector: RollingCollector | None = None
        self._decoders: dict[str, Decoder] = {}
        self._roles: dict[str, tuple[Role, ...]] = {}
        """Of each device, by the name that its bytes have."""
        self._telemetry = Telemetry(b"", 0.0)
        self._windows: dict[int, Window | Measurement | CalibrationRefusedError] = {}
        self._where = Whereabouts()
        self._offsets: dict[str, ImuCalibration | None] = {}
        self._solution: Solution | None = None
        self._solved_with: dict[str, ImuCalibration | None] = {}
        """The offsets in force when that was measured; by now others may have been written."""
        self._no_solution = ""
        self._alignment: AlignmentUsed | None = None
        self._handlers: dict[str, Callable[[bytes], None] | None] = {}
        self._calibrations: list[Replayed] = []
        self._notes: list[str] = []
        self._strange: Counter[str] = Counter()
        self._first_s: float | None = None
        self._now_s = 0.0

    def run(self) -> Result:
        """Replay it to its end or to where it is cut.

        Raises:
            StorageError: one line: it is not one of ours, or it was made by a version whose state is not known here.
        """
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
            calibrations=self._calibrations,
            estimate=None if self._calibrations else self._estimate(),
            seconds=0.0 if self._first_s is None else self._now_s - self._first_s,
            cut_short=self._recording.cut_short,
            notes=notes,
        )

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
        self._roles = {device.name: device.roles for device in serial_devices(self._config)}

    # --- what comes, in its order

    def _is_wanted(self, topic: str) -> bool:
        return self._config is None or self._handler_of(topic) is not None

    def _gather(self, messages: Messages) -> None:
        self._gathered.append(messages)
        if sum(len(each.data) for each in self._gathered) >= AT_ONCE:
            self._flush()

    def _flush(self) -> None:
        """Replay what has been gathered."""
        gathered, self._gathered = self._gathered, []
        if not gathered:
            return
        numbers = np.concatenate([each.numbers for each in gathered])
        data = list(itertools.chain.from_iterable(each.data for each in gathered))
        start = 0
        # A state brings other decoders.
        for state_at in np.flatnonzero(self._is_of(numbers, topics.STATE)).tolist():
            self._row(numbers[start:state_at], data[start:state_at])
            self._message(topics.STATE, data[state_at])
            start = state_at + 1
        self._row(numbers[start:], data[start:])

    def _is_of(self, numbers: NDArray[np.int64], *begins: str) -> NDArray[np.bool_]:
        """Which of the messages are on a topic that begins so."""
        found = [number for number, topic in enumerate(self._recording.topics) if topic.startswith(begins)]
        return np.isin(numbers, found)

    def _row(self, numbers: NDArray[np.int64], data: list[bytes]) -> None:
        """Replay messages among which no state is."""
        if self._collector is None or not data:
            return
        imus: list[SerialImu] = []
        others = np.ones(len(data), dtype=np.bool_)
        for name, roles in self._roles.items() if self._in_blocks else ():
            topic = topics.SERIAL + name
            if topic not in self._recording.topics or [role.kind for role in roles] != ["imu"]:
                continue
            its = numbers == self._recording.topics.index(topic)
            if np.count_nonzero(its) >= FEWEST:
                messages = itertools.compress(data, its.tolist())
                try:
                    imus.append(SerialImu(name, self._decoders[name], np.flatnonzero(its), messages))
                except _UNUSABLE as error:
                    raise self._unusable(topic, error) from None
                others &= ~its
        # Others' readings may pass samples of an IMU that lie between two ends of seconds, whoever looks may not.
        looks = others & ~self._is_of(numbers, topics.SERIAL, topics.IMU, topics.MAVLINK_IN)
        ends = {place: imu for imu in imus for place in (*imu.ends, *imu.one_by_one)}
        for place in sorted({*np.flatnonzero(others).tolist(), *ends}):
            if looks[place]:
                self._take_samples(imus, place)
            if (imu := ends.get(place)) is not None:
                self._take_samples([imu], place)
            else:
                self._message(self._recording.topics[numbers[place]], data[place])
        self._take_samples(imus, len(data))
        timed = np.flatnonzero(others & ~self._is_of(numbers, topics.IMU))
        last = max(imus, key=lambda imu: imu.last_place, default=None)
        if last is not None and (len(timed) == 0 or last.last_place > timed[-1]):
            self._at(last.last_s)

    def _take_samples(self, imus: Sequence[SerialImu], place: int) -> None:
        """Give the collector what has come of these IMUs up to the message at that place."""
        for imu in imus:
            try:
                if self._collector is not None:
                    imu.collect(self._collector, place)
                self._collect(imu.name, imu.one_by_one.get(place, ()))
            except _UNUSABLE as error:
                raise self._unusable(topics.SERIAL + imu.name, error) from None

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
            if any(imu.name == name and imu.source == "autopilot" for imu in self._config.imu):
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
        self._windows.update(known.windows)
        self._where, self._offsets = known.where, known.offsets
        self._telemetry = Telemetry(known.mavlink, entry.t_s)
        self._solution, self._no_solution = None, "it was measured before this part of the recording"
        if known.solved is not None:
            self._solve(known.solved)

    def _take_serial(self, name: str, data: bytes) -> None:
        raw = _raw.decode(data)
        self._at(raw.t_s)
        decoder = self._decoders[name]
        if raw.data is None:
            decoder.interrupted()
            return
        self._collect(name, decoder.receive(raw.data, raw.t_s))

    def _collect(self, name: str, samples: Iterable[Sample]) -> None:
        for sample in samples:
            for role, part in parts_of(sample, self._roles[name]):
                if self._collector is not None:
                    collect(self._collector, role, part)

    def _take_mavlink(self, data: bytes) -> None:
        raw = _raw.decode(data)
        self._at(raw.t_s)
        if self._config is None or not any(imu.source == "autopilot" for imu in self._config.imu):
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
                    # Most are never asked for.
                    self._windows[detail] = collector.measurement(entry.t_s)
                except CalibrationRefusedError as error:
                    self._windows[detail] = error
                while len(self._windows) > WINDOWS_KEPT:
                    del self._windows[next(iter(self._windows))]
            case "reset":
                collector.reset(*detail)
            case "imu":
                collector.set_imu(detail)
            case "retarget":
                collector.retarget(detail)
            case "expect":
                collector.expect(gradienter=detail[0], compass=detail[1])
            case "place":
                self._where = detail
            case "offsets":
                self._offsets = detail
            case "solved":
                self._solve(detail)

    # --- calibrations

    def _solve(self, detail: dict[str, Any]) -> None:
        self._solution, self._no_solution = None, ""
        window = self._windows.get(detail["window"])
        self._where, self._solved_with = detail["where"], detail["offsets"]
        used = detail.get("alignment")
        self._alignment = (
            AlignmentUsed(measured_at="", offset_deg=(used[0], used[1]), sigma_deg=used[2]) if used else None
        )
        if window is None:
            self._no_solution = "its measurement is not in the recording"
            return
        try:
            if isinstance(window, CalibrationRefusedError):
                raise window
            if isinstance(window, Measurement):
                window = window.window()
            solution = self._solved(refined_window(window, detail["refined"]), What[detail["what"]])
            whole = {found.name: self._whole(found) for found in solution.imus}
            self._solution = weigh(solution, whole, detail.get("expectation") or Expectation()).solution
        except CalibrationRefusedError as error:
            self._no_solution = f"refused here: {error}"

    def _solved(self, window: Window, what: What) -> Solution:
        config = self._config
        assert config is not None
        gradienter = aligned(models.gradienter_model(config.gradienter), self._alignment)
        compass = models.compass_model(config.compass)
        return solve_at(window, self._where, gradienter, compass, what)

    def _whole(self, found: ImuSolution) -> tuple[Array | None, Array | None]:
        calibration = self._solved_with.get(found.name)
        return (found.gyro_rad_s, found.accel_m_s2) if calibration is None else whole_of(calibration, found)

    def _take_record(self, data: bytes) -> None:
        entry = msgspec.json.decode(data, type=topics.RecordEntry)
        recorded = from_json(entry.record.encode())
        self._at(entry.t_s)
        solution, self._solution = self._solution, None
        why = self._no_solution
        if recorded.pose is None:
            # It ended before anything was worked out; there is nothing to recompute.
            self._calibrations.append(Replayed(recorded, [], "it ended before anything was worked out"))
        elif solution is not None:
            again = record_again(recorded, solution, self._solved_with)
            self._calibrations.append(Replayed(again, differences(recorded, again), None))
        elif why.startswith("refused here"):
            gone = msgspec.structs.replace(recorded, state="failed", reason=why, pose=None, site=None, imus=())
            self._calibrations.append(Replayed(gone, differences(recorded, gone), None))
        else:
            self._calibrations.append(Replayed(recorded, [], why))

    def _estimate(self) -> Record:
        """What a calibration would have found at the end."""
        unix_s = float(self._versions.get("unix_s", "0"))
        draft = Draft(datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC))
        seconds = 0.0 if self._first_s is None else self._now_s - self._first_s
        try:
            assert self._collector is not None
            draft.solution = self._solved(self._collector.window(self._now_s), What.BOTH)
        except CalibrationRefusedError as error:
            return draft.record("failed", str(error), seconds)
        for found in draft.solution.imus:
            calibration = self._offsets.get(found.name)
            if calibration is not None:
                draft.whole[found.name] = whole_of(calibration, found)
        return draft.record("done", in_words(draft.solution), seconds)
