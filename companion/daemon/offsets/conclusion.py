"""After the write: restarting the autopilot when asked to, and seeing that it came back with what was written."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.px4 import needs_reboot, stale_tilt_deg
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.vehicle.commands import result_name
from companion.autopilot.vehicle.vehicle import ArmState
from companion.calibration.collector.rolling import Window
from companion.calibration.machine import Event, Machine
from companion.calibration.solution.draft import Draft
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.offsets.effect import EffectWatch, in_short
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration, settles_within_s
from companion.daemon.offsets.plan import Plan
from companion.errors import AutopilotError, AutopilotRebootedError, ParameterTimeoutError

logger = logging.getLogger(__name__)

GoOn = Callable[[str], None]

STORED_AFTER_S: Final = 3.0
"""PX4 saves its parameters up to 2 s after a change, ArduPilot from a queue (autopilots section 8)."""
ANSWER_S: Final = 3.0
BACK_WITHIN_S: Final = 60.0
CONCLUDING_PERCENT: Final = 95.0
POLL_S: Final = 0.2
GATED_TILT_DEG: Final = 0.3
"""Tilt that an autopilot may have kept from before a write, above which the arm gate waits for its restart. A smaller
one is within what an EKF shows after any start."""
READ_ATTEMPTS: Final = 3


class NotRebootedError(AutopilotError):
    """The autopilot was not restarted; what was written is in force all the same."""


def why_not(calibrations: Sequence[ImuCalibration], changes: Sequence[Change]) -> str | None:
    """Why a restart would do harm, or None."""
    after = {change.parameter: change.after for change in changes}
    gyros = {name for calibration in calibrations for name in calibration.parameters.gyro_offset}
    for calibration in calibrations:
        for rival in calibration.rivals:
            if rival.acts == "at a start" and after.get(rival.parameter) != 0.0 and gyros & set(after):
                return (
                    f"not rebooted: {rival.parameter} = {rival.value} would measure the gyros anew at the start and"
                    f" throw these gyro offsets away; set {rival.parameter} to 0 first (push.stop_rivals = true does)"
                )
    return None


class Conclusion:
    """What follows a write that is done and stays: a restart where one was asked for, or the settling of the EKF."""

    def __init__(self, core: Core, machine: Machine, effect: EffectWatch, firmware: FirmwareCalibration) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._machine, self._effect, self._firmware = machine, effect, firmware
        self._stale: tuple[int, float] | None = None
        """Boots seen when a write left a stale tilt behind, and its size in degrees."""

    @property
    def owed(self) -> str | None:
        """Why it must be restarted before it may arm, in few words; None when it need not."""
        if self._stale is None or self._stale[0] != self._vehicle.boots or self._stale[1] < GATED_TILT_DEG:
            return None
        return f"reboot first: tilt up to {self._stale[1]:.1f} deg off"

    async def conclude(self, job: Job, plan: Plan, before: Window, draft: Draft) -> None:
        """See to it that what was written is used, and say what the pilot still has to do.

        Raises:
            AutopilotError: the autopilot has not come back, or not with what was written.
        """
        boots = self._vehicle.boots
        not_rebooted = await self._restart(job, plan, before, draft) if job.reboot else ""
        if not_rebooted:
            draft.warnings.append(not_rebooted)
            self._say(Severity.WARNING, not_rebooted, Weight.NEWS)
        if needs_reboot(plan.changes) and not (job.reboot and not not_rebooted):
            self._stale = (self._vehicle.boots, stale_tilt_deg(plan.changes))
            draft.warnings.append(
                "PX4's attitude stays wrong for minutes after new accelerometer offsets: reboot the autopilot before"
                " flight (companion calibrate --reboot does)"
            )
            self._say(Severity.WARNING, "Reboot the autopilot before flight", Weight.RESULT)
        self._machine.on(Event.VERIFIED)
        if self._vehicle.boots == boots:  # after a restart the EKF has started afresh
            await self._settle(job, plan, draft)
            if self._vehicle.boots != boots:
                await self._survived(plan, draft)

    async def _restart(self, job: Job, plan: Plan, before: Window, draft: Draft) -> str:
        """Restart it; why that was not done or not seen to its end, or empty."""

        def go_on(words: str) -> None:
            job.check_cancelled()
            job.progress(CONCLUDING_PERCENT, words or "watching the telemetry after the reboot")

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

        def go_on(words: str) -> None:
            job.check_cancelled()
            job.progress(CONCLUDING_PERCENT, words)

        job.lasts(settles_within_s(plan.firmware))
        try:
            words = await self._firmware.settle(plan.gyros, plan.firmware, go_on)
        except JobCancelledError as cancelled:
            words = f"{cancelled} while the EKF was settling: the new offsets stay, wait 2 min before take-off"
        if words is not None:
            draft.warnings.append(words)
            self._say(Severity.WARNING, words, Weight.NEWS)

    async def _survived(self, plan: Plan, draft: Draft) -> None:
        """After a restart that nobody here asked for: see that what was written is still there.

        Raises:
            AutopilotError: it is not, or the autopilot does not come back.
        """
        back_s = asyncio.get_running_loop().time() + BACK_WITHIN_S
        while self._vehicle.arm_state is ArmState.UNKNOWN and asyncio.get_running_loop().time() < back_s:
            await asyncio.sleep(POLL_S)
        changed = await self._changed(plan.changes)
        if changed:
            plan.mark(draft, changed, "failed")
            raise AutopilotError(f"the autopilot restarted and replaced {', '.join(changed)}: calibrate again")

    async def _after(self, plan: Plan, before: Window, warn: Callable[[str], None], go_on: GoOn) -> str:
        """Restart the autopilot and see that the new offsets are in force; in words."""
        harm = why_not([target.calibration for target in plan.targets], plan.changes)
        if harm is not None:
            raise NotRebootedError(harm)
        await self._reboot(go_on)
        changed = await self._changed(plan.changes)
        if changed:
            raise AutopilotError("; ".join(changed.values()))
        verdicts, unseen = await self._effect.look(plan, before, go_on, self._vehicle.boots)
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

    async def _changed(self, changes: Sequence[Change]) -> dict[str, str]:
        """What is no longer as it was written, by name, in words."""
        found: dict[str, str] = {}
        for change in changes:
            now = await self._read(change.parameter)
            if not same_float32(now, change.after):
                name = change.parameter
                found[name] = f"{name} is {now:.6g} after the reboot, {change.after:.6g} had been stored"
        return found

    async def _read(self, name: str) -> float:
        for _ in range(READ_ATTEMPTS - 1):
            try:
                return await self._parameters.read(name)
            except (AutopilotRebootedError, ParameterTimeoutError):
                continue
        return await self._parameters.read(name)
