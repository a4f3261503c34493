"""Conducts calibrations: one at a time, by the state table, from request to record.

Everything that reads a clock or touches a device stands around this: samples come into the collector, the pusher
writes, the store keeps. Nothing here is ever cut off in the middle of a write: a cancel waits for the next safe point.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
import math
from collections.abc import Callable, Coroutine, Mapping
from typing import Final, Literal

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle import ArmState, Vehicle, VehicleEvent
from companion.calibration.machine import Event, Machine, State
from companion.calibration.record import Record
from companion.calibration.request import What
from companion.calibration.rolling import RollingCollector, Settings, Window
from companion.calibration.site import local_earth
from companion.calibration.solve import Solution, solve
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Severity, Weight
from companion.config import Config
from companion.daemon import models
from companion.daemon.autopilot_imu import AutopilotImu
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.ledger import Offload
from companion.daemon.mend import Mender
from companion.daemon.push import Pusher
from companion.daemon.report import Draft
from companion.errors import AutopilotError, CalibrationRefusedError, CompanionError, StorageError
from companion.physics.units import DEG_H, MG
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)

Say = Callable[[Severity, str, Weight], object]

POLL_S: Final = 0.2
SAY_WAITING_EVERY_S: Final = 10.0
READ_ATTEMPTS: Final = 2
"""So often, within one calibration, the autopilot's offsets may fail to be read."""
# Shares of the progress bar: measuring, then writing, then verifying.
MEASURED_PERCENT: Final = 70.0
WRITTEN_PERCENT: Final = 80.0


