"""One calibration from request to record: its state, and its phases in their order.

`CalibrationRun.calibrate` runs the phases. A phase reports events to the state machine (`estimation.machine`), and
raises an error if the calibration cannot go on.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import msgspec

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, changes_for
from companion.autopilot.parameters.change import WriteFailedError
from companion.component.service import WRITTEN_PERCENT, JobResult
from companion.component.statustext import Severity, Tune
from companion.daemon.biases import BiasMemory
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.effect import TELEMETRY
from companion.daemon.offsets.plan import (
    ImuPlan,
    Plan,
    WriteLog,
    as_good,
    refuse_shared,
    residual_of_consumer,
    warnings_of,
    without,
)
from companion.daemon.offsets.subsystem import WATCHING, Offsets
from companion.daemon.poses.measuring import Estimator, Measuring
from companion.estimation.machine import Event, What
from companion.estimation.means.windows import Window
from companion.estimation.records.history import Point
from companion.estimation.records.record import AlignmentUsed, ImuRecord, Record
from companion.estimation.solution.doubt import Inconsistency
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.results import imu_records, in_words, record_of, unseen_turn
from companion.estimation.solution.solve import ImuSolution, Solution
from companion.physics.frames import vector
from companion.samples import Triad
from companion.storage.changes import AUTOMATIC

logger = logging.getLogger(__name__)

Key = tuple[str, Triad]  # Name of an IMU, and its gyros or its accelerometers

WRONG_IMU_ATTEMPTS: Final = 3
"""Maximum number of write attempts: with three IMUs, the first two attempts can write to the wrong IMU."""
_TRIADS: Final[dict[Triad, str]] = {"gyro": "gyros of", "accel": "accelerometers of"}


class CalibrationParts(NamedTuple):
    core: Core
    imus: Mapping[str, AutopilotImu]
    measuring: Measuring
    estimator: Estimator
    memory: BiasMemory
    offsets: Offsets


class CalibrationRun(Job):
    """One calibration; the base class `Job` has its request, progress, cancel and outcome."""

    def __init__(
        self,
        parts: CalibrationParts,
        what: What,
        requester: str,
        timeout_s: float | None,
        before: Record | None,
        *,
        reboot: bool = False,
        automatic: bool = False,
    ) -> None:
        """Prepare a calibration; `before`: record of the last calibration, if it was good and has not been undone."""
        kind = AUTOMATIC if automatic else "calibration"
        super().__init__(kind, what, requester, timeout_s, reboot=reboot, automatic=automatic)
        self._parts, self._core, self._machine = parts, parts.core, parts.core.machine
        self._imus, self._measuring, self._offsets = parts.imus, parts.measuring, parts.offsets
        self.system_id = parts.core.vehicle.system_id
        self._before = {} if before is None else {imu.name: imu for imu in before.imus}
        self.begun_s = asyncio.get_running_loop().time()
        self.log = WriteLog()
        self.alignment: AlignmentUsed | None = None
        """Active alignment of the gradienter; None: zero and sigma come from the configuration."""
        self.calibrations: dict[str, ImuCalibration] = {}
        """Offsets and scales that the autopilot applied to each of its IMUs during the measurement."""
        self.held_back: dict[Key, Inconsistency] = {}
        """Triads (gyros or accelerometers of an IMU) not written, as their biases contradict earlier ones."""
        self._forget()

    def _forget(self) -> None:
        self.measured: Window | None = None  # Window of telemetry under the active offsets
        self.solution: Solution | None = None
        """Estimated biases; of the autopilot's IMUs only the residuals that the present offsets leave."""
        self.points: dict[str, Point] = {}  # Biases by IMU for later predictions, stored on success
        self.unchanged: set[Key] = set()  # Triads whose old offsets stay, as good as new ones
        self.plan: Plan | None = None
        self.held_back.clear()
        self.log.written.clear()
        self.log.imu_warnings.clear()

    async def calibrate(self) -> str:
        """Run all phases; return the result in one line.

        After an error or a cancel, old parameter values are restored; the error names any that are not.
        """
        self._announce()
        self._measuring.begin()
        for attempts_left in reversed(range(WRONG_IMU_ATTEMPTS)):
            try:
                await self._measure()
                await self._estimate()
                await self._make_plan()
                await self._write_and_settle()
            except WriteFailedError as error:
                repeatable = error.kind in ("wrong slot, orientation or scale", "without effect")
                if not attempts_left or not repeatable or error.left_changed:
                    raise
                self._begin_again(error)
            else:
                break
        await self._remember()
        flown = {imu.name for imu in self._core.config.imu if imu.is_flown}
        records = [imu for imu in self._imu_records() if not flown or imu.name in flown]
        return "; ".join([in_words(self.solution, records), *self.log.notes])

    @property
    def is_adoptable(self) -> bool:
        return self.automatic and self.cancelled_by is None and not self.held_back

    def adopt(self, requester: str, timeout_s: float | None, *, reboot: bool) -> None:
        self.reboot |= reboot
        self.kind, self.requester, self.automatic = "calibration", requester, False
        self.limit(timeout_s)

    def _announce(self) -> None:
        if self.automatic:
            return
        if self._core.config.vehicle.platform == "ground":
            self._core.prompt(Tune.HOLD_STILL, "Calibration started: keep the aircraft still")
        else:
            self._core.say(Severity.NOTICE, "Calibration started: the deck may sway")

    def _begin_again(self, error: WriteFailedError) -> None:
        self._machine.on(Event.MOVED)
        logger.warning("%s; old values restored, measuring again", error.reason)
        self._forget()
        if error.kind == "wrong slot, orientation or scale":
            self.log.warnings.append(f"{error.reason}; old values restored, then written to the correct slot")
        else:
            self.log.warnings.append(f"{error.reason}; old values restored, trying again")
        self.check_cancelled()

    # --- the phases

    async def _measure(self) -> None:
        while True:
            self.measured = await self._measuring.measure(self)
            if await self._offsets.offsets_still_hold():
                return
            # The window was measured under other offsets than the present ones.
            self._machine.on(Event.MOVED)

    async def _estimate(self) -> None:
        """Estimate biases and combine them with earlier ones by weight; an automatic run holds back contradictions.

        A result that contradicts earlier ones is written on request only. If the gradienter has moved, an automatic
        write would spoil good offsets unnoticed.
        """
        assert self.measured is not None
        core, memory, unix_s = self._core, self._parts.memory, self.log.started_at.timestamp()
        estimator = self._parts.estimator
        solution, where, otherwise = await estimator.solve(self.measured, self.what)
        self.alignment, self.solution = estimator.alignment.used, solution
        self.log.warnings += filter(None, [estimator.alignment.warning])
        for name, words in memory.forgotten().items():
            self.log.warn(name, words)
        expectation: Expectation = await core.offload(memory.expectation, solution, unix_s)
        estimator.on_solved.tell(where, otherwise, self.what, expectation)
        self.calibrations = {imu.name: self._imus[imu.name].in_force for imu in solution.imus if imu.name in self._imus}
        solution = memory.with_offsets(solution)
        weighed: Solution = await core.offload(weigh, solution, expectation)
        # A run with a result held back cannot be adopted: a request must not get half of a result.
        if self.automatic and core.wanted.push:
            written = {imu.name for imu in core.config.imu if imu.is_flown}
            self.held_back = {key: doubt for key, doubt in weighed.doubted.items() if key[0] in written}
        self.solution = weighed
        points = memory.measured(solution, weighed.doubts, self.log.started, unix_s)
        self.points = _less(points, self.held_back)
        for doubt in weighed.doubts:
            core.say(Severity.WARNING, doubt.words)
        if not self.automatic:
            warm = [words for imu in self.solution.imus if imu.when_warm for words in imu.when_warm.words]
            for words in (*unseen_turn(self.solution), *warm):
                core.say(Severity.NOTICE, words)
        if self.held_back:
            kept = in_short(self.held_back)
            core.say(Severity.WARNING, f"Held back: {kept}; to write it, calibrate on request")

    async def _make_plan(self) -> None:
        """Plan the new offsets of all IMUs in use, and the switching off of settings that would overwrite offsets."""
        assert self.solution is not None
        core, rivalry, slots = self._core, self._offsets.rivalry, self._offsets.slots
        sources = {imu.name: imu for imu in core.config.imu}
        push = core.wanted.push  # read once, as it may change while parameters are read: for all IMUs or for none
        targets: list[ImuPlan] = []
        for estimate in self.solution.imus:
            imu, instance = self._imus.get(estimate.name), sources[estimate.name].autopilot_instance
            found = without(estimate, [triad for name, triad in self.held_back if name == estimate.name])
            if imu is not None:
                calibration = imu.in_force
                found = without(found, self._keep_as_good(calibration, found)) if push and not self.reboot else found
                residual = found.gyro_rad_s, found.accel_m_s2
            elif instance is not None:
                calibration = await read_calibration(core.parameters, instance, slots)
                residual = residual_of_consumer(calibration, found)
            else:
                continue
            self.log.warn(estimate.name, *rivalry.left_of(calibration))
            if push:
                changes = changes_for(calibration, *(None if each is None else vector(each) for each in residual))
                target = ImuPlan(found.name, calibration, tuple(changes), residual, watched=imu is not None)
                self.log.warn(target.name, *warnings_of(target, found))
                targets.append(target)
        refuse_shared(targets, slots)
        if targets:
            stops = rivalry.changes([target.calibration for target in targets])
            # Switch these settings off first, so that none acts during the write; an undo restores them last.
            targets[0] = dataclasses.replace(targets[0], changes=(*stops, *targets[0].changes))
            for change in stops:
                words = f"{change.parameter} is switched off; companion undo switches it on again"
                self.log.warn(targets[0].name, words)
        self.plan = Plan(tuple(targets), core.vehicle.boots)

    def _keep_as_good(self, calibration: ImuCalibration, found: ImuSolution) -> frozenset[Triad]:
        assert self.solution is not None
        kept = as_good(calibration, found, self.solution.shared, self._before.get(found.name))
        self.unchanged |= {(found.name, triad) for triad in kept}
        return kept

    async def _write_and_settle(self) -> None:
        assert self.plan is not None
        assert self.measured is not None
        if not self.plan.changes:
            self.check_cancelled()
            self._machine.on(Event.NOTHING_TO_WRITE)
            return
        self.plan = await self._offsets.write(self, self.plan, self.measured, self.log, self._watching)
        await self._offsets.settle(self, self.plan, self.measured, self.log)

    def _watching(self, words: str) -> None:
        self.check_cancelled()
        now_s, collector = asyncio.get_running_loop().time(), self._core.collector
        moves = collector.glance(now_s).moves
        if moves is not None and words != TELEMETRY:
            self._measuring.tell(self, moves)
        share = min(collector.status(now_s).still_s / self._core.wanted.settings.min_still_s, 1.0)
        self.progress(WRITTEN_PERCENT + (100.0 - WRITTEN_PERCENT) * share, words or WATCHING)

    async def _remember(self) -> None:
        points = self.points
        if self._core.wanted.push and not self.automatic:
            # The requester has got a message on each contradiction, and the biases are in use: mark them as chosen.
            # Leave out gyros if only earlier calibrations bounded the platform's turn: they bring nothing new.
            told = self.solution is not None and self.solution.turn.by != "earlier calibrations"
            points = {name: point.as_chosen(gyro=told) for name, point in points.items()}
        await self._parts.memory.keep(points)
        if self.held_back:
            self.log.notes.append(f"{in_short(self.held_back)} held back")

    # --- the record

    def make_record(self, result: JobResult) -> Record:
        record = record_of(
            self.solution,
            self.log.started_at,
            asyncio.get_running_loop().time() - self.begun_s,
            state=result.outcome,
            reason=result.reason,
            warnings=self.log.warnings,
            imus=self._imu_records(),
        )
        return msgspec.structs.replace(record, system_id=self.system_id, alignment=self.alignment)

    def _imu_records(self) -> tuple[ImuRecord, ...]:
        if self.solution is None:
            return ()
        known = self.calibrations
        return tuple(
            msgspec.structs.replace(
                imu,
                warnings=(*imu.warnings, *self.log.imu_warnings.get(imu.name, ())),
                written=self.log.written.get(imu.name, {}),
                held_back=tuple(triad for name, triad in self.held_back if name == imu.name),
                unchanged=tuple(sorted(triad for name, triad in self.unchanged if name == imu.name)),
                gyro_id=known[imu.name].gyro_id if imu.name in known else None,
                accel_id=known[imu.name].accel_id if imu.name in known else None,
            ).confirming(self._before.get(imu.name))
            for imu in imu_records(self.solution)
        )


def in_short(triads: Collection[Key]) -> str:
    return " and ".join(
        f"{words} {', '.join(name for name, of in triads if of == triad)}"
        for triad, words in _TRIADS.items()
        if any(of == triad for _, of in triads)
    )


def _less(points: Mapping[str, Point], held_back: Collection[Key]) -> dict[str, Point]:
    """Remove held-back results from the points to store: repeated measurements must not confirm each other."""
    left: dict[str, Point] = {}
    for name, point in points.items():
        kept = msgspec.structs.replace(point, **{triad: None for imu, triad in held_back if imu == name})
        if kept.gyro is not None or kept.accel is not None:
            left[name] = kept
    return left
