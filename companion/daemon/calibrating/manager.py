"""Manager that starts, cancels and undoes calibrations and other jobs, one at a time, and stores their records.

A request takes over a running automatic calibration. The module `run` contains the calibration itself. A cancel waits
for the next safe point and never interrupts a write.
"""

from __future__ import annotations

import asyncio
import enum
import logging
import math
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator
from typing import Final, Literal

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Severity, Tune, Weight
from companion.daemon.calibrating.run import CalibrationParts, CalibrationRun
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.offsets.journal import WriteJournal
from companion.daemon.poses.alignment import ByHand
from companion.errors import CompanionError, StorageError
from companion.estimation.machine import Event, State, What
from companion.estimation.records.record import Record
from companion.formats import utc_now
from companion.links.system.connection import Budget
from companion.links.system.events import Listeners
from companion.storage.changes import BY_HAND, ChangeSet
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)

STARTS_PER_S: Final = 1.0
"""Maximum sustained rate of job starts: no person is faster, but a script that starts and cancels might be."""
BURST: Final = 10.0


class Precondition(enum.Enum):
    """Conditions for the start of a job, in the order in which unmet ones are reported."""

    STORAGE = enum.auto()
    ONE_AUTOPILOT = enum.auto()
    IDLE = enum.auto()
    DISARMED = enum.auto()
    ARM_STATE_KNOWN = enum.auto()
    ONE_COMPANION = enum.auto()
    RESTORED = enum.auto()  # No restore of an interrupted write is pending


REFUSAL_KINDS: Final[dict[Precondition, Literal["armed", "unknown", "busy"]]] = {
    Precondition.ONE_AUTOPILOT: "unknown",
    Precondition.IDLE: "busy",
    Precondition.DISARMED: "armed",
    Precondition.ARM_STATE_KNOWN: "unknown",
    Precondition.RESTORED: "busy",
}
"""Kind of refusal for each unmet condition; conditions without an entry have the kind "other"."""


def blocked(vehicle: Vehicle, journal: WriteJournal, job: Job | None) -> Iterator[tuple[Precondition, str]]:
    if journal.fault is not None:
        yield Precondition.STORAGE, journal.fault
    if vehicle.conflict is not None:
        yield Precondition.ONE_AUTOPILOT, vehicle.conflict
    if job is not None and job.is_running:
        article = "an" if job.kind[0] in "aeiou" else "a"
        yield Precondition.IDLE, f"{article} {job.kind} is running ({job.words or 'waiting'})"
    if vehicle.arm_state is ArmState.ARMED:
        yield Precondition.DISARMED, "armed: disarm first"
    if vehicle.arm_state is ArmState.UNKNOWN:
        age_s = vehicle.heartbeat_age_s
        words = "no autopilot found yet" if age_s is None else f"no heartbeat for {age_s:.0f} s: power? cable?"
        yield Precondition.ARM_STATE_KNOWN, words
    if (why := journal.why_yield()) is not None:
        yield Precondition.ONE_COMPANION, why
    if journal.pending:
        yield Precondition.RESTORED, "restoring old values first"


