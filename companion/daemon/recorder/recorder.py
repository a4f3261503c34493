"""Keeps the last half hour or so of everything in a ring of files, and records to a file on request.

Sensing and MAVLink never wait for it: what happens goes into bounded queues, a thread empties them once a second, and
a disk that is full, slow or gone costs recordings only.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from companion.calibration.collector.rolling import RollingCollector, Window
from companion.calibration.request import What, is_time_limit
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.component.service import JobResult
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import Job
from companion.daemon.recorder.surroundings import Surroundings
from companion.errors import StorageError
from companion.links.mavlink.link import Direction
from companion.links.system.request import Object
from companion.recording import topics
from companion.recording.files import FOLDER_MODE, RecordingFile, Ring, is_available, versions
from companion.recording.journal import Beginning, Queue
from companion.recording.redact import KeyFilter, without_key
from companion.recording.state import freeze

logger = logging.getLogger(__name__)

FLUSH_S: Final = 1.0
"""What a power cut costs."""
RETRY_S: Final = 60.0
DEFAULT_MB: Final = 64
"""Some 35 minutes of a 200 Hz IMU beside 100 Hz telemetry."""
WINDOWS_TAKEN_ALONG: Final = 8
"""Into the next file, for a calibration that is being worked out in this moment."""
MOST_FILE_BYTES: Final = 4 << 30
PROGRESS_S: Final = 0.5
HANGS_S: Final = 5.0
"""So long at most the daemon's end waits for the disk."""
HOW_TO_INSTALL: Final = "recording needs more than is installed: pip install 'companion[recording]'"


@dataclasses.dataclass(slots=True)
class _OnRequest:
    """A recording that somebody asked for."""

    file: RecordingFile
    queue: Queue
    since_s: float
    until_s: float | None
    ended: asyncio.Future[Object]


