"""Writes to the autopilot: saved in a journal, read back, and checked in the telemetry; a failure restores old values.

Calibrations, alignments and temperature curves write through `Offsets`. An undo, and `Px4Writes.apply_stored_offsets`,
write directly, but inside a transaction of the journal.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping, Sequence
from typing import Final

from companion.autopilot.firmware.imu_calibration import hover_bias_changes
from companion.autopilot.parameters.change import Change, NothingWrittenError, WriteFailedError, same_float32
from companion.autopilot.parameters.verify import EffectVerdict
from companion.autopilot.vehicle import gyro_calibration
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core, Subsystem, Task
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.devices.subsystem import Devices
from companion.daemon.job import GoOn, Job, JobCancelledError
from companion.daemon.offsets.effect import UNWATCHED, in_short, verify_effect
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration, settles_within_s
from companion.daemon.offsets.journal import Recovery, WriteJournal
from companion.daemon.offsets.other_writers import FirmwareCalibrationWarnings, OtherCompanions
from companion.daemon.offsets.plan import ImuPlan, Plan, WriteLog
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.daemon.offsets.reboot import BACK_WITHIN_S, NotRebootedError, RequiredReboot, harm_of_reboot, reboot
from companion.errors import (
    AutopilotError,
    AutopilotRebootedError,
    CompanionError,
    NotDisarmedError,
    ParameterTimeoutError,
    StorageError,
)
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.record import WrittenParameter
from companion.formats import Object, utc_now
from companion.messages import message
from companion.storage.changes import ChangeLog, ChangeSet, Origin

logger = logging.getLogger(__name__)

DISARMED_WITHIN_S: Final = 10.0
"""Longest wait for a heartbeat before a write, if it is not known whether the aircraft is armed."""
WATCHING: Final = "checking the telemetry for the new offsets"
POLL_S: Final = 0.2
CONCLUDING_PERCENT: Final = 95.0
READ_ATTEMPTS: Final = 3

Note = Callable[[Mapping[str, WrittenParameter], Collection[str]], None]
"""Callback after a roll-back: restored parameters with their outcomes, and names of those that were not restored."""


class Offsets(Subsystem):
    """Writer of offset plans, each as a whole or not at all; it owns journal, recovery, restarts and related checks."""

    def __init__(self, core: Core, devices: Devices) -> None:
        vehicle, imus = core.vehicle, devices.imus
        self._core, self._vehicle, self._machine, self._imus = core, vehicle, core.machine, imus
        self.slots, self.owed = devices.slots, RequiredReboot(core)
        self.rivalry = FirmwareCalibrationWarnings(core, imus)
        self.companions = OtherCompanions(core.link, core.say, lambda: core.wanted.push)
        self.journal = WriteJournal(ChangeLog(core.config.storage.path), core.offload, self.companions.why_not)
        self.writer = ParameterWriter(core.parameters, vehicle)
        self._px4 = Px4Writes(core.link, vehicle, self.writer, self.journal, devices.slots, core.say)
        self._firmware = FirmwareCalibration(core, self.writer, self.journal)
        self.recovery = Recovery(core, self.writer, self.journal, imus, self.owed)

    def load(self) -> None:
        self.owed.load()
        self.journal.load()
        if self.journal.fault is not None:
            # Keep running and report the fault: a daemon that has ended is harder to diagnose in the field.
            logger.error("%s", self.journal.fault)

    def status(self) -> Object:
        others = [] if (words := self.companions.warning) is None else [words]
        return {
            "fault": self.journal.fault,
            "putting_back": self.journal.pending,
            "why_no_undo": self.recovery.why_no_undo(),
            "undoable": self.undoable(),
            "warnings": [*self.journal.unusable, *others, *self.rivalry.warnings],
        }

    def undoable(self) -> list[Object]:
        return [step.shown() for step in self.journal.steps(self._vehicle.system_id)]

    def tasks(self) -> Sequence[Task]:
        return [
            ("recovery", self.recovery.run),
            ("reboot-owed", self.owed.run),
            ("other-companions", self.companions.run),
        ]

    async def offsets_still_hold(self) -> bool:
        """Read the offsets again; return False if other offsets were possibly in use during the measurement."""
        held = True
        for imu in self._imus.values():
            held &= await imu.refresh()
        return held and not (self._core.wanted.push and await self._px4.apply_stored_offsets(list(self._imus.values())))

    # --- any write

    async def begin(self, job: Job, parameters: int) -> None:
        """Report the start of a write of `parameters` values; raise NotDisarmedError if armed or not connected."""
        job.check_cancelled()
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, message("write_in_progress", count=parameters, what="parameters"))
        await self._wait_disarmed()
        job.has_written = True

    async def commit(
        self,
        changes: Sequence[Change],
        origin: Origin,
        imus: Collection[AutopilotImu],
        apply: Callable[[], Awaitable[Sequence[Change]]],
        verify: Callable[[], Awaitable[None]],
        note: Note = lambda _written, _failed: None,
    ) -> None:
        """Write in a journal transaction; roll back unless `verify` passes and the undo step can be saved.

        The old values are on disk before `apply` starts. `apply` writes, and returns all changes in order, including
        the firmware's own. `verify` raises if the new values must not stay. `imus`: those whose output changes. `note`
        is called with the parameters that a roll-back restored. Raises CompanionError, or the JobCancelledError of
        `verify`; the text has the cause and the outcome of the roll-back.
        """
        system_id = self._vehicle.system_id
        async with self.journal.transaction(ChangeSet.of(system_id, changes, origin=origin)):
            with changing(imus):
                made = await apply()
            self._machine.on(Event.WRITTEN)
            try:
                await verify()
                await self.journal.done(ChangeSet.of(system_id, made, origin=origin))
            except JobCancelledError as cancelled:
                raise JobCancelledError(await self._roll_back(made, imus, str(cancelled), note)) from None
            except CompanionError as error:
                raise AutopilotError(await self._roll_back(made, imus, str(error), note)) from error

    async def _roll_back(self, made: Sequence[Change], imus: Collection[AutopilotImu], reason: str, note: Note) -> str:
        """Restore the old values of the changes `made`; return a text with the reason and the outcome."""
        left: Sequence[str] = ()
        outlook = "restored once disarmed"
        with contextlib.suppress(NotDisarmedError):
            await self._wait_disarmed()  # after a restart the first heartbeat may not have arrived yet
        with changing(imus):
            try:
                note(await self.writer.restore(made), ())
            except WriteFailedError as error:
                note(error.written, ())
                left = error.left_changed
                if error.kind == "changed by someone else":
                    outlook = "changed by another writer"
            except NothingWrittenError:
                left = [change.parameter for change in made]
                note({}, left)
        if left:
            return f"{message('old_values_not_back', reason=reason, parameters=', '.join(left))}: {outlook}"
        with contextlib.suppress(StorageError):
            await self.journal.undone()
        return message("old_values_back", reason=reason)

    async def _wait_disarmed(self) -> None:
        await self._heartbeat(DISARMED_WITHIN_S)
        if (state := self._vehicle.arm_state) is not ArmState.DISARMED:
            reason = "armed" if state is ArmState.ARMED else "no heartbeat"
            raise NotDisarmedError(message("nothing_written", reason=reason))

    async def _heartbeat(self, within_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self._vehicle.arm_state is ArmState.UNKNOWN:
                    await asyncio.sleep(POLL_S)

    # --- a write of offsets

    async def write(self, job: Job, plan: Plan, before: Window, log: WriteLog, go_on: GoOn | None = None) -> Plan:
        """Write offsets, read them back, and check that the IMU output makes the expected step.

        `before`: window measured under the old offsets. Outcomes are added to `log`. `go_on` replaces the job's own
        progress report. Returns the plan with the firmware's own changes; raises the errors of `commit`.
        """
        plan = await self._with_hover_biases(plan)
        await self.begin(job, len(plan.changes))
        gyros = await self._firmware.prepare(plan.gyros, log.warnings.append)
        ours = {target.name for target in plan.targets}
        imus = [imu for name, imu in self._imus.items() if gyros is not None or name in ours]

        def note(written: Mapping[str, WrittenParameter], failed: Collection[str]) -> None:
            plan.note(log, written)
            plan.mark(log, failed, "failed")

        async def apply() -> Sequence[Change]:
            nonlocal plan
            try:
                if gyros is not None:
                    plan = await self._firmware.write(
                        plan, gyros, log, lambda words: job.progress(MEASURED_PERCENT, words)
                    )
                else:
                    outputs = {imu.name: imu.accel_m_s2 for imu in before.imus}
                    async with self._px4.observing(plan.targets, outputs) as probe:
                        plan.note(log, await self.writer.apply(plan.changes, probe))
            except WriteFailedError as error:
                plan.note(log, error.written)
                raise
            return (*plan.collateral, *plan.changes)

        async def verify() -> None:
            job.progress(WRITTEN_PERCENT, WATCHING)
            problems = await self._problems(plan, before, log, go_on or job.going_on(WRITTEN_PERCENT, WATCHING))
            if problems:
                raise AutopilotError("; ".join(problems))
            await self.owed.after(plan.changes)

        await self.commit(plan.changes, Origin(job.short, log.started), imus, apply, verify, note)
        return plan

    async def _with_hover_biases(self, plan: Plan) -> Plan:
        if re.match(r"4\.[0-6]\.", self._vehicle.version or ""):
            return plan  # ArduPilot to 4.6 learns none, and would be asked for seconds: it is silent about absent names
        names = [target.calibration.parameters.hover_bias for target in plan.targets]
        learned = await self._core.parameters.read_many(filter(None, names), optional=True)
        targets = []
        for target in plan.targets:
            more = hover_bias_changes(target.calibration, target.changes, learned)
            targets.append(dataclasses.replace(target, changes=(*target.changes, *more)))
        return dataclasses.replace(plan, targets=tuple(targets))

    async def calibrate_by_firmware(self, job: Job) -> str:
        """Let ArduPilot calibrate its gyros itself, as a write that can be undone: it accepts a bias of any size."""
        parameters, origin, system_id = self._core.parameters, Origin(job.short, utc_now()), self._vehicle.system_id
        before = await gyro_calibration.read_overwritten(parameters)
        self._machine.on(Event.STILL)
        self._machine.on(Event.ENOUGH)
        await self.begin(job, len(before))
        async with self.journal.transaction(ChangeSet.of(system_id, (), before, origin)):
            with changing(self._imus.values()):
                go_on = job.going_on(MEASURED_PERCENT)
                outcome, words, after = await gyro_calibration.calibrate(parameters, before, go_on)
            self._machine.on(Event.WRITTEN)
            if outcome != "reset":
                raise AutopilotError(words)  # `Recovery` restores the old values
            made = [Change(name, *values) for name, values in gyro_calibration.changed(before, after).items()]
            await self.journal.done(ChangeSet.of(system_id, made, origin=origin))
        self._machine.on(Event.VERIFIED)
        self._machine.on(Event.CONCLUDED)
        return message("fix_done")

    async def _problems(self, plan: Plan, before: Window, log: WriteLog, go_on: GoOn) -> list[str]:
        verdicts, unseen = await verify_effect(self._core, self._px4, plan, before, go_on, plan.boots)
        # Check for another writer first: its changes would explain a wrong effect.
        problems: list[str] = []
        try:
            async for name, now in self._not_as_written(plan, attempts=1):
                problems.append(message("disturbed_after_write", event=f"another writer changed {name} to {now:.6g}"))
        except AutopilotError as error:
            problems.append(str(error))
        if verdicts is None and self._vehicle.boots != plan.boots:
            problems.append(unseen)
        explained = bool(problems)
        for target in plan.targets:
            if verdicts is None or not target.watched:
                reason = unseen if target.watched else UNWATCHED
                log.warn(target.name, message("effect_not_seen", when="", reason=reason))
            elif not explained:
                problems += _note_verdicts(plan, target, verdicts[target.name], log)
        return problems

    async def _not_as_written(self, plan: Plan, *, attempts: int) -> AsyncIterator[tuple[str, float]]:
        for change in plan.changes:
            for _ in range(attempts - 1):
                with contextlib.suppress(AutopilotRebootedError, ParameterTimeoutError):
                    now = await self._core.parameters.read(change.parameter)
                    break
            else:
                now = await self._core.parameters.read(change.parameter)
            if not same_float32(now, change.after):
                yield change.parameter, now

    # --- after a write that stays

    async def settle(self, job: Job, plan: Plan, before: Window, log: WriteLog) -> None:
        """Restart the autopilot if the job requests it; otherwise wait until its EKF agrees with the new offsets.

        Raises AutopilotError if the autopilot does not come back, or comes back with other values.
        """
        boots = self._vehicle.boots
        if not_rebooted := await self._restart(job, plan, before, log) if job.reboot else "":
            self._warn(log, not_rebooted)
        if (words := self.owed.words) is not None:
            log.warnings.append(words)
            self.owed.say()
        self._machine.on(Event.VERIFIED)
        if self._vehicle.boots == boots:  # after a restart the EKF has started afresh
            job.lasts(settles_within_s(plan.firmware))
            try:
                unsettled = await self._firmware.settle(plan, job.going_on(CONCLUDING_PERCENT))
            except JobCancelledError as cancelled:
                unsettled = message("settling_interrupted", reason=cancelled)
            if unsettled is not None:
                self._warn(log, unsettled)
            if self._vehicle.boots != boots:
                await self._survived(plan, log)
        self._machine.on(Event.CONCLUDED)

    def _warn(self, log: WriteLog, words: str) -> None:
        log.warnings.append(words)
        self._core.say(Severity.WARNING, words, Weight.NEWS)

    async def _survived(self, plan: Plan, log: WriteLog) -> None:
        await self._heartbeat(BACK_WITHIN_S)
        changed = [name async for name, _ in self._not_as_written(plan, attempts=READ_ATTEMPTS)]
        if changed:
            plan.mark(log, changed, "failed")
            raise AutopilotError(message("wrong_after_restart", problems=f"{', '.join(changed)} replaced"))

    async def _restart(self, job: Job, plan: Plan, before: Window, log: WriteLog) -> str:
        """Restart the autopilot and check the new offsets; return the reason if it was not restarted, otherwise ""."""
        go_on = job.going_on(CONCLUDING_PERCENT, "watching the telemetry after the reboot")
        self._machine.on(Event.REBOOT)
        try:
            if (harm := harm_of_reboot([target.calibration for target in plan.targets], plan.changes)) is not None:
                return harm
            await reboot(self._vehicle, go_on)
            stored = {change.parameter: change.after for change in plan.changes}
            changed = [
                f"{name} ({now:.6g}, stored: {stored[name]:.6g})"
                async for name, now in self._not_as_written(plan, attempts=READ_ATTEMPTS)
            ]
            if changed:
                raise AutopilotError(message("wrong_after_restart", problems=f"{', '.join(changed)} replaced"))
            verdicts, unseen = await verify_effect(self._core, self._px4, plan, before, go_on, self._vehicle.boots)
        except NotRebootedError as error:
            return str(error)
        except JobCancelledError as cancelled:
            return message("reboot_not_completed", reason=cancelled)
        found = (verdicts or {}).items()
        problems = [f"imu {name}: {in_short(verdict)}" for name, each in found for verdict in each if not verdict.ok]
        if problems:
            raise AutopilotError(message("wrong_after_restart", problems="; ".join(problems)))
        if unseen:
            log.warnings.append(message("effect_not_seen", when=" after the reboot", reason=unseen))
        log.notes.append("rebooted" if unseen else message("rebooted_and_active"))
        return ""


def _note_verdicts(plan: Plan, target: ImuPlan, verdicts: Sequence[EffectVerdict], log: WriteLog) -> list[str]:
    """Log the outcomes of one IMU's parameters by the verdicts of the check; return the faults as texts."""
    for verdict in verdicts:
        log.warn(target.name, *verdict.problems)
        # Three offsets are in use if their step as a whole was seen: an axis that hardly changed shows no step.
        seen = verdict.ok and not verdict.hidden
        for name in verdict.axes:
            plan.mark(log, [name], "verified" if seen else verdict.outcome(name))
    return [f"imu {target.name}: {in_short(verdict)}" for verdict in verdicts if not verdict.ok]
