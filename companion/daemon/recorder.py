"""Recorder of all inputs: the last hour and a half in a ring of files, and a single file on request.

Sensors and MAVLink never wait for the disk: their data enter a bounded queue, which a thread empties once a second.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from companion.autopilot.firmware.imu_messages import Six
from companion.commands import RecordInputs
from companion.component.service import JobResult
from companion.configured import models
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import Job
from companion.errors import StorageError
from companion.estimation.machine import What
from companion.estimation.means.windows import Window
from companion.estimation.records.record import to_json
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.site import Whereabouts
from companion.estimation.solution.truth import FallbackPose
from companion.formats import Object
from companion.links.mavlink.link import Direction
from companion.messages import message
from companion.recording import files, messages
from companion.recording.files import Beginning, RecordingFile, Ring
from companion.recording.messages import ImuState, KeyFilter, Measured, Message, RawOutput, Solved, Tape

logger = logging.getLogger(__name__)

T = TypeVar("T")
FLUSH_S: Final = 1.0
RETRY_S: Final = 60.0
DEFAULT_MB: Final = 64
"""Default size of the ring of files, MiB: some 100 minutes of a 200 Hz IMU and 100 Hz telemetry."""
MOST_BYTES: Final = 4 << 30, 1 << 30
"""Size limits of a recording on request: with a requested length 4 GiB, the largest file on many USB sticks; without
one 1 GiB, which is 27 hours of a 200 Hz IMU and 100 Hz telemetry."""
PROGRESS_S: Final = 0.5
HANGS_S: Final = 5.0
INTERNAL: Final = "internal error; the log has the details"


def _coarse(where: Whereabouts) -> tuple[object, ...]:
    """Return a place with rounded coordinates, so that the noise of a GNSS receiver does not count as a change."""
    degrees = [None if value is None else round(value, 3) for value in (where.latitude_deg, where.longitude_deg)]
    return *degrees, None if where.height_m is None else round(where.height_m, -1), where.source, where.date


@dataclasses.dataclass(slots=True)
class _OnRequest:
    file: RecordingFile
    lost_before: int
    since_s: float
    until_s: float | None
    most_bytes: int
    ended: asyncio.Future[Object]


class Recorder(Subsystem):
    """Records the inputs of calibrations, for replay."""

    def __init__(self, core: Core, devices: Devices, calibrating: Calibrating) -> None:
        config = core.config
        self.fault: str | None = None
        self.tape = Tape()
        self._core, self._offload, self._manager = core, core.offload, calibrating.manager
        self._alignment = calibrating.alignment
        self._folder = config.storage.path / "recordings"
        megabytes = config.storage.recordings_mb
        self._ring: Ring | None = None
        if megabytes != 0 and files.is_available():
            self._ring = Ring(self._folder, (DEFAULT_MB if megabytes is None else megabytes) << 20)
        elif megabytes:
            self.fault = message("recording_not_installed")
        self._ring_again_s = 0.0
        self._offset_ns: int | None = None
        self._config_json = msgspec.json.encode(config)
        self._on_request: _OnRequest | None = None
        self._flushing = asyncio.Lock()
        self._where: Whereabouts | None = None
        self._no_keys = KeyFilter()
        core.link.on_bytes.add(self._on_mavlink)
        core.on_tick.add(lambda now_s: self.tape.put(messages.TICK, now_s, b""))
        for sensor in devices.sensors:
            sensor.on_bytes.add(lambda name, data, t_s: self.tape.put(messages.SERIAL + name, t_s, data or b""))
        for imu in devices.imus.values():
            imu.on_change.add(partial(self._on_imu, imu))
            imu.on_raw.add(partial(self._on_raw, imu.name))
        devices.ekf_bias.on_read.add(
            lambda reading: self.tape.put_state(messages.EKF_BIAS, _now_s(), messages.encode(reading))
        )
        calibrating.measuring.on_measured.add(self._on_measured)
        calibrating.estimator.on_solved.add(self._on_solved)
        calibrating.manager.on_ended.add(self._on_ended)

    # --- inputs

    def _on_mavlink(self, direction: Direction, data: bytes | None, t_s: float | None) -> None:
        if direction == "out":
            return
        if data is None:
            self._no_keys.restart()
        else:
            data = self._no_keys(data)
        if self.tape.is_on:
            self.tape.put(messages.MAVLINK, _now_s() if t_s is None else t_s, data or b"")

    def _on_imu(self, imu: AutopilotImu) -> None:
        vehicle, kind = self._core.vehicle, imu.stream.kind
        state = ImuState(
            sender=(vehicle.system_id or 0, vehicle.component_id),
            firmware=vehicle.firmware,
            instance=imu.instance,
            message=None if kind is None else kind.name,
            input=imu.input,
            calibration=imu.calibration,
        )
        self.tape.put_state(messages.IMU + imu.name, _now_s(), messages.encode(state))

    def _on_raw(self, name: str, t_s: float, output: Six, degc: float | None) -> None:
        self.tape.put(messages.RAW_MEAN, t_s, messages.encode(RawOutput(name, output, degc)))

    def _on_measured(self, window: Window) -> None:
        collector = self._core.collector
        begun_s, turn, wander_deg = collector.begun_s, collector.turn, collector.wander_deg
        measured = Measured(
            start_s=window.start_s, end_s=window.end_s, wander_deg=wander_deg, begun_s=begun_s, turn=turn
        )
        self.tape.put(messages.MEASURED, _now_s(), messages.encode(measured))

    def _on_solved(self, where: Whereabouts, otherwise: FallbackPose, what: What, expectation: Expectation) -> None:
        used = self._alignment.used
        solved = Solved(
            where=where,
            what=what.name,
            alignment=None if used is None else (*used.offset_deg, used.sigma_deg),
            otherwise=otherwise,
            expectation=expectation,
        )
        self.tape.put(messages.SOLVED, _now_s(), messages.encode(solved))

    def _on_ended(self, job: Job, _result: JobResult) -> None:
        if job.record is not None and job.record.is_worth_keeping:
            self.tape.put(messages.RECORD, _now_s(), to_json(job.record))

    def _note_place(self) -> None:
        where = models.whereabouts(self._core.config, self._core.vehicle)
        if self._where is None or _coarse(where) != _coarse(self._where):
            self._where = where
            self.tape.put_state(messages.PLACE, _now_s(), messages.encode(where))

    # --- to the disk

    async def run(self) -> None:
        if self.fault is not None:
            logger.warning("recordings: %s", self.fault)
        try:
            while True:
                try:
                    if self._ring is not None and not self.tape.is_on:
                        self._begin()
                    await asyncio.sleep(FLUSH_S)
                    if self.tape.is_on:
                        self._note_place()
                    await self._flush()
                except Exception:
                    # A fault of the recorder must not end the daemon.
                    logger.exception("recordings: internal error; none are kept until the next start")
                    self.fault = INTERNAL
                    if self._on_request is not None:
                        await self._end(self._on_request, self.fault, state="failed")
                    self.tape.end()
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

    def _begin(self) -> None:
        self._note_place()
        self.tape.begin(_now_s())

    async def _flush(self) -> None:
        async with self._flushing:
            tape, now_s = self.tape, _now_s()
            if not tape.is_on:
                return
            if self._offset_ns is None:
                self._offset_ns = time.time_ns() - round(now_s * 1e9)
            if tape.lost:
                level = logging.WARNING if tape.lost == tape.lost_in_all else logging.DEBUG  # warn only once
                logger.log(level, "recordings: %s", message("disk_too_slow", lost=tape.lost))
                self._begin()
            since_s, states, batch = tape.drain(now_s)
            beginning = Beginning(since_s, self._offset_ns, self._config_json, states)
            await self._flush_ring(batch, beginning)
            if self._on_request is not None:
                await self._flush_file(self._on_request, batch, beginning)

    async def _flush_ring(self, batch: list[Message], beginning: Beginning) -> None:
        ring = self._ring
        if ring is None or _now_s() < self._ring_again_s:
            return
        try:
            await self._in_thread(ring.write, batch, beginning)
            if ring.is_full and not self._manager.state.busy:
                await self._in_thread(ring.close)
        except StorageError as error:
            self._ring_again_s = _now_s() + RETRY_S
            # Warn only once: the fault may last the whole day.
            logger.log(logging.WARNING if self.fault is None else logging.DEBUG, "recordings: %s", error)
            self.fault = str(error)
        else:
            if self.fault is not None:
                logger.info("recordings: written again")
                self.fault = None

    async def _in_thread(self, function: Callable[..., T], *arguments: object) -> T:
        """Run a file operation in a thread; even after a cancel wait for its end, as operations must not overlap."""
        task: asyncio.Future[T] = asyncio.ensure_future(self._offload(function, *arguments))
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            done, _ = await asyncio.wait([task], timeout=HANGS_S)
            if not done:
                raise StorageError("the disk hangs") from None
            task.exception()  # mark it as retrieved: after a cancel nobody handles it
            raise

    async def _flush_file(self, recording: _OnRequest, batch: list[Message], beginning: Beginning) -> None:
        try:
            await self._in_thread(recording.file.write, batch, beginning)
            shortage = await self._in_thread(files.disk_shortage, recording.file.path.parent)
        except StorageError as error:
            await self._end(recording, str(error), state="failed")
            return
        if recording.until_s is not None and _now_s() >= recording.until_s:
            await self._end(recording, "the requested time is over")
            return
        state = "done" if recording.until_s is None else "failed"
        if recording.file.bytes_written >= recording.most_bytes:
            await self._end(recording, f"size limit of {recording.most_bytes >> 30} GB reached", state)
        elif shortage is not None:
            await self._end(recording, shortage, state)

    # --- on request

    def commands(self) -> Mapping[str, Handler]:
        return {"record": self._answer}

    async def _answer(self, request: RecordInputs, _face: str) -> AsyncIterator[Object]:
        if request.stop:
            if (recording := self._on_request) is None:
                raise StorageError("nothing is being recorded on request")
            await self._flush()
            async with self._flushing:
                if not recording.ended.done():
                    await self._end(recording, "stopped")
            yield {"kind": "result", **recording.ended.result()}
            return
        seconds, name = request.seconds, request.file
        recording = await self._start(name, seconds)
        most = f"; ends at {recording.most_bytes >> 30} GB" if seconds is None else ""
        while not recording.ended.done():
            now_s = _now_s() - recording.since_s
            yield {
                "kind": "progress",
                "state": "recording",
                "percent": 0 if not seconds else min(99, int(100 * now_s / seconds)),
                "text": f"{recording.file.path}: {now_s:.0f} s, {recording.file.bytes_written / 1e6:.1f} MB{most}",
            }
            await asyncio.wait([recording.ended], timeout=PROGRESS_S)
        yield {"kind": "result", **recording.ended.result()}

    async def _start(self, name: str | None, seconds: float | None) -> _OnRequest:
        if not files.is_available():
            raise StorageError(message("recording_not_installed"))
        async with self._flushing:
            if self._on_request is not None:
                raise StorageError(message("recording_runs_already", path=self._on_request.file.path))
            path = Path(name) if name is not None else await self._offload(files.unused_path, self._folder)
            file, now_s = await self._offload(files.create_on_request, path), _now_s()
            ended: asyncio.Future[Object] = asyncio.get_running_loop().create_future()
            until_s, most_bytes = None if seconds is None else now_s + seconds, MOST_BYTES[seconds is None]
            recording = _OnRequest(file, self.tape.lost_in_all, now_s, until_s, most_bytes, ended)
            self._on_request = recording
        if not self.tape.is_on:
            self._begin()
        logger.info("recording to %s", path)
        return recording

    async def _end(self, recording: _OnRequest, why: str, state: str = "done") -> None:
        self._on_request = None
        if self._ring is None:
            self.tape.end()
        written = self._progress(recording)
        try:
            await self._in_thread(recording.file.close)
        except StorageError as error:
            why, state = str(error), "failed"
        level = logging.INFO if state == "done" else logging.WARNING
        logger.log(level, "%s", message("recording_ended", reason=why))
        recording.ended.set_result(
            {
                "state": state,
                "reason": why,
                "file": str(recording.file.path),
                "most_bytes": recording.most_bytes,
                "messages": recording.file.messages,
                **written,
            }
        )

    def _progress(self, recording: _OnRequest) -> Object:
        return {
            "seconds": round(_now_s() - recording.since_s, 1),
            "bytes": recording.file.bytes_written,
            "lost": self.tape.lost_in_all - recording.lost_before,
        }

    def tasks(self) -> Sequence[Task]:
        return [("recorder", self.run)]

    def status(self) -> Object:
        ring, asked = self._ring, self._on_request
        recording: Object = {
            "fault": self.fault,
            "lost": self.tape.lost_in_all,
            "ring": ring and {"directory": str(ring.folder), "bytes": ring.bytes_in_all, "most_bytes": ring.most_bytes},
            "file": None if asked is None else {"path": str(asked.file.path), **self._progress(asked)},
        }
        return {"recording": recording}


def _now_s() -> float:
    return asyncio.get_running_loop().time()
