"""Biases into the autopilot: write, look in the telemetry, put back what did not work, see that the rest is used."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.gyro_calibration import GyroParameters
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.px4 import stale_tilt_deg
from companion.autopilot.parameters.change import Change, NothingWrittenError, WriteFailedError
from companion.autopilot.parameters.verify import Verdict
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.commands import result_name
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.calibration.machine import Event
from companion.calibration.means.windows import Window
from companion.calibration.solution.draft import Draft
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.offsets.effect import EffectWatch, in_short
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration, settles_within_s
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Plan, Target
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.errors import (
    AutopilotError,
    AutopilotRebootedError,
    NotDisarmedError,
    ParameterTimeoutError,
    StorageError,
)
from companion.storage.changes import ChangeSet, Origin

logger = logging.getLogger(__name__)

DISARMED_WITHIN_S: Final = 10.0
"""How long a heartbeat lost just before the write is waited for."""
GoOn = Callable[[str], None]
STORED_AFTER_S: Final = 3.0
"""PX4 saves its parameters up to 2 s after a change, ArduPilot from a queue (autopilots section 8)."""
ANSWER_S: Final = 3.0
BACK_WITHIN_S: Final = 60.0
CONCLUDING_PERCENT: Final = 95.0
WATCHING: Final = "watching the telemetry take the new offsets"
POLL_S: Final = 0.2
GATED_TILT_DEG: Final = 0.3
"""Tilt that PX4 may have kept from before a write, above which it has to be restarted before it flies. A smaller one is
what its EKF2 shows of the biases of an uncalibrated sensor (autopilots 9.3)."""
READ_ATTEMPTS: Final = 3


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
    ) -> None:
        self._vehicle, self._parameters, self._imus, self._machine = core.vehicle, core.parameters, imus, core.machine
        self._writer, self._ledger, self._wanted = writer, ledger, core.wanted
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

    async def push(self, job: Job, plan: Plan, before: Window, draft: Draft, go_on: GoOn) -> Plan:
        """Write, read back, and watch the telemetry take the step that it must; on failure put the old values back.

        `go_on(words)` is called now and then while it watches. The plan, and what the firmware has changed besides.

        Raises:
            AutopilotError: what went wrong, and which parameters could not be put back, if any.
            StorageError: the old values could not be kept, so nothing was written.
            JobCancelledError: raised by `go_on`; the old values are back, or it is said which are not.
        """
        job.check_cancelled()
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(plan.changes)} parameters")
        await self._wait_disarmed()
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
            await self._verify(job, plan, before, draft, go_on)
        return plan

    async def _write(self, job: Job, plan: Plan, firmware: GyroParameters | None, draft: Draft) -> Plan:
        if firmware is None:
            async with self._px4.standing_by([(t.calibration, t.changes, t.read_m_s2) for t in plan.targets]) as look:
                plan.note(draft, await self._writer.apply(plan.changes, look))
            return plan

        def go_on(words: str) -> None:
            job.progress(MEASURED_PERCENT, words)

        done = await self._firmware.write(plan.changes, plan.gyros, firmware, go_on)
        plan.note(draft, done.written)
        draft.warnings += done.warnings
        return dataclasses.replace(plan, collateral=done.collateral, firmware=done.outcome)

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
        await _heartbeat(self._vehicle, DISARMED_WITHIN_S)
        if self._vehicle.arm_state is ArmState.ARMED:
            raise NotDisarmedError("armed; nothing written")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            raise NotDisarmedError("no heartbeat; nothing written")


async def _heartbeat(vehicle: Vehicle, within_s: float) -> None:
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


def _going_on(job: Job, otherwise: str = "") -> GoOn:
    def go_on(words: str) -> None:
        job.check_cancelled()
        job.progress(CONCLUDING_PERCENT, words or otherwise)

    return go_on


class NotRebootedError(AutopilotError):
    """The autopilot was not restarted; what was written is in force all the same."""


def why_not(calibrations: Sequence[ImuCalibration], changes: Sequence[Change]) -> str | None:
    """Why a restart would do harm, or None."""
    after = {change.parameter: change.after for change in changes}
    gyros = {name for calibration in calibrations for name in calibration.parameters.gyro_offset}
    for rival in (rival for calibration in calibrations for rival in calibration.rivals):
        if rival.acts == "at a start" and after.get(rival.parameter) != 0.0 and gyros & set(after):
            return (
                f"not rebooted: {rival.parameter} = {rival.value} would measure the gyros anew at the start and"
                f" throw these gyro offsets away; set {rival.parameter} to 0 first (push.stop_rivals = true does)"
            )
    return None


class Conclusion:
    """What follows a write that is done and stays: a restart where one was asked for, or the settling of the EKF."""

    def __init__(self, core: Core, effect: EffectWatch, firmware: FirmwareCalibration) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._machine, self._effect, self._firmware = core.machine, effect, firmware
        self._stale: tuple[int, float] | None = None
        """Boots seen when a write left a stale tilt behind, and its size in degrees."""

    @property
    def owed(self) -> str | None:
        """Why it must be restarted before it may arm, in few words; None when it need not."""
        if self._stale is None or self._stale[0] != self._vehicle.boots or self._stale[1] < GATED_TILT_DEG:
            return None
        return f"reboot PX4: tilt {self._stale[1]:.1f} deg off"

    async def conclude(self, job: Job, plan: Plan, before: Window, draft: Draft) -> None:
        """See to it that what was written is used, and say what the pilot still has to do.

        Raises:
            AutopilotError: the autopilot has not come back, or not with what was written.
        """
        boots = self._vehicle.boots
        if not_rebooted := await self._restart(job, plan, before, draft) if job.reboot else "":
            draft.warnings.append(not_rebooted)
            self._say(Severity.WARNING, not_rebooted, Weight.NEWS)
        if not job.reboot or not_rebooted:
            # A small step after a large one leaves what the large one has left.
            left_deg = self._stale[1] if self._stale is not None and self._stale[0] == boots else 0.0
            self._stale = (boots, max(left_deg, stale_tilt_deg(plan.changes)))
        if (owed := self.owed) is not None:
            draft.warnings.append(f"{owed} for minutes after such a step (companion calibrate --reboot does it)")
            self._say(Severity.WARNING, f"Before flight: {owed}", Weight.RESULT)
        self._machine.on(Event.VERIFIED)
        if self._vehicle.boots == boots:  # after a restart the EKF has started afresh
            await self._settle(job, plan, draft)
            if self._vehicle.boots != boots:
                await self._survived(plan, draft)
        self._machine.on(Event.CONCLUDED)

    async def _restart(self, job: Job, plan: Plan, before: Window, draft: Draft) -> str:
        """Restart it; why that was not done or not seen to its end, or empty."""
        go_on = _going_on(job, "watching the telemetry after the reboot")
        self._machine.on(Event.REBOOT)
        try:
            draft.notes.append(await self._after(plan, before, draft.warnings.append, go_on))
        except NotRebootedError as error:
            return str(error)
        except JobCancelledError as cancelled:
            return f"{cancelled} before the reboot was confirmed; the new offsets stay"
        return ""

    async def _settle(self, job: Job, plan: Plan, draft: Draft) -> None:
        """The write is done and stays; a cancel ends only the waiting for the autopilot's EKF."""
        go_on = _going_on(job)
        job.lasts(settles_within_s(plan.firmware))
        try:
            words = await self._firmware.settle(plan.gyros, plan.firmware, go_on)
        except JobCancelledError as cancelled:
            words = f"wait 2 min before take-off: {cancelled} while the EKF took in the new offsets, which stay"
        if words is not None:
            draft.warnings.append(words)
            self._say(Severity.WARNING, words, Weight.NEWS)

    async def _survived(self, plan: Plan, draft: Draft) -> None:
        """After a restart that nobody here asked for: see that what was written is still there."""
        await _heartbeat(self._vehicle, BACK_WITHIN_S)
        changed = {name: now async for name, now in not_as_written(self._read, plan.changes)}
        if changed:
            plan.mark(draft, changed, "failed")
            raise AutopilotError(f"the autopilot restarted and replaced {', '.join(changed)}: calibrate again")

    async def _after(self, plan: Plan, before: Window, warn: Callable[[str], None], go_on: GoOn) -> str:
        """Restart the autopilot and see that the new offsets are in force; in words."""
        harm = why_not([target.calibration for target in plan.targets], plan.changes)
        if harm is not None:
            raise NotRebootedError(harm)
        await self._reboot(go_on)
        changed = {name: now async for name, now in not_as_written(self._read, plan.changes)}
        if changed:
            stored = {change.parameter: change.after for change in plan.changes}
            after = (
                f"{name} is {now:.6g} after the reboot, {stored[name]:.6g} had been stored"
                for name, now in changed.items()
            )
            raise AutopilotError("; ".join(after))
        verdicts, unseen = await self._effect.judge(plan, before, go_on, self._vehicle.boots)
        found = (verdicts or {}).items()
        problems = [f"imu {name}: {in_short(verdict)}" for name, each in found for verdict in each if not verdict.ok]
        if problems:
            raise AutopilotError(f"after the reboot: {'; '.join(problems)}")
        if unseen:
            warn(f"rebooted, and the parameters are as written; their effect was not seen: {unseen}")
            return "rebooted"
        return "rebooted, offsets in force"

    async def _reboot(self, go_on: GoOn) -> None:
        """Restart it, disarmed, once all is stored, and wait until it is back."""
        loop = asyncio.get_running_loop()
        stored_s = loop.time() + STORED_AFTER_S
        while loop.time() < stored_s:
            go_on("waiting until the autopilot has stored the new offsets")
            await asyncio.sleep(POLL_S)
        boots = self._vehicle.boots
        await self._vehicle.fresh_heartbeat()
        if self._vehicle.arm_state is not ArmState.DISARMED:
            raise NotRebootedError("not rebooted: the aircraft is not surely disarmed")
        logger.info("rebooting %s", self._vehicle.name)
        reboot = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
        result = await self._vehicle.commands.send(reboot, 1.0, timeout_s=ANSWER_S)
        if result not in (mavlink.MAV_RESULT_ACCEPTED, None):
            raise NotRebootedError(f"not rebooted: {self._vehicle.name} refused ({result_name(result or 0)})")
        # No answer proves nothing: it may have gone down with it.
        back_s = loop.time() + BACK_WITHIN_S
        while self._vehicle.boots == boots or self._vehicle.arm_state is not ArmState.DISARMED:
            if loop.time() > back_s:
                if self._vehicle.boots == boots and self._vehicle.alive:
                    raise NotRebootedError(f"not rebooted: {self._vehicle.name} did not answer and has not restarted")
                raise AutopilotError(
                    f"{self._vehicle.name} was rebooted and is not back, disarmed, within {BACK_WITHIN_S:.0f} s"
                )
            await asyncio.sleep(POLL_S)

    async def _read(self, name: str) -> float:
        for _ in range(READ_ATTEMPTS - 1):
            with contextlib.suppress(AutopilotRebootedError, ParameterTimeoutError):
                return await self._parameters.read(name)
        return await self._parameters.read(name)