class CalibrationManager:
    """Calibration service used by MAVLink, the control socket, MQTT and the web page."""

    def __init__(self, parts: CalibrationParts, store: RecordStore, by_hand: ByHand) -> None:
        core = parts.core
        self._parts, self._core, self._machine, self._vehicle = parts, core, core.machine, core.vehicle
        self._recovery, self._store, self._by_hand = parts.offsets.recovery, store, by_hand
        self._starts = Budget(STARTS_PER_S, BURST)
        self._task: asyncio.Task[None] | None = None
        self.job: Job | None = None
        """Running job, or the latest one if none is running."""
        self.asked: Job | None = None  # Latest job that somebody asked for, other than an undo
        self.reason = ""
        self.last: Record | None = None  # Record of the latest calibration, loaded from disk at start
        self._ended: Record | None = None  # Record of the latest one that nobody cancelled: it may have written offsets
        self.was_undone = False  # True if the last calibration that wrote had been undone before this start
        self.on_ended: Listeners[Job, JobResult] = Listeners()  # Notified when a job ends, before its requester
        core.vehicle.on_event.add(self._on_event)
        self._recovery.on_recovered = self._recovered

    def load(self) -> None:
        try:
            self.last = next((record for _, record in self._store.latest()), None)
            self._ended = next((record for _, record in self._store.latest() if record.state != "cancelled"), None)
            wrote = next((record for _, record in self._store.latest() if record.written), None)
            self.was_undone = wrote is not None and wrote.undone_at is not None
            if self.was_undone:
                self._ended = None  # a later result without a write was measured with the offsets that were undone
        except StorageError as error:
            logger.warning("%s; the companion continues without earlier records", error)

    # --- state, and requests (component.service.CalibrationService)

    @property
    def progress_percent(self) -> int:
        """Progress of the latest job in percent; 100 once it is done, even before its record is on disk."""
        if self.job is None or self._machine.state is State.DONE:
            return 100
        return self.job.progress_percent

    @property
    def state(self) -> State:
        return self._machine.state

    @property
    def running(self) -> Job | None:
        return self.job if self.job is not None and self.job.is_running else None

    @property
    def last_good(self) -> Record | None:
        found = self._ended
        return found if found is not None and found.state == "done" and not found.undone_at else None

    def blocking_reason(self, among: Collection[Precondition] = tuple(Precondition)) -> tuple[Precondition, str] | None:
        unmet = blocked(self._vehicle, self._recovery.journal, self.running)
        return next((found for found in unmet if found[0] in among), None)

    @property
    def mav_state(self) -> int:
        if self._machine.state.busy:
            return mavlink.MAV_STATE_CALIBRATING
        if self._recovery.journal.fault is not None:
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
        own = self._automatic_run()
        if isinstance(own, CalibrationRun) and own.is_adoptable and own.what in (what, What.BOTH):
            own.adopt(requester, timeout_s, reboot=reboot)
            self.asked = own
            return own
        untold = what is What.ACCELEROMETERS and self._core.config.gradienter is None
        missing = "accelerometers need a gradienter: none is configured" if untold else None
        alignment = self._parts.estimator.alignment
        if what.accelerometers and alignment.doubt is not None:  # their offsets would be wrong
            missing = alignment.warning
        if (refusal := self._refusal(missing)) is not None:
            return refusal
        run = CalibrationRun(
            self._parts, what, requester, timeout_s, self.last_good, reboot=reboot, automatic=automatic
        )
        return self._start(run, Event.REQUEST, self._finish(run, run.calibrate()))

    def start_job(self, job: Job, run: Callable[[Job], Awaitable[str]], missing: str | None) -> Job | Refusal:
        """Start a job other than a calibration, or return a refusal; `missing`: reason why the job is impossible."""
        if (refusal := self._refusal(missing)) is not None:
            return refusal
        return self._start(job, Event.REQUEST, self._finish(job, run(job)))

    def start_undo(self, requester: str, *, force: bool = False) -> Job | Refusal:
        """Start a job that restores the values before the last write (see `Recovery.undo`), or return a refusal."""
        running = self._automatic_run()
        missing = None if running is not None else self._recovery.why_no_undo()
        if (refusal := self._refusal(missing, "nothing_to_undo", but=running)) is not None:
            return refusal
        job = Job("undo", What.BOTH, requester)
        if running is None:
            return self._start(job, Event.UNDO, self._finish(job, self._undo(job, force=force)))
        # An undo does not wait for an automatic calibration.
        running.cancel(requester)
        return self._start(job, None, self._undo_instead(self._task, running, job, force=force))

    def cancel(self, requester: str) -> bool:
        if self.running is None:
            return False
        self.running.cancel(requester)
        return True

    async def close(self) -> None:
        """Cancel the running job and wait for its end, so that it has finished or rolled back its writes."""
        self.cancel("the companion's shutdown")
        if self._task is not None:
            await asyncio.wait([self._task])

    def _refusal(
        self, missing: str | None, kind: Literal["nothing_to_undo", "other"] = "other", *, but: Job | None = None
    ) -> Refusal | None:
        """Return a refusal if no job can start now, otherwise None; `but`: a running job to disregard."""
        if self._core.only_listening is not None:
            return Refusal("other", self._core.only_listening)
        if but is None and (found := self.blocking_reason()) is not None:
            return Refusal(REFUSAL_KINDS.get(found[0], "other"), found[1])
        if missing is not None:
            return Refusal(kind, missing)
        now_s = asyncio.get_running_loop().time()
        if (left := self._starts.left(now_s)) < 1.0:
            return Refusal("busy", f"too many requests, wait {math.ceil((1.0 - left) / STARTS_PER_S)} s")
        self._starts.spend(1, now_s)
        return None

    def _automatic_run(self) -> Job | None:
        job = self.running
        return job if job is not None and job.automatic and self._vehicle.arm_state is ArmState.DISARMED else None

    def _start(self, job: Job, event: Event | None, work: Coroutine[None, None, None]) -> Job:
        if event is not None:
            self._machine.on(event)
        self.job = job
        self.asked = self.asked if job.automatic or job.kind == "undo" else job
        logger.info("%s asked for by %s", job.kind, job.requester)
        self._task = asyncio.get_running_loop().create_task(work, name=job.kind)
        return job

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "armed":
            if self.job is not None:
                self.job.was_armed = True
            self._core.collector.reset("armed")
        elif event == "disarmed":
            self._core.collector.reset("just disarmed")

    # --- end of a job

    async def _finish(self, job: Job, work: Awaitable[str]) -> None:
        try:
            result = JobResult("done", await work)
        except JobCancelledError as cancelled:
            result = JobResult("cancelled", str(cancelled))
        except CompanionError as error:
            result = JobResult("failed", str(error))
        except Exception as error:
            logger.exception("the %s met a fault of the program", job.kind)
            result = JobResult("failed", f"internal error: {error!r}; the log has the details")
        if isinstance(job, CalibrationRun):
            job.product = record = job.make_record(result)
            await self._keep(record)
        else:
            await self._by_hand.keep(job, result)
        self._core.collector.retarget(self._core.wanted.settings)
        self._end(job, result)

    async def _undo_instead(self, task: asyncio.Task[None] | None, before: Job, job: Job, *, force: bool) -> None:
        assert task is not None
        await asyncio.wait([task])
        record = before.record
        self._machine.on(Event.UNDO)
        if record is not None and record.state == "cancelled" and record.written:
            self._machine.on(Event.CONCLUDED)
            self._end(job, JobResult("done", "auto calibration undone"))
        else:
            await self._finish(job, self._undo(job, force=force))

    async def _undo(self, job: Job, *, force: bool) -> str:
        step, written = await self._recovery.undo(force=force)
        job.undid_calibration = await self._note_undone(step)
        job.product = {"written": msgspec.to_builtins(written), "undone": step.shown()}
        self._machine.on(Event.CONCLUDED)
        return f"{len(written)} old values restored{step.origin.what and f': {step.origin.what}'}"

    def _end(self, job: Job, result: JobResult) -> None:
        if result.outcome != "done":
            self._machine.on(Event.FAULT if result.outcome == "failed" else Event.CANCEL)
        self.reason = result.reason
        severity = Severity.ERROR if result.outcome == "failed" else Severity.NOTICE
        outcome = "" if result.outcome == "cancelled" else f"{result.outcome}: "  # a cancel's reason begins with it
        words = f"{job.kind.capitalize()} {outcome}{result.reason}"
        logger.log(logging.ERROR if result.outcome == "failed" else logging.INFO, "%s", words)
        if not (job.automatic and result.outcome == "failed" and self._vehicle.arm_state is ArmState.ARMED):
            # After arming, the failure of an automatic calibration would only distract the pilot.
            self._core.say(max(severity, Severity.WARNING) if job.automatic else severity, words, Weight.RESULT)
            if self.blocking_reason((Precondition.RESTORED,)) is not None:
                self._core.say(Severity.WARNING, "Restore pending: disarm and keep the link up", Weight.RESULT)
        if not job.automatic and result.outcome != "cancelled":
            self._core.tunes.play(Tune.DONE if result.outcome == "done" else Tune.FAILED)
        self.on_ended.tell(job, result)
        job.finish(result)

    async def _recovered(self, step: ChangeSet, words: str, *, undone: bool) -> None:
        if undone:
            job = Job("undo", What.BOTH, "recovery")
            job.undid_calibration = await self._note_undone(step)
            result = JobResult("done", words)
            self.on_ended.tell(job, result)
            job.finish(result)
        self.reason = words

    # --- records

    async def _keep(self, record: Record) -> None:
        self.last = record
        self._ended = self._ended if record.state == "cancelled" else record
        try:
            if record.is_worth_keeping:
                await self._core.offload(self._store.save, record)
        except StorageError as error:
            logger.error("%s", error)  # noqa: TRY400 - the traceback tells nothing more
            self._core.say(Severity.WARNING, f"Record not kept: {error}")

    async def _note_undone(self, step: ChangeSet) -> bool:
        """Note in the history that a write was undone; return whether a calibration had made that write."""
        if step.origin.what in BY_HAND:
            await self._by_hand.undone(step.origin.at)
            return False
        now = utc_now()
        try:
            marked: list[str] = await self._core.offload(self._store.mark_undone, step, now)
        except StorageError as error:
            logger.error("the history does not show the undo: %s", error)  # noqa: TRY400 - one line
            marked = [step.origin.at] if step.origin.at else []
        self.last, self._ended = (
            each if each is None or each.started_at not in marked else msgspec.structs.replace(each, undone_at=now)
            for each in (self.last, self._ended)
        )
        await self._parts.memory.forget(marked)
        return bool(marked or step.origin.what)
