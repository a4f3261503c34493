"""Conducts calibrations: one at a time, by the state table, from request to record.

Who may start one, who takes over one that runs by itself, and what becomes of its end; what it does in between is
`course`. Nothing is ever cut off in the middle of a write: a cancel waits for the next safe point.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
from collections.abc import Callable, Coroutine
from typing import Literal

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.calibration.collector.rolling import RollingCollector, Settings
from companion.calibration.collector.trace import Snapshot
from companion.calibration.machine import Event, State
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft, in_words
from companion.calibration.solution.record import Record
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Say, Severity, Weight
from companion.config import Config
from companion.daemon.calibrating.align_steps import Plan
from companion.daemon.calibrating.aligner import Aligner
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.calibrating.course import Course, Stage
from companion.daemon.calibrating.start_limit import StartLimit
from companion.daemon.job import ALIGNMENT, Job, JobCancelledError
from companion.daemon.offload import Offload
from companion.daemon.offsets.push import Pusher
from companion.daemon.offsets.recovery import Recovery
from companion.errors import CompanionError, StorageError
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)


class Conductor:
    """The calibration service behind MAVLink, the control socket and whoever else asks."""

    def __init__(
        self,
        config: Config,
        vehicle: Vehicle,
        collector: RollingCollector,
        course: Course,
        pusher: Pusher,
        recovery: Recovery,
        store: RecordStore,
        say: Say,
        offload: Offload,
        aligner: Aligner,
        memory: BiasMemory,
    ) -> None:
        self._memory = memory
        self._aligner = aligner
        self._config, self._vehicle, self._collector, self._course = config, vehicle, collector, course
        self._pusher, self._recovery, self._store = pusher, recovery, store
        self._say, self._offload = say, offload
        self._machine = course.machine
        self._starts = StartLimit()
        self._task: asyncio.Task[None] | None = None
        self.job: Job | None = None
        self.last: Record | None = None
        self.reason = "ready"
        """What the present state means, in words."""
        self.at_arm = config.calibration.at_arm
        self.only_listening: str | None = None
        """Why nothing may be started although requests arrive: a check listens and must change nothing."""
        self.on_result: Callable[[Record], None] = lambda record: None
        self.on_ended: Callable[[Job, JobResult], None] = lambda job, result: None
        """Told of every end, before the requester is."""
        recovery.on_mended = self._mended
        self._unsubscribe = vehicle.watch(self._on_event)

    # --- what others ask of it (component.service.CalibrationService)

    @property
    def progress_percent(self) -> int:
        """Of the latest job; 100 from `done` on, though its record may still be on its way to the disk."""
        if self.job is None or self._machine.state is State.DONE:
            return 100
        return self.job.progress_percent

    @property
    def state(self) -> State:
        """Where the calibration stands."""
        return self._machine.state

    @property
    def settings(self) -> Settings:
        """How good is good enough."""
        return self._course.settings

    @property
    def is_writing(self) -> bool:
        """Whether offsets are being changed and not yet known to be right."""
        return self._machine.state in (State.WRITING, State.VERIFYING) or self._course.is_dithering

    @property
    def stage(self) -> Stage | None:
        """What of a write is under way; None while nothing is being written."""
        undoing = self.job is not None and self.job.kind == "undo" and self._machine.state is State.WRITING
        return "putting back" if undoing else self._course.stage

    @property
    def settling_s(self) -> float:
        """For how long the autopilot's EKF will be waited for yet, at most."""
        return self._course.settling_s

    @property
    def dither_s(self) -> float:
        """How long a dither under way will take yet."""
        return self._course.dither_s

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat."""
        if self._machine.state.busy:
            return mavlink.MAV_STATE_CALIBRATING
        if self._recovery.fault is not None:
            return mavlink.MAV_STATE_CRITICAL
        return mavlink.MAV_STATE_ACTIVE if self._vehicle.arm_state is ArmState.ARMED else mavlink.MAV_STATE_STANDBY

    def start_calibration(
        self,
        what: What,
        requester: str,
        timeout_s: float | None = None,
        *,
        automatic: bool = False,
        reboot: bool = False,
    ) -> Job | Refusal:
        """Start a calibration, or say why not; one that runs by itself and does all of this becomes the requester's.

        Args:
            what: which biases.
            requester: who asks.
            timeout_s: how long measuring may take.
            automatic: nobody has asked.
            reboot: restart the autopilot when the result is stored.
        """
        deadline_s = None if timeout_s is None else asyncio.get_running_loop().time() + timeout_s
        running = self._by_itself()
        whole = running is not None and not running.cancelled and not running.held_back
        if running is not None and whole and running.what in (what, What.BOTH):
            running.adopt(requester, deadline_s)
            running.reboot |= reboot
            return running
        refusal = self._refusal()
        if refusal is not None:
            return refusal
        if what is What.ACCELEROMETERS and self._config.gradienter is None:
            return Refusal("other", "accelerometers need a gradienter: none is configured")
        kind = "auto calibration" if automatic else "calibration"
        if (refusal := self._starts.refuses(requester)) is not None:
            return refusal
        job = Job(kind, what, requester, deadline_s, reboot=reboot)
        job.automatic = automatic
        return self._start(job, Event.REQUEST, self._calibrate(job))

    def start_alignment(self, plan: Plan, requester: str, timeout_s: float) -> Job | Refusal:
        """Start measuring the gradienter's zero, or say why not."""
        refusal = self._refusal()
        if refusal is not None:
            return refusal
        if self._config.gradienter is None:
            return Refusal("other", "there is no gradienter to align: none is configured")
        if (refusal := self._starts.refuses(requester)) is not None:
            return refusal
        job = Job(ALIGNMENT, What.BOTH, requester, asyncio.get_running_loop().time() + timeout_s)
        return self._start(job, Event.REQUEST, self._align(job, plan))

    def start_undo(self, requester: str, *, force: bool = False) -> Job | Refusal:
        """Start putting back the values from before the last calibration, or say why not (see `Recovery.undo`)."""
        running = self._by_itself()
        if running is not None and self._task is not None:
            # Somebody who wants old values back must not wait for new ones that nobody asked for.
            if (refusal := self._starts.refuses(requester)) is not None:
                return refusal
            running.cancel(requester)
            self.job = Job("undo", What.BOTH, requester, None)
            work = self._undo_instead(self._task, running, self.job, force=force)
            self._task = asyncio.get_running_loop().create_task(work, name="undo")
            return self.job
        refusal = self._refusal()
        if refusal is not None:
            return refusal
        why = self._recovery.why_no_undo()
        if why is not None:
            return Refusal("nothing_to_undo", why)
        if (refusal := self._starts.refuses(requester)) is not None:
            return refusal
        job = Job("undo", What.BOTH, requester, None)
        return self._start(job, Event.UNDO, self._undo(job, force=force))

    def cancel(self, requester: str) -> bool:
        """Cancel what runs; whether something was running."""
        if self.job is None or self.job.finished.done():
            return False
        self.job.cancel(requester)
        return True

    def retarget(self, *, gyro_sigma_rad_s: float | None = None, accel_sigma_m_s2: float | None = None) -> None:
        """Change how good is good enough, from the next look on."""
        changes = {"target_gyro_sigma_rad_s": gyro_sigma_rad_s, "target_accel_sigma_m_s2": accel_sigma_m_s2}
        self._course.settings = msgspec.structs.replace(
            self.settings, **{key: value for key, value in changes.items() if value is not None}
        )
        if self.job is None or self.job.finished.done():
            self._collector.retarget(self.settings)

    @property
    def push_parameters(self) -> bool:
        """Whether results are written to the autopilot."""
        return self._pusher.enabled

    @push_parameters.setter
    def push_parameters(self, value: bool) -> None:
        self._pusher.enabled = value

    async def close(self) -> None:
        """Stop: cancel what runs and wait until it has left the autopilot in order."""
        self._unsubscribe()
        self.cancel("the daemon's end")
        if self._task is not None:
            await asyncio.wait([self._task])

    # --- starting and ending

    def _refusal(self) -> Refusal | None:
        if self.only_listening is not None:
            return Refusal("other", self.only_listening)
        if self.job is not None and not self.job.finished.done():
            return Refusal("busy", f"a {self.job.kind} is running ({self.job.words or self.state.value})")
        if self._vehicle.arm_state is ArmState.ARMED:
            return Refusal("armed", "armed: disarm first")
        if (conflict := self._vehicle.conflict) is not None:
            return Refusal("unknown", conflict)
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            age_s = self._vehicle.heartbeat_age_s
            return Refusal(
                "unknown", "no autopilot heard yet" if age_s is None else f"no heartbeat for {age_s:.0f} s: armed?"
            )
        if self._recovery.fault is not None:
            return Refusal("other", self._recovery.fault)
        if self._recovery.pending:
            return Refusal("busy", "putting old values back first")
        return None

    def _by_itself(self) -> Job | None:
        """The calibration that runs without anybody having asked for it, while disarmed."""
        job = self.job
        if job is None or job.finished.done() or not job.automatic:
            return None
        return job if self._vehicle.arm_state is ArmState.DISARMED else None

    def _start(self, job: Job, event: Event, work: Coroutine[None, None, None]) -> Job:
        self._machine.on(event)
        self.job = job
        logger.info("%s asked for by %s", job.kind, job.requester)
        self._task = asyncio.get_running_loop().create_task(work, name=job.kind)
        return job

    def _end(self, job: Job, event: Event | None, result: JobResult) -> None:
        if event is not None:
            self._machine.on(event)
        self.reason = result.reason
        severity = {"done": Severity.NOTICE, "failed": Severity.ERROR, "cancelled": Severity.NOTICE}[result.outcome]
        told = result.reason.startswith(result.outcome)
        words = f"{job.kind.capitalize()} {result.reason if told else f'{result.outcome}: {result.reason}'}"
        logger.log(logging.ERROR if result.outcome == "failed" else logging.INFO, "%s", words)
        if not (job.automatic and result.outcome == "failed" and self._vehicle.arm_state is ArmState.ARMED):
            # The pilot who has just armed has no use for the end of what nobody asked for.
            self._say(max(severity, Severity.WARNING) if job.automatic else severity, words, Weight.RESULT)
        self.on_ended(job, result)
        job.finish(result)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "armed":
            if self.job is not None:
                self.job.armed = True
            self._collector.reset("armed")
        elif event == "disarmed":
            self._collector.reset("just disarmed")

    def _mended(self, words: str) -> None:
        """What the recovery has put in order is what `status` says last."""
        self.reason = words

    # --- a calibration

    async def _calibrate(self, job: Job) -> None:
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        draft = Draft(datetime.datetime.now(tz=datetime.UTC), self._vehicle.system_id)
        outcome: Literal["done", "failed", "cancelled"]
        event: Event | None
        try:
            await self._course.run(job, draft)
        except JobCancelledError as cancelled:
            outcome, reason, event = "cancelled", str(cancelled), Event.CANCEL
        except CompanionError as error:
            outcome, reason, event = "failed", str(error), Event.FAULT
        except Exception as error:
            logger.exception("the calibration met a fault of the program")
            outcome, reason, event = "failed", f"internal error: {error!r}; the log has the details", Event.FAULT
        else:
            outcome, reason, event = "done", "; ".join([in_words(draft.solution), *draft.notes]), None
        record = draft.record(outcome, reason, loop.time() - started_s)
        seen = self._collector.snapshot(started_s, draft.measured_s)
        self._collector.retarget(self.settings)
        job.record = self.last = record
        self.on_result(record)
        try:
            if record.is_worth_keeping:
                await self._offload(self._keep, record, seen)
        except StorageError as error:
            logger.error("%s", error)  # noqa: TRY400 - the traceback tells nothing more
            self._say(Severity.WARNING, f"Record not kept: {error}", Weight.NEWS)
        self._end(job, event, JobResult(outcome, reason))

    def _keep(self, record: Record, seen: Snapshot) -> None:
        """Blocking: the record and what lies beside it."""
        try:
            trace = seen.trace(record.started_at)
        except Exception:
            # What is nice to look at later must not cost the record.
            logger.exception("the readings of this calibration cannot be kept")
            trace = None
        self._store.save(record, trace)

    async def _align(self, job: Job, plan: Plan) -> None:
        try:
            words = await self._aligner.run(job, plan)
        except JobCancelledError as cancelled:
            self._end(job, Event.CANCEL, JobResult("cancelled", str(cancelled)))
        except CompanionError as error:
            self._end(job, Event.FAULT, JobResult("failed", str(error)))
        except Exception as error:
            logger.exception("the alignment met a fault of the program")
            self._end(job, Event.FAULT, JobResult("failed", f"internal error: {error!r}; the log has the details"))
        else:
            self._end(job, None, JobResult("done", words))

    # --- an undo

    async def _undo_instead(self, before: asyncio.Task[None], taken: Job, job: Job, *, force: bool) -> None:
        """An undo that came while a calibration ran by itself: what that has written goes first."""
        await asyncio.wait([before])
        record = taken.record
        taken_back = record is not None and record.state == "cancelled" and _has_written(record)
        self._machine.on(Event.UNDO)
        if taken_back:
            self._end(job, Event.RESTORED, JobResult("done", "auto calibration taken back"))
        elif (why := self._recovery.why_no_undo()) is not None:
            self._end(job, Event.FAULT, JobResult("failed", why))
        else:
            await self._undo(job, force=force)

    async def _undo(self, job: Job, *, force: bool) -> None:
        try:
            job.written = await self._recovery.undo(force=force)
        except CompanionError as error:
            self._end(job, Event.FAULT, JobResult("failed", str(error)))
        except Exception as error:
            logger.exception("the undo met a fault of the program")
            self._end(job, Event.FAULT, JobResult("failed", f"internal error: {error!r}; the log has the details"))
        else:
            if self._vehicle.system_id is not None:
                now = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds")
                last = self.last
                if last is not None and last.state == "done" and last.system_id == self._vehicle.system_id:
                    self.last = msgspec.structs.replace(last, undone_at=now) if _has_written(last) else last
                    await self._memory.forget(last.started_at)
                try:
                    await self._offload(self._store.mark_undone, self._vehicle.system_id, now)
                except StorageError as error:
                    logger.error("the history does not show the undo: %s", error)  # noqa: TRY400 - one line
            self._end(job, Event.RESTORED, JobResult("done", f"{len(job.written)} old values back"))


def _has_written(record: Record) -> bool:
    return any(imu.written for imu in record.imus)
