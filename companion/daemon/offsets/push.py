"""Biases into the autopilot: write, look in the telemetry, put back what did not work."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Final

from companion.autopilot.firmware.gyro_calibration import GyroParameters
from companion.autopilot.parameters.change import Change, NothingWrittenError, WriteFailedError
from companion.autopilot.parameters.verify import Verdict
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.job import GoOn, Job, JobCancelledError
from companion.daemon.offsets.effect import EffectWatch, in_short
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Plan, Target
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.daemon.offsets.reboot_owed import RebootOwed
from companion.errors import AutopilotError, NotDisarmedError, StorageError
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.solution.draft import Draft
from companion.storage.changes import ChangeSet, Origin

DISARMED_WITHIN_S: Final = 10.0
"""How long a heartbeat lost just before the write is waited for."""
WATCHING: Final = "watching the telemetry take the new offsets"
POLL_S: Final = 0.2


class Pusher:
    """Writes the result of a calibration, all or nothing."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        writer: ParameterWriter,
        ledger: Ledger,
        px4: Px4Writes,
        firmware: FirmwareCalibration,
        effect: EffectWatch,
        owed: RebootOwed,
    ) -> None:
        self._vehicle, self._parameters, self._imus, self._machine = core.vehicle, core.parameters, imus, core.machine
        self._writer, self._ledger, self._wanted, self._owed = writer, ledger, core.wanted, owed
        self._px4, self._firmware, self._effect = px4, firmware, effect

    async def offsets_still_hold(self) -> bool:
        """Read the offsets afresh; False when they were not, or not surely, those under which was measured.

        Raises:
            AutopilotError: they cannot be read; or what was unsure could not be made sure.
            StorageError: the old values could not be kept.
        """
        held = True
        for imu in self._imus.values():
            held &= await imu.refresh()
        return held and not (self._wanted.push and await self._px4.make_sure(list(self._imus.values())))

    async def push(self, job: Job, plan: Plan, before: Window, draft: Draft, go_on: GoOn | None = None) -> Plan:
        """Write, read back, and watch the telemetry take the step that it must; on failure put the old values back.

        `go_on(words)` is called now and then while it watches; else the job tells of it. The plan, and what the
        firmware has changed besides.

        Raises:
            AutopilotError: what went wrong, and which parameters could not be put back, if any.
            StorageError: the old values could not be kept, so nothing was written.
            JobCancelledError: raised by `go_on`; the old values are back, or it is said which are not.
        """
        await self._begin(job, plan.changes)
        firmware = await self._firmware.prepare(plan.gyros, draft.warnings.append)
        async with self._ledger.transaction(self._kept(job, plan, draft)):
            with self._changing(plan, everything=firmware is not None):
                try:
                    plan = await self._write(job, plan, firmware, draft)
                except WriteFailedError as error:
                    plan.note(draft, error.written)
                    raise
            self._machine.on(Event.WRITTEN)
            job.progress(WRITTEN_PERCENT, WATCHING)
            await self._verify(job, plan, before, draft, go_on or job.going_on(WRITTEN_PERCENT, WATCHING))
        return plan

    async def _begin(self, job: Job, changes: Sequence[Change]) -> None:
        job.check_cancelled()
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(changes)} parameters")
        await self._wait_disarmed()

    async def _write(self, job: Job, plan: Plan, firmware: GyroParameters | None, draft: Draft) -> Plan:
        if firmware is None:
            async with self._px4.standing_by([(t.calibration, t.all, t.read_m_s2) for t in plan.targets]) as probe:
                plan.note(draft, await self._writer.apply(plan.changes, probe))
            return plan

        def go_on(words: str) -> None:
            job.progress(MEASURED_PERCENT, words)

        return await self._firmware.write(plan, firmware, draft, go_on)

    def _kept(self, job: Job, plan: Plan, draft: Draft) -> ChangeSet:
        return ChangeSet.of(self._vehicle.system_id, plan.everything, origin=Origin(job.short, draft.started))

    async def _verify(self, job: Job, plan: Plan, before: Window, draft: Draft, go_on: GoOn) -> None:
        """This alone lets it stay."""
        try:
            problems = await self._problems(plan, before, draft, go_on)
        except JobCancelledError as cancelled:
            raise JobCancelledError(await self._roll_back(plan, draft, str(cancelled))) from None
        if problems:
            raise AutopilotError(await self._roll_back(plan, draft, "; ".join(problems)))
        try:
            await self._owed.after(plan.changes)
            await self._ledger.done(self._kept(job, plan, draft))
        except StorageError as error:  # what cannot be undone later must not stay
            raise AutopilotError(await self._roll_back(plan, draft, str(error))) from error

    async def _problems(self, plan: Plan, before: Window, draft: Draft, go_on: GoOn) -> list[str]:
        """Why what was written must not stay."""
        verdicts, why_not = await self._effect.judge(plan, before, go_on, plan.boots)
        # What somebody has changed meanwhile explains what the telemetry shows, so it comes first.
        problems = await self._no_longer_in_force(plan)
        if verdicts is None and self._vehicle.boots != plan.boots:
            problems.append(why_not)
        explained = bool(problems)
        for target in plan.targets:
            if not target.watched:
                draft.warn(target.name, "effect of the written offsets not seen: this IMU is not in the telemetry")
            elif verdicts is None:
                draft.warn(target.name, f"effect of the written offsets not seen: {why_not}")
            elif not explained:
                problems += _note_verdicts(plan, target, verdicts[target.name], draft)
        return problems

    async def _roll_back(self, plan: Plan, draft: Draft, reason: str) -> str:
        """Put the old values back; `reason`, and what became of them."""
        left: Sequence[str] = ()
        end = "will be once disarmed"
        with contextlib.suppress(NotDisarmedError):
            await self._wait_disarmed()  # after a restart the first heartbeat is still to come
        with self._changing(plan, everything=bool(plan.collateral)):
            try:
                plan.note(draft, await self._writer.restore(plan.everything))
            except WriteFailedError as error:
                plan.note(draft, error.written)
                left = error.left_changed
                if error.kind == "changed by someone else":
                    end = "somebody else changed them"
            except NothingWrittenError:
                left = [change.parameter for change in plan.everything]
                plan.mark(draft, left, "failed")
        if left:
            return f"{reason}; old values NOT back in {', '.join(left)}: {end}"
        with contextlib.suppress(StorageError):
            await self._ledger.undone()
        return f"{reason}; old values back"

    async def _no_longer_in_force(self, plan: Plan) -> list[str]:
        """What somebody has changed while we looked at the telemetry."""
        changed: list[str] = []
        try:
            async for name, now in not_as_written(self._parameters.read, plan.changes):
                changed.append(f"{name} is {now:.6g}, somebody changed it right after the write")
        except AutopilotError as error:
            changed.append(str(error))
        return changed

    def _changing(self, plan: Plan, *, everything: bool) -> contextlib.AbstractContextManager[None]:
        """While offsets change: those of the plan's IMUs, or of all."""
        ours = {target.name for target in plan.targets}
        return changing(imu for name, imu in self._imus.items() if everything or name in ours)

    async def _wait_disarmed(self) -> None:
        await heartbeat(self._vehicle, DISARMED_WITHIN_S)
        if self._vehicle.arm_state is ArmState.ARMED:
            raise NotDisarmedError("armed; nothing written")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            raise NotDisarmedError("no heartbeat; nothing written")