class Conductor:
    """The calibration service behind MAVLink, the control socket and whoever else asks."""

    def __init__(
        self,
        config: Config,
        vehicle: Vehicle,
        collector: RollingCollector,
        imus: Mapping[str, AutopilotImu],
        pusher: Pusher,
        mender: Mender,
        store: RecordStore,
        say: Say,
        offload: Offload,
    ) -> None:
        self._config, self._vehicle, self._collector = config, vehicle, collector
        self._imus, self._pusher, self._mender, self._store = imus, pusher, mender, store
        self._say, self._offload = say, offload
        self._machine = Machine()
        self._task: asyncio.Task[None] | None = None
        self.job: Job | None = None
        self.last: Record | None = None
        self.reason = "ready"
        """What the present state means, in words."""
        self.settings = models.settings(config)
        self.at_arm = config.calibration.at_arm
        self.only_listening: str | None = None
        """Why nothing may be started although requests arrive: a check listens and must change nothing."""
        self.on_result: Callable[[Record], None] = lambda record: None
        self._done_s: float | None = None
        self._undone = False
        mender.on_mended = self._mended
        self._unsubscribe = vehicle.watch(self._on_event)

    # --- what others ask of it (component.service.CalibrationService)

    @property
    def state(self) -> State:
        """Where the calibration stands."""
        return self._machine.state

    @property
    def mav_state(self) -> int:
        """MAV_STATE_* for the heartbeat."""
        if self._machine.state.busy:
            return mavlink.MAV_STATE_CALIBRATING
        if self._mender.fault is not None:
            return mavlink.MAV_STATE_CRITICAL
        return mavlink.MAV_STATE_ACTIVE if self._vehicle.arm_state is ArmState.ARMED else mavlink.MAV_STATE_STANDBY

    def start_calibration(self, what: What, requester: str, timeout_s: float | None = None) -> Job | Refusal:
        """Start a calibration, or say why not."""
        refusal = self._refusal()
        if refusal is not None:
            return refusal
        if what is What.ACCELEROMETERS and self._config.gradienter is None:
            return Refusal("other", "accelerometers need a gradienter: none is configured")
        deadline_s = None if timeout_s is None else asyncio.get_running_loop().time() + timeout_s
        job = Job("calibration", what, requester, deadline_s)
        return self._start(job, Event.REQUEST, self._calibrate(job))

    def start_undo(self, requester: str) -> Job | Refusal:
        """Start putting back the values from before the last calibration, or say why not."""
        refusal = self._refusal()
        if refusal is not None:
            return refusal
        why = self._mender.why_no_undo()
        if why is not None:
            return Refusal("nothing_to_undo", why)
        job = Job("undo", What.BOTH, requester, None)
        return self._start(job, Event.UNDO, self._undo(job))

    def cancel(self, requester: str) -> bool:
        """Cancel what runs; whether something was running."""
        if self.job is None or self.job.finished.done():
            return False
        self.job.cancel(requester)
        return True

    def retarget(self, *, gyro_sigma_rad_s: float | None = None, accel_sigma_m_s2: float | None = None) -> None:
        """Change how good is good enough, from the next look on."""
        changes = {"target_gyro_sigma_rad_s": gyro_sigma_rad_s, "target_accel_sigma_m_s2": accel_sigma_m_s2}
        self.settings = msgspec.structs.replace(
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
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            age_s = self._vehicle.heartbeat_age_s
            return Refusal(
                "unknown", "no autopilot heard yet" if age_s is None else f"no heartbeat for {age_s:.0f} s: armed?"
            )
        if self._mender.fault is not None:
            return Refusal("other", self._mender.fault)
        if self._mender.pending:
            return Refusal("busy", "putting old values back first")
        return None

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
        self._say(severity, words, Weight.RESULT)
        job.finish(result)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "armed":
            self._collector.reset("armed")
            if self.at_arm != "off":
                self._say(Severity.WARNING, f"Armed: {self._in_force()}", Weight.NEWS)
        elif event == "disarmed":
            self._collector.reset("just disarmed")

    def _mended(self, words: str) -> None:
        """What the mender has put in order is what `status` says last."""
        self.reason = words

    def _in_force(self) -> str:
        """How fresh the calibration is; one of an earlier power-up says nothing about these biases."""
        if self._machine.state in (State.WRITING, State.VERIFYING):
            return "in the middle of writing new offsets"
        if self._undone:
            return "the last calibration was undone"
        if self._done_s is None:
            return "not calibrated since the companion started"
        return f"calibrated {(asyncio.get_running_loop().time() - self._done_s) / 60:.0f} min ago"

    # --- a calibration

    async def _calibrate(self, job: Job) -> None:
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        draft = Draft(started_at=datetime.datetime.now(tz=datetime.UTC))
        outcome: Literal["done", "failed", "cancelled"]
        event: Event | None
        try:
            await self._measure_and_push(job, draft)
        except JobCancelledError as cancelled:
            outcome, reason, event = "cancelled", str(cancelled), Event.CANCEL
        except CompanionError as error:
            outcome, reason, event = "failed", str(error), Event.FAULT
        except Exception as error:
            logger.exception("the calibration met a fault of the program")
            outcome, reason, event = "failed", f"internal error: {error!r}; the log has the details", Event.FAULT
        else:
            outcome, reason, event = "done", _in_words(draft.solution), None
            self._done_s, self._undone = loop.time(), False
        record = draft.record(outcome, reason, loop.time() - started_s)
        self._collector.retarget(self.settings)
        job.record = self.last = record
        self.on_result(record)
        try:
            await self._offload(self._store.save, record)
        except StorageError as error:
            logger.error("%s", error)  # noqa: TRY400 - the traceback tells nothing more
            self._say(Severity.WARNING, f"Record not kept: {error}", Weight.NEWS)
        self._end(job, event, JobResult(outcome, reason))

    async def _measure_and_push(self, job: Job, draft: Draft) -> None:
        self._say(Severity.NOTICE, "Calibration started: keep the aircraft still", Weight.NEWS)
        self._collector.retarget(self._wanted(job.what))
        while True:
            window = await self._measure(job)
            if await self._pusher.offsets_still_hold():
                break
            # The window holds telemetry under other offsets than those now in force.
            self._machine.on(Event.MOVED)
        local = local_earth(models.whereabouts(self._config, self._vehicle))
        draft.solution = solution = solve(
            window,
            local,
            models.gradienter_model(self._config.gradienter),
            models.compass_model(self._config.compass),
            job.what,
        )
        plan = await self._pusher.plan(solution, draft)
        job.check_cancelled()
        if not plan.changes:
            self._machine.on(Event.NOTHING_TO_WRITE)
            return
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(plan.changes)} parameters")
        await self._pusher.write(plan, draft)
        self._machine.on(Event.WRITTEN)
        job.progress(WRITTEN_PERCENT, "watching the telemetry take the new offsets")

        def go_on(words: str) -> None:
            job.check_cancelled()
            share = self._collector.status(asyncio.get_running_loop().time()).still_s / self.settings.min_still_s
            job.progress(
                WRITTEN_PERCENT + (100.0 - WRITTEN_PERCENT) * min(share, 1.0),
                words or "watching the telemetry take the new offsets",
            )

        try:
            await self._pusher.verify(plan, window, draft, go_on)
        except JobCancelledError as cancelled:
            try:
                await self._pusher.roll_back(plan, draft, str(cancelled))
            except CompanionError as said:
                raise JobCancelledError(str(said)) from None
        except BaseException:
            self._pusher.leave_to_mender()
            raise
        self._machine.on(Event.VERIFIED)

    def _wanted(self, what: What) -> Settings:
        """The targets of what was asked for; the rest may be as bad as it likes."""
        return msgspec.structs.replace(
            self.settings,
            target_gyro_sigma_rad_s=self.settings.target_gyro_sigma_rad_s if what.gyros else math.inf,
            target_accel_sigma_m_s2=self.settings.target_accel_sigma_m_s2 if what.accelerometers else math.inf,
        )

    async def _measure(self, job: Job) -> Window:
        """Wait for stillness and for enough of it; returns the averages.

        Raises:
            CalibrationRefusedError: armed in the middle, out of time, or the readings fail their checks.
            JobCancelledError: cancelled.
        """
        loop = asyncio.get_running_loop()
        said_s = -math.inf
        said = ""
        failures = {name: imu.failures for name, imu in self._imus.items()}
        while True:
            now_s = loop.time()
            if self._vehicle.arm_state is ArmState.ARMED:
                raise CalibrationRefusedError("armed during the measurement; nothing was written")
            for name, imu in self._imus.items():
                failures[name] = min(failures[name], imu.failures)
                if imu.failures - failures[name] >= READ_ATTEMPTS:
                    # Patience is for what can change by itself; an autopilot that does not answer is a fault.
                    raise AutopilotError(f"imu {name}: {imu.problem}")
            status = self._collector.status(now_s)
            waiting_for = self._not_ready() or status.waiting_for
            if waiting_for is not None:
                if self.state is State.COLLECTING:
                    self._machine.on(Event.MOVED)
                job.progress(MEASURED_PERCENT * status.progress, waiting_for)
                if waiting_for != said and now_s - said_s >= SAY_WAITING_EVERY_S:
                    said, said_s = waiting_for, now_s
                    self._say(Severity.INFO, f"Calibration: {waiting_for}", Weight.NEWS)
            else:
                if self.state is State.WAITING:
                    self._machine.on(Event.STILL)
                job.progress(MEASURED_PERCENT * status.progress, f"still for {status.still_s:.0f} s, measuring")
                if status.enough:
                    self._machine.on(Event.ENOUGH)
                    job.progress(MEASURED_PERCENT, "working out the biases")
                    return self._collector.window(now_s)
            if job.deadline_s is not None and now_s >= job.deadline_s:
                raise CalibrationRefusedError(f"not finished in the time given: {job.words}")
            await job.pause(POLL_S)

    def _not_ready(self) -> str | None:
        """What of the autopilot is missing for a measurement, in one line."""
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            return "waiting for the autopilot's heartbeat"
        for imu in self._imus.values():
            if imu.stream.problem or imu.calibration is None:
                return f"waiting for imu {imu.name}: {imu.stream.problem or imu.problem}"
        return None

    # --- an undo

    async def _undo(self, job: Job) -> None:
        try:
            job.written = await self._mender.undo()
        except CompanionError as error:
            self._end(job, Event.FAULT, JobResult("failed", str(error)))
        except Exception as error:
            logger.exception("the undo met a fault of the program")
            self._end(job, Event.FAULT, JobResult("failed", f"internal error: {error!r}; the log has the details"))
        else:
            self._undone = True
            self._end(job, Event.RESTORED, JobResult("done", f"{len(job.written)} old values back"))


def _in_words(solution: Solution | None) -> str:
    """The figures of a result: the largest sigma over axes and IMUs; short enough for one STATUSTEXT."""
    if solution is None:
        return "nothing measured"
    parts: list[str] = []
    gyros = [imu.gyro_sigma_use_rad_s for imu in solution.imus if imu.gyro_rad_s is not None]
    accels = [imu.accel_sigma_use_m_s2 for imu in solution.imus if imu.accel_m_s2 is not None]
    if gyros:
        parts.append(f"{np.max(gyros) / DEG_H:.1f} deg/h")
    if accels:
        parts.append(f"{np.max(accels) / MG:.2f} mg")
    return f"sigma {', '.join(parts)}"
