"""Conducts calibrations: one at a time, by the state table, from request to record.

Who may start one, who takes over one that runs by itself, and what becomes of its end; what it does in between is
`course`. Nothing is ever cut off in the middle of a write: a cancel waits for the next safe point.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Collection, Coroutine
from typing import Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState, VehicleEvent
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Severity, Weight
from companion.component.tunes import Tune
from companion.daemon.calibrating.course import Course
from companion.daemon.calibrating.results import Results
from companion.daemon.calibrating.why_not import Obstacle, Rung, StartLimit, obstacle
from companion.daemon.core import Core
from companion.daemon.job import Job, JobCancelledError, Undone
from companion.daemon.offsets.ledger import Recovery
from companion.daemon.stands.by_hand import ByHand
from companion.errors import CompanionError
from companion.estimation.collector.outlook import Settings
from companion.estimation.machine import Event, State
from companion.estimation.request import What
from companion.estimation.solution.draft import in_words
from companion.links.system.listeners import Listeners
from companion.storage.changes import AUTOMATIC, BY_HAND, ChangeSet

logger = logging.getLogger(__name__)


class Conductor:
    """The calibration service behind MAVLink, the control socket and whoever else asks."""

    def __init__(
        self,
        core: Core,
        course: Course,
        recovery: Recovery,
        results: Results,
        by_hand: ByHand,
    ) -> None:
        self._core, self._machine, self._wanted = core, core.machine, core.wanted
        self._vehicle, self._collector, self._say, self._tunes = core.vehicle, core.collector, core.say, core.tunes
        self._course, self._recovery, self.results, self._by_hand = course, recovery, results, by_hand
        self._has_gradienter = core.config.gradienter is not None
        self._starts = StartLimit()
        self._task: asyncio.Task[None] | None = None
        self.job: Job | None = None
        self.reason = ""
        """What the present state means, in words."""
        self.on_ended: Listeners[Job, JobResult] = Listeners()
        """Told of every end, before the requester is."""
        core.vehicle.on_event.add(self._on_event)
        core.wanted.on_retarget.add(self._retarget)
        recovery.on_recovered.add(self._recovered)
        recovery.note_undone = self._undone_by_recovery

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
    def running(self) -> Job | None:
        """The job under way."""
        return self.job if self.job is not None and self.job.is_running else None

    def why_not(self, rungs: Collection[Rung] = tuple(Rung)) -> Obstacle | None:
        """What of these stands in the way of starting something."""
        return obstacle(self._vehicle, self._recovery.ledger, self.running, rungs)

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat."""
        if self._machine.state.busy:
            return mavlink.MAV_STATE_CALIBRATING
        if self._recovery.ledger.fault is not None:
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
        """Start a calibration, or say why not; one that runs by itself and does all of this becomes the requester's."""
        deadline_s = _deadline_s(timeout_s)
        running = self._by_itself()
        whole = running is not None and not running.cancelled and not running.held_back
        if running is not None and whole and running.kind == AUTOMATIC and running.what in (what, What.BOTH):
            running.adopt(requester, deadline_s, reboot=reboot)
            return running
        untold = what is What.ACCELEROMETERS and not self._has_gradienter
        missing = "accelerometers need a gradienter: none is configured" if untold else None
        if (refusal := self._refusal(requester, missing)) is not None:
            return refusal
        kind = AUTOMATIC if automatic else "calibration"
        job = Job(kind, what, requester, deadline_s, reboot=reboot, automatic=automatic)
        return self._start(job, Event.REQUEST, self._calibrate(job))

    def start_job(
        self,
        kind: str,
        what: What,
        requester: str,
        timeout_s: float | None,
        missing: str | None,
        run: Callable[[Job], Awaitable[str]],
    ) -> Job | Refusal:
        """Start what is no calibration, or say why not.

        Args:
            kind: one of `NO_CALIBRATION`.
            what: which biases it is about.
            requester: for the log.
            timeout_s: for what waits for stillness.
            missing: why it cannot be done on this aircraft, if so.
            run: does it, and says in words what came of it.
        """
        if (refusal := self._refusal(requester, missing)) is not None:
            return refusal
        job = Job(kind, what, requester, _deadline_s(timeout_s))
        return self._start(job, Event.REQUEST, self._keep_by_hand(job, run))

    async def _keep_by_hand(self, job: Job, run: Callable[[Job], Awaitable[str]]) -> None:
        result = await _result(job, run(job))
        await self._by_hand.keep(job, result)
        self._collector.retarget(self._wanted.settings)
        self._end(job, result)

    def start_undo(self, requester: str, *, force: bool = False) -> Job | Refusal:
        """Start putting back the values from before the last write, or say why not (see `Recovery.undo`)."""
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
        if (refusal := self._refusal(requester, self._recovery.why_no_undo(), "nothing_to_undo")) is not None:
            return refusal
        job = Job("undo", What.BOTH, requester, None)
        return self._start(job, Event.UNDO, self._undo(job, force=force))

    def cancel(self, requester: str) -> bool:
        """Cancel what runs; whether something was running."""
        if self.running is None:
            return False
        self.running.cancel(requester)
        return True

    async def close(self) -> None:
        """Stop: cancel what runs and wait until it has left the autopilot in order."""
        self.cancel("the daemon's end")
        if self._task is not None:
            await asyncio.wait([self._task])

    # --- starting and ending

    def _refusal(
        self, requester: str, missing: str | None, kind: Literal["other", "nothing_to_undo"] = "other"
    ) -> Refusal | None:
        if self._core.only_listening is not None:
            return Refusal("other", self._core.only_listening)
        if (found := self.why_not()) is not None:
            return found.refusal
        return self._starts.refuses(requester) if missing is None else Refusal(kind, missing)

    def _by_itself(self) -> Job | None:
        """The calibration that runs without anybody having asked for it, while disarmed."""
        job = self.running
        return job if job is not None and job.automatic and self._vehicle.arm_state is ArmState.DISARMED else None

    def _start(self, job: Job, event: Event, work: Coroutine[None, None, None]) -> Job:
        self._machine.on(event)
        self.job = job
        logger.info("%s asked for by %s", job.kind, job.requester)
        self._task = asyncio.get_running_loop().create_task(work, name=job.kind)
        return job

    def _end(self, job: Job, result: JobResult) -> None:
        """A job is over; the state table knows already if it is done."""
        if result.outcome != "done":
            self._machine.on(Event.FAULT if result.outcome == "failed" else Event.CANCEL)
        self.reason = result.reason
        severity = {"done": Severity.NOTICE, "failed": Severity.ERROR, "cancelled": Severity.NOTICE}[result.outcome]
        told = result.outcome == "cancelled"  # and by whom
        words = f"{job.kind.capitalize()} {result.reason if told else f'{result.outcome}: {result.reason}'}"
        logger.log(logging.ERROR if result.outcome == "failed" else logging.INFO, "%s", words)
        if not (job.automatic and result.outcome == "failed" and self._vehicle.arm_state is ArmState.ARMED):
            # The pilot who has just armed has no use for the end of what nobody asked for.
            self._say(max(severity, Severity.WARNING) if job.automatic else severity, words, Weight.RESULT)
            if self.why_not((Rung.PENDING,)) is not None:
                self._say(Severity.WARNING, "Old values NOT back: disarm, keep it connected", Weight.RESULT)
        if not job.automatic and result.outcome != "cancelled":
            self._tunes.play(Tune.DONE if result.outcome == "done" else Tune.FAILED)
        self.on_ended.tell(job, result)
        job.finish(result)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "armed":
            if self.job is not None:
                self.job.note_armed()
            self._collector.reset("armed")
        elif event == "disarmed":
            self._collector.reset("just disarmed")

    def _retarget(self, settings: Settings) -> None:
        if self.running is None:
            self._collector.retarget(settings)

    def _recovered(self, words: str) -> None:
        """What was put in order is what `status` says last."""
        self.reason = words

    async def _calibrate(self, job: Job) -> None:
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        draft = self._core.draft(before=self.results.good)

        async def run() -> str:
            await self._course.run(job, draft)
            return "; ".join([in_words(draft), *draft.notes])

        result = await _result(job, run())
        record = draft.record(result.outcome, result.reason, loop.time() - started_s)
        job.deliver(record)
        await self.results.keep(record, started_s, draft.measured_s)
        self._collector.retarget(self._wanted.settings)
        self._end(job, result)

    # --- an undo

    async def _undo_instead(self, before: asyncio.Task[None], taken: Job, job: Job, *, force: bool) -> None:
        """An undo that came while a calibration ran by itself: what that has written goes first."""
        await asyncio.wait([before])
        record = taken.record
        self._machine.on(Event.UNDO)
        if record is not None and record.state == "cancelled" and record.written:
            self._machine.on(Event.CONCLUDED)
            self._end(job, JobResult("done", "auto calibration taken back"))
        else:
            await self._undo(job, force=force)

    async def _undo(self, job: Job, *, force: bool) -> None:
        async def run() -> str:
            step, written = await self._recovery.undo(force=force)
            job.deliver(Undone(step, written, await self._note_undone(step)))
            self._machine.on(Event.CONCLUDED)
            return f"{len(written)} old values back{step.origin.what and f': {step.origin.what}'}"

        self._end(job, await _result(job, run()))

    async def _undone_by_recovery(self, step: ChangeSet, words: str) -> None:
        """An undo that was interrupted has come to its end."""
        job = Job("undo", What.BOTH, "recovery", None)
        job.deliver(Undone(step, {}, await self._note_undone(step)))
        result = JobResult("done", words)
        self.on_ended.tell(job, result)
        job.finish(result)

    async def _note_undone(self, step: ChangeSet) -> bool:
        """Note in the history that a step is no longer in force; whether it was no calibration's."""
        if step.origin.what in BY_HAND:
            await self._by_hand.undone(step)
            return True
        return not await self.results.undone(step)


def _deadline_s(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else asyncio.get_running_loop().time() + timeout_s


async def _result(job: Job, work: Awaitable[str]) -> JobResult:
    """How the work ends, in words; whatever it raises ends here."""
    try:
        return JobResult("done", await work)
    except JobCancelledError as cancelled:
        return JobResult("cancelled", str(cancelled))
    except CompanionError as error:
        return JobResult("failed", str(error))
    except Exception as error:
        logger.exception("the %s met a fault of the program", job.kind)
        return JobResult("failed", f"internal error: {error!r}; the log has the details")
