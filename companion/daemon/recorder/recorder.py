"""Keeps the last half hour or so of everything in a ring of files, and records to a file on request.

Sensing and MAVLink never wait for it: what happens goes into bounded queues, a thread empties them once a second, and
a disk that is full, slow or gone costs recordings only.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.means.windows import Window
from companion.calibration.request import What, is_time_limit
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.component.service import JobResult
from companion.config.sections import Config
from companion.configured import models
from companion.daemon.calibrating.solver import Given
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import Job
from companion.errors import StorageError
from companion.formats import Object
from companion.links.mavlink.link import Direction
from companion.recording import topics
from companion.recording.files import (
    Beginning,
    RecordingFile,
    Ring,
    create_on_request,
    disk_shortage,
    is_available,
    unused_path,
    versions,
)
from companion.recording.journal import Journal, KeyFilter, Offsets, Solved
from companion.recording.past import Message, Past

logger = logging.getLogger(__name__)

T = TypeVar("T")
FLUSH_S: Final = 1.0
"""What a power cut costs."""
RETRY_S: Final = 60.0
DEFAULT_MB: Final = 64
"""Default size of the ring: some 35 minutes of a 200 Hz IMU beside 100 Hz telemetry."""
MOST_FILE_BYTES: Final = 4 << 30
"""Size at which a recording of a stated length ends: no more fits into a file on many USB sticks."""
MOST_OPEN_END_BYTES: Final = 1 << 30
"""Size at which a recording without a stated length ends: nine hours of a 200 Hz IMU beside 100 Hz telemetry."""
PROGRESS_S: Final = 0.5
HANGS_S: Final = 5.0
"""How long the daemon's end waits for the disk at most."""
INTERNAL: Final = "internal error; the log has the details"
HOW_TO_INSTALL: Final = (
    "recording needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)


class Surroundings:
    """What a replay needs to know of the world, and the raw bytes do not say in one place."""

    def __init__(self, config: Config, vehicle: Vehicle, imus: Iterable[AutopilotImu], journal: Journal) -> None:
        self._journal = journal
        self._config, self._vehicle, self._imus = config, vehicle, {imu.name: imu for imu in imus}
        self._seen: dict[str, ImuCalibration | None] = dict.fromkeys(self._imus)
        self._where: Whereabouts | None = None

    def read_offsets(self) -> Offsets:
        """What the autopilot takes off each of its IMUs; None where that is not known."""
        return {name: imu.calibration for name, imu in self._imus.items()}

    def update(self, now_s: float) -> None:
        """Note what has changed."""
        offsets = self.read_offsets()
        if any(offsets[name] is not before for name, before in self._seen.items()):
            self._seen = offsets
            self._journal.set_in_force(now_s, "offsets", offsets)
        where = models.whereabouts(self._config, self._vehicle)
        if self._where is None or _coarse(where) != _coarse(self._where):
            self._where = where
            self._journal.set_in_force(now_s, "place", where)


def _coarse(where: Whereabouts) -> tuple[object, ...]:
    """As far as a change of the place matters: a GNSS receiver is never quite still."""
    degrees = [None if value is None else round(value, 3) for value in (where.latitude_deg, where.longitude_deg)]
    return *degrees, None if where.height_m is None else round(where.height_m, -1), where.source, where.date


@dataclasses.dataclass(slots=True)
class _OnRequest:
    file: RecordingFile
    lost_before: int
    """Messages that were lost in all when it began."""
    since_s: float
    until_s: float | None
    ended: asyncio.Future[Object]

    @property
    def most_bytes(self) -> int:
        """Size at which it ends by itself."""
        return MOST_OPEN_END_BYTES if self.until_s is None else MOST_FILE_BYTES


class Recorder(Subsystem):
    """Taps everything that a replay needs."""

    def __init__(self, core: Core, devices: Devices, calibrating: Calibrating) -> None:
        config, collector, link = core.config, core.collector, core.link
        self.fault: str | None = None
        """Why the ring is not written, in one line; None while all is well."""
        self._collector, self._journal, self._offload = collector, collector.journal, core.offload
        self._alignment, self._conductor = calibrating.alignment, calibrating.conductor
        autopilots = (imu.name for imu in config.imu if imu.source == "autopilot")
        self._past = Past(models.longest_window_s(config), autopilots)
        self._folder = config.storage.path / "recordings"
        megabytes = config.storage.recordings_mb
        self._ring: Ring | None = None
        if megabytes != 0 and is_available():
            self._ring = Ring(self._folder, (DEFAULT_MB if megabytes is None else megabytes) << 20)
        elif megabytes:
            self.fault = HOW_TO_INSTALL
        self._ring_again_s = 0.0
        self._part_ends = False
        """What is in the journal now ends its file."""
        self._taken_s = 0.0
        """When the journal was emptied last: what came before is the past of a file that begins now."""
        self._config_json = msgspec.json.encode(config)
        self._on_request: _OnRequest | None = None
        self._flushing = asyncio.Lock()
        self._around = Surroundings(config, core.vehicle, devices.imus.values(), self._journal)
        self._no_keys = KeyFilter()
        link.on_bytes.add(self._on_mavlink)
        for sensor in devices.sensors:
            sensor.on_bytes.add(self._on_serial)
        calibrating.solving.on_solved.add(self._on_solved)
        calibrating.conductor.on_ended.add(self._on_ended)

    # --- what happens

    def _on_mavlink(self, direction: Direction, data: bytes | None, t_s: float | None) -> None:
        if direction == "in":
            if data is None:
                self._no_keys.restart()
            else:
                data = self._no_keys(data)
        if self._journal.is_on:
            now_s = asyncio.get_running_loop().time() if t_s is None else t_s
            self._journal.raw(topics.MAVLINK_IN if direction == "in" else topics.MAVLINK_OUT, now_s, data)

    def _on_serial(self, name: str, data: bytes | None, t_s: float) -> None:
        self._journal.raw(topics.SERIAL + name, t_s, data)

    def _on_solved(self, measured: Window, refined: Window, given: Given, what: What, expectation: Expectation) -> None:
        """A calibration's biases have been worked out; what from, besides the readings."""
        used = self._alignment.used
        solved = Solved(
            window=self._collector.number_of(measured),
            refined=refined if refined is not measured else None,
            where=given.where,
            otherwise=given.otherwise,
            what=what.name,
            offsets=self._around.read_offsets(),
            alignment=None if used is None else (*used.offset_deg, used.sigma_deg),
            expectation=expectation,
        )
        self._journal.event(asyncio.get_running_loop().time(), "solved", solved)

    def _on_ended(self, job: Job, _result: JobResult) -> None:
        if job.record is None or not job.record.is_worth_keeping:
            return
        self._journal.record(job.record, asyncio.get_running_loop().time())
        self._part_ends = True

    # --- to the disk

    async def run(self) -> None:
        """Write until cancelled, then finish the files."""
        if self.fault is not None:
            logger.warning("recordings: %s", self.fault)
        try:
            while True:
                try:
                    await self._turn()
                except Exception:
                    # Whatever it is, it must not take the daemon along.
                    logger.exception("recordings: internal error; none are kept until the next start")
                    self.fault = INTERNAL
                    if self._on_request is not None:
                        await self._end(self._on_request, self.fault, state="failed")
                    self._journal.end()
                    await asyncio.Event().wait()
        finally:
            await self._flush()
            if self._on_request is not None:
                await self._end(self._on_request, "the daemon stopped")
            if self._ring is not None:
                try:
                    await self._in_thread(self._ring.close)
                except StorageError as error:
                    logger.warning("recordings: %s", error)

    async def _turn(self) -> None:
        if self._ring is not None and not self._journal.is_on:
            self._begin()
        await asyncio.sleep(FLUSH_S)
        if self._journal.is_on:
            self._around.update(asyncio.get_running_loop().time())
        await self._flush()

    def _begin(self) -> None:
        now_s = asyncio.get_running_loop().time()
        self._around.update(now_s)
        self._journal.begin(now_s)
        self._taken_s = now_s

    async def _flush(self) -> None:
        async with self._flushing:
            journal, loop = self._journal, asyncio.get_running_loop()
            if not journal.is_on:
                return
            if journal.lost:
                level = logging.WARNING if journal.lost == journal.lost_in_all else logging.DEBUG  # once is enough
                logger.log(level, "recordings: the disk is too slow, %d messages lost; begun anew", journal.lost)
                self._begin()
            beginning = Beginning(
                self._taken_s, time.time() - (loop.time() - self._taken_s), versions(), self._config_json, self._past
            )
            self._taken_s = loop.time()
            entries, part_ends, self._part_ends = journal.drain(), self._part_ends, False
            messages = await self._in_thread(self._past.messages, entries)
            await self._flush_ring(messages, beginning, part_ends=part_ends)
            if self._on_request is not None:
                await self._flush_file(self._on_request, messages, beginning)
            await self._in_thread(self._past.keep, entries, messages, self._taken_s)

    async def _flush_ring(self, messages: list[Message], beginning: Beginning, *, part_ends: bool) -> None:
        ring = self._ring
        if ring is None or asyncio.get_running_loop().time() < self._ring_again_s:
            return
        try:
            await self._in_thread(ring.write, messages, beginning)
            if part_ends or (ring.is_full and not self._conductor.state.busy):
                await self._in_thread(ring.close)
        except StorageError as error:
            self._stop_ring(str(error))
        else:
            if self.fault is not None:
                logger.info("recordings: written again")
                self.fault = None

    async def _in_thread(self, function: Callable[..., T], *arguments: object) -> T:
        """Run a call that touches a file; a cancel waits for its end, since two of them must never overlap."""
        task: asyncio.Future[T] = asyncio.ensure_future(self._offload(function, *arguments))
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            done, _ = await asyncio.wait([task], timeout=HANGS_S)
            if not done:
                raise StorageError("the disk hangs") from None
            if (error := task.exception()) is not None:
                logger.debug("recordings: %s", error)
            raise
        except StorageError:
            raise
        except Exception as error:
            logger.exception("recordings: internal error")
            raise StorageError(INTERNAL) from error

    def _stop_ring(self, why: str) -> None:
        self._ring_again_s = asyncio.get_running_loop().time() + RETRY_S
        # Said once: it may stay so for the whole day.
        logger.log(logging.WARNING if self.fault is None else logging.DEBUG, "recordings: %s", why)
        self.fault = why

    async def _flush_file(self, recording: _OnRequest, messages: list[Message], beginning: Beginning) -> None:
        try:
            await self._in_thread(recording.file.write, messages, beginning)
            shortage = await self._in_thread(disk_shortage, recording.file.path.parent)
        except StorageError as error:
            await self._end(recording, str(error), state="failed")
            return
        if recording.until_s is not None and asyncio.get_running_loop().time() >= recording.until_s:
            await self._end(recording, "recorded as long as was asked for")
            return
        state = "done" if recording.until_s is None else "failed"
        if recording.file.bytes_written >= recording.most_bytes:
            await self._end(recording, f"ended at {recording.most_bytes >> 30} GB, its size limit", state)
        elif shortage is not None:
            await self._end(recording, f"ended with {shortage}", state)

    # --- on request

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"record": self._answer}

    async def _answer(self, request: Object, _face: str) -> AsyncIterator[Object]:
        """Begin, and tell how it goes until it ends; or end it."""
        if request.get("stop") is True:
            if (recording := self._on_request) is None:
                raise StorageError("nothing is being recorded on request")
            await self._flush()
            async with self._flushing:
                if not recording.ended.done():
                    await self._end(recording, "stopped")
            yield {"kind": "result", **recording.ended.result()}
            return
        seconds, name = request.get("seconds"), request.get("file")
        if not (seconds is None or is_time_limit(seconds)) or not (name is None or isinstance(name, str)):
            raise StorageError(f"record: not understood: {request}")
        recording = await self._start(name, seconds)
        most = f"; ends at {recording.most_bytes >> 30} GB" if seconds is None else ""
        while not recording.ended.done():
            now_s = asyncio.get_running_loop().time() - recording.since_s
            yield {
                "kind": "progress",
                "state": "recording",
                "percent": 0 if not seconds else min(99, int(100 * now_s / seconds)),
                "text": f"{recording.file.path}: {now_s:.0f} s, {recording.file.bytes_written / 1e6:.1f} MB{most}",
            }
            await asyncio.wait([recording.ended], timeout=PROGRESS_S)
        yield {"kind": "result", **recording.ended.result()}

    async def _start(self, name: str | None, seconds: float | None) -> _OnRequest:
        if not is_available():
            raise StorageError(HOW_TO_INSTALL)
        self._refuse_second()
        loop = asyncio.get_running_loop()
        path = Path(name) if name is not None else await self._offload(unused_path, self._folder)
        file = await self._offload(create_on_request, path)
        try:
            self._refuse_second()  # somebody may have been quicker
        except StorageError:
            await self._offload(file.close)
            raise
        now_s = loop.time()
        until_s = None if seconds is None else now_s + seconds
        recording = self._on_request = _OnRequest(file, self._journal.lost_in_all, now_s, until_s, loop.create_future())
        if not self._journal.is_on:
            self._begin()
        logger.info("recording to %s", path)
        return recording

    def _refuse_second(self) -> None:
        if self._on_request is not None:
            path = self._on_request.file.path
            raise StorageError(f"already recording to {path}; end it with: companion record --stop")

    async def _end(self, recording: _OnRequest, why: str, state: str = "done") -> None:
        self._on_request = None
        if self._ring is None:
            self._journal.end()
        size = recording.file.bytes_written
        try:
            await self._in_thread(recording.file.close)
        except StorageError as error:
            why, state = str(error), "failed"
        seconds = asyncio.get_running_loop().time() - recording.since_s
        logger.log(logging.INFO if state == "done" else logging.WARNING, "recording ended: %s", why)
        recording.ended.set_result(
            {
                "state": state,
                "reason": why,
                "file": str(recording.file.path),
                "seconds": round(seconds, 1),
                "bytes": size,
                "most_bytes": recording.most_bytes,
                "messages": recording.file.messages,
                "lost": self._journal.lost_in_all - recording.lost_before,
            }
        )

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        return [("recorder", self.run)]

    def status(self) -> Object:  # noqa: D102
        ring, asked = self._ring, self._on_request
        recording: Object = {
            "fault": self.fault,
            "lost": self._journal.lost_in_all,
            "ring": None
            if ring is None
            else {"directory": str(ring.folder), "bytes": ring.bytes_in_all, "most_bytes": ring.most_bytes},
            "file": None
            if asked is None
            else {
                "path": str(asked.file.path),
                "seconds": round(asyncio.get_running_loop().time() - asked.since_s, 1),
                "bytes": asked.file.bytes_written,
                "lost": self._journal.lost_in_all - asked.lost_before,
            },
        }
        return {"recording": recording}