async def heartbeat(vehicle: Vehicle, within_s: float) -> None:
    """Wait for so long at most until it is known whether it is armed."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(within_s):
            while vehicle.arm_state is ArmState.UNKNOWN:
                await asyncio.sleep(POLL_S)


async def not_as_written(
    read: Callable[[str], Awaitable[float]], changes: Sequence[Change]
) -> AsyncIterator[tuple[str, float]]:
    """Name and present value of what is no longer as it was written, each as soon as it is read."""
    for change in changes:
        now = await read(change.parameter)
        if not same_float32(now, change.after):
            yield change.parameter, now


def _note_verdicts(plan: Plan, target: Target, verdicts: list[Verdict], draft: Draft) -> list[str]:
    """Set the outcomes of one IMU's parameters; returns what is wrong, in words."""
    problems = [f"imu {target.name}: {in_short(verdict)}" for verdict in verdicts if not verdict.ok]
    hidden = () if target.solution.dithered else tuple(name for verdict in verdicts for name in verdict.hidden)
    if hidden:
        draft.warn(target.name, f"so small a change does not show in the telemetry: {', '.join(hidden)}")
    for verdict in verdicts:
        draft.warn(target.name, *verdict.problems)
        for axis in verdict.axes:
            # A vector whose step as a whole was seen is in use; an axis that hardly changed cannot show more.
            # Where the integers show no step at all, the dither has shown that they follow these parameters.
            seen = verdict.ok and (not verdict.hidden or target.solution.dithered)
            plan.mark(draft, [axis.parameter], "verified" if seen else verdict.outcome(axis.parameter))
    return problems