class Recorder(Subsystem):
    """Taps everything that a replay needs."""

    def __init__(self, core: Core, devices: Devices, calibrating: Calibrating) -> None:
        config, collector, link = core.config, core.collector, core.link
        self.fault: str | None = None
        """Why the ring is not written, in one line; None while all is well."""
        self._config, self._collector, self._journal = config, collector, collector.journal
        self._link, self._offload = link, core.offload
        self._alignment, self._conductor = calibrating.alignment, calibrating.conductor
        self._sensors = {sensor.name: sensor for sensor in devices.sensors}
        self._folder = config.storage.path / "recordings"
        megabytes = config.storage.recordings_mb
        self._ring: Ring | None = None
        if megabytes != 0 and is_available():
            self._ring = Ring(self._folder, (DEFAULT_MB if megabytes is None else megabytes) << 20)
        elif megabytes:
            self.fault = HOW_TO_INSTALL
        self._ring_queue = Queue()
        self._ring_again_s = 0.0
        self._new_part = False
        self._on_request: _OnRequest | None = None
        self._flushing = asyncio.Lock()
        self._solved: object = None
        self._around = Surroundings(config, core.vehicle, devices.imus.values())
        self._no_keys = KeyFilter()
        link.tap = self._on_mavlink
        for sensor in self._sensors.values():
            sensor.tap = self._on_serial
        calibrating.solving.watch(self._on_solved)
        calibrating.conductor.watch(self._on_ended)

    # --- what happens

    def _on_mavlink(self, direction: Direction, data: bytes | None, t_s: float | None) -> None:
        if direction == "in":
            if data is None:
                self._no_keys.restart()
            else:
                data = self._no_keys(data)
        if self._journal.queues:
            now_s = asyncio.get_running_loop().time() if t_s is None else t_s
            self._journal.raw(topics.MAVLINK_IN if direction == "in" else topics.MAVLINK_OUT, now_s, data)

    def _on_serial(self, name: str, data: bytes | None, t_s: float) -> None:
        self._journal.raw(topics.SERIAL + name, t_s, data)

    def _on_solved(
        self, measured: Window, refined: Window, where: Whereabouts, what: What, expectation: Expectation
    ) -> None:
        """A calibration's biases have been worked out; what from, besides the readings."""
        self._solved = freeze(
            {
                "window": self._collector.number_of(measured),
                # What a dither has found comes from other readings than those of the window.
                "refined": refined if refined is not measured else None,
                "where": where,
                "what": what.name,
                "offsets": self._around.read_offsets(),
                "alignment": None if (used := self._alignment.used) is None else (*used.offset_deg, used.sigma_deg),
                # What is known from before lies on disk and changes with every calibration.
                "expectation": expectation,
            }
        )
        self._journal.event(asyncio.get_running_loop().time(), "solved", self._solved)

    def _on_ended(self, job: Job, _result: JobResult) -> None:
        if job.record is None or not job.record.is_worth_keeping:
            return
        self._journal.record(job.record, asyncio.get_running_loop().time())
        self._solved = None
        self._new_part = True

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
                    self.fault = "internal error; the log has the details"
                    if self._on_request is not None:
                        await self._end(self._on_request, self.fault, state="failed")
                    self._journal.queues.clear()
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
        idle = self._ring is not None and self._ring_queue not in self._journal.queues
        if idle and asyncio.get_running_loop().time() >= self._ring_again_s:
            self._begin(self._ring_queue)
        await asyncio.sleep(FLUSH_S)
        if self._journal.queues:
            self._around.look(self._journal)
        await self._flush()

    async def _flush(self) -> None:
        async with self._flushing:
            await self._flush_ring()
            if self._on_request is not None:
                await self._flush_file(self._on_request)

    async def _flush_ring(self) -> None:
        ring, queue = self._ring, self._ring_queue
        if ring is None or queue not in self._journal.queues:
            return
        if queue.lost:
            self._begin_part(queue)
        try:
            await self._in_thread(ring.write, queue.take())
        except StorageError as error:
            self._stop_ring(str(error))
        except Exception:
            logger.exception("recordings: internal error")
            self._stop_ring("internal error; the log has the details")
        else:
            if self.fault is not None:
                logger.info("recordings: written again")
                self.fault = None
            if self._new_part or (ring.is_full and not self._conductor.state.busy):
                self._new_part = False
                self._begin_part(queue)

    async def _in_thread(self, function: Callable[..., object], *arguments: object) -> None:
        """Run a call that touches a file; a cancel waits for its end, since two of them must never overlap.

        Raises:
            StorageError: as the call.
        """
        task: asyncio.Future[None] = asyncio.ensure_future(self._offload(function, *arguments))
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            done, _ = await asyncio.wait([task], timeout=HANGS_S)
            if not done:
                raise StorageError("the disk hangs") from None
            if (error := task.exception()) is not None:
                logger.debug("recordings: %s", error)
            raise

    def _stop_ring(self, why: str) -> None:
        self._journal.queues.remove(self._ring_queue)
        self._ring_queue = Queue()
        self._ring_again_s = asyncio.get_running_loop().time() + RETRY_S
        # Said once: it may stay so for the whole day.
        logger.log(logging.WARNING if self.fault is None else logging.DEBUG, "recordings: %s", why)
        self.fault = why

    async def _flush_file(self, recording: _OnRequest) -> None:
        if recording.queue.lost:
            self._begin_part(recording.queue)
        try:
            await self._in_thread(recording.file.write, recording.queue.take())
        except StorageError as error:
            await self._end(recording, str(error), state="failed")
        except Exception:
            logger.exception("recording: internal error")
            await self._end(recording, "internal error; the log has the details", state="failed")
        else:
            if recording.until_s is not None and asyncio.get_running_loop().time() >= recording.until_s:
                await self._end(recording, "recorded as long as was asked for")
            elif recording.file.bytes_written >= MOST_FILE_BYTES:
                await self._end(recording, f"ended at {MOST_FILE_BYTES >> 30} GB, as large as a file may be")

    def _begin(self, queue: Queue) -> None:
        queue.begin(self._beginning())
        self._journal.queues.append(queue)

    def _begin_part(self, queue: Queue) -> None:
        if queue.lost:
            level = logging.WARNING if queue.lost == queue.lost_in_all else logging.DEBUG  # once is enough
            logger.log(level, "recordings: the disk is too slow, %d messages lost; begun anew", queue.lost)
        queue.begin(self._beginning())

    def _beginning(self) -> Beginning:
        return Beginning(
            t_s=asyncio.get_running_loop().time(),
            unix_s=time.time(),
            versions=versions(),
            config=msgspec.json.encode(self._config),
            state={
                "collector": freeze(self._collector, RollingCollector),
                "decoders": {name: freeze(sensor.decoder) for name, sensor in self._sensors.items()},
                "mavlink": without_key(self._link.half_received),
                "windows": list(self._collector.windows)[-WINDOWS_TAKEN_ALONG:],
                "where": self._around.where,
                "offsets": self._around.offsets,
                "solved": self._solved,
            },
        )

    # --- on request

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"record": self._answer}

    async def _answer(self, request: Object, _face: str) -> AsyncIterator[Object]:
        """Begin, and tell how it goes until it ends; or end it.

        Raises:
            StorageError: the file cannot be created, or recording is not possible.
        """
        if request.get("stop") is True:
            if self._on_request is None:
                raise StorageError("nothing is being recorded on request")
            yield {"kind": "result", **await self._stop(self._on_request, "stopped")}
            return
        seconds, name = request.get("seconds"), request.get("file")
        if not (seconds is None or is_time_limit(seconds)) or not (name is None or isinstance(name, str)):
            raise StorageError(f"record: not understood: {request}")
        recording = await self._start(name, seconds)
        while not recording.ended.done():
            now_s = asyncio.get_running_loop().time() - recording.since_s
            yield {
                "kind": "progress",
                "state": "recording",
                "percent": 0 if not seconds else min(99, int(100 * now_s / seconds)),
                "text": f"{recording.file.path}: {now_s:.0f} s, {recording.file.bytes_written / 1e6:.1f} MB",
            }
            await asyncio.wait([recording.ended], timeout=PROGRESS_S)
        yield {"kind": "result", **recording.ended.result()}

    async def _start(self, name: str | None, seconds: float | None) -> _OnRequest:
        if not is_available():
            raise StorageError(HOW_TO_INSTALL)
        self._refuse_second()
        loop = asyncio.get_running_loop()
        path = Path(name) if name is not None else await self._offload(_kept, self._folder)
        file = await self._offload(RecordingFile, path)
        try:
            self._refuse_second()  # somebody may have been quicker
        except StorageError:
            await self._offload(file.close)
            raise
        now_s = loop.time()
        until_s = None if seconds is None else now_s + seconds
        recording = self._on_request = _OnRequest(file, Queue(), now_s, until_s, loop.create_future())
        self._begin(recording.queue)
        logger.info("recording to %s", path)
        return recording

    def _refuse_second(self) -> None:
        if self._on_request is not None:
            path = self._on_request.file.path
            raise StorageError(f"already recording to {path}; end it with: companion record --stop")

    async def _stop(self, recording: _OnRequest, why: str) -> Object:
        async with self._flushing:
            if not recording.ended.done():
                await self._flush_file(recording)
            if not recording.ended.done():
                await self._end(recording, why)
        return recording.ended.result()

    async def _end(self, recording: _OnRequest, why: str, state: str = "done") -> None:
        self._journal.queues.remove(recording.queue)
        self._on_request = None
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
                "messages": recording.file.messages,
                "lost": recording.queue.lost_in_all,
            }
        )

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        return [("recorder", self.run)]

    def status(self) -> Object:  # noqa: D102
        return {"recording": self._status()}

    def _status(self) -> Object:
        ring, asked = self._ring, self._on_request
        return {
            "fault": self.fault,
            "lost": self._ring_queue.lost_in_all,
            "ring": None
            if ring is None
            else {"directory": str(ring.folder), "bytes": ring.bytes_in_all, "most_bytes": ring.most_bytes},
            "file": None
            if asked is None
            else {
                "path": str(asked.file.path),
                "seconds": round(asyncio.get_running_loop().time() - asked.since_s, 1),
                "bytes": asked.file.bytes_written,
                "lost": asked.queue.lost_in_all,
            },
        }


def _kept(folder: Path) -> Path:
    """A name that the ring does not delete."""
    try:
        folder.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
        numbers = [int(path.stem[5:]) for path in folder.glob("kept-*.mcap") if path.stem[5:].isdecimal()]
    except OSError as error:
        raise StorageError(f"{folder}: {error.strerror or error}") from error
    return folder / f"kept-{max(numbers, default=0) + 1:03d}.mcap"
