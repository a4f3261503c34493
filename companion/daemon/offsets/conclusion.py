"""After a write that stays: a restart where one was asked for, or the settling of the EKF."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.commands import result_name
from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.daemon.job import GoOn, Job, JobCancelledError
from companion.daemon.offsets.effect import EffectWatch, in_short
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration, settles_within_s
from companion.daemon.offsets.plan import Plan
from companion.daemon.offsets.push import POLL_S, heartbeat, not_as_written
from companion.daemon.offsets.reboot_owed import RebootOwed
from companion.errors import AutopilotError, AutopilotRebootedError, NotDisarmedError, ParameterTimeoutError
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.solution.draft import Draft

logger = logging.getLogger(__name__)

STORED_AFTER_S: Final = 3.0
"""PX4 saves its parameters up to 2 s after a change, ArduPilot from a queue (autopilots 8)."""
ANSWER_S: Final = 3.0
BACK_WITHIN_S: Final = 60.0
CONCLUDING_PERCENT: Final = 95.0
READ_ATTEMPTS: Final = 3


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

    def __init__(self, core: Core, effect: EffectWatch, firmware: FirmwareCalibration, owed: RebootOwed) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._machine, self._effect, self._firmware, self._owed = core.machine, effect, firmware, owed

    async def conclude(self, job: Job, plan: Plan, before: Window, draft: Draft) -> None:
        """See to it that what was written is used, and say what the pilot still has to do.

        Raises:
            AutopilotError: the autopilot has not come back, or not with what was written.
        """
        boots = self._vehicle.boots
        if not_rebooted := await self._restart(job, plan, before, draft) if job.reboot else "":
            draft.warnings.append(not_rebooted)
            self._say(Severity.WARNING, not_rebooted, Weight.NEWS)
        if (words := self._owed.words) is not None:
            draft.warnings.append(f"{words} for minutes after such a step (companion calibrate --reboot does it)")
            self._owed.say()
        self._machine.on(Event.VERIFIED)
        if self._vehicle.boots == boots:  # after a restart the EKF has started afresh
            await self._settle(job, plan, draft)
            if self._vehicle.boots != boots:
                await self._survived(plan, draft)
        self._machine.on(Event.CONCLUDED)

    async def _restart(self, job: Job, plan: Plan, before: Window, draft: Draft) -> str:
        """Restart it; why that was not done or not seen to its end, or empty."""
        go_on = job.going_on(CONCLUDING_PERCENT, "watching the telemetry after the reboot")
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
        job.lasts(settles_within_s(plan.firmware))
        try:
            words = await self._firmware.settle(plan, job.going_on(CONCLUDING_PERCENT))
        except JobCancelledError as cancelled:
            words = f"wait 2 min before take-off: {cancelled} while the EKF took in the new offsets, which stay"
        if words is not None:
            draft.warnings.append(words)
            self._say(Severity.WARNING, words, Weight.NEWS)

    async def _survived(self, plan: Plan, draft: Draft) -> None:
        """After a restart that nobody here asked for: see that what was written is still there."""
        await heartbeat(self._vehicle, BACK_WITHIN_S)
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
        try:
            await self._vehicle.disarmed.ensure()
        except NotDisarmedError as error:
            raise NotRebootedError(f"not rebooted: {error}") from error
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
