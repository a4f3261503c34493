"""Biases into the autopilot: write, look in the telemetry, and put back what did not work."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Final

from companion.autopilot.firmware.gyro_calibration import GyroParameters
from companion.autopilot.parameters.change import NothingWrittenError, WriteFailedError
from companion.autopilot.parameters.verify import Verdict
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState
from companion.calibration.collector.rolling import Window
from companion.calibration.solution.draft import Draft
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.job import JobCancelledError
from companion.daemon.offsets.effect import EffectWatch, in_short
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Plan, Target
from companion.daemon.offsets.px4_writes import Px4Writes
from companion.errors import AutopilotError, NotDisarmedError, StorageError
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

DISARMED_WITHIN_S: Final = 10.0
"""How long a heartbeat lost just before the write is waited for."""
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
    ) -> None:
        self._vehicle, self._parameters, self._imus = core.vehicle, core.parameters, imus
        self._writer, self._ledger = writer, ledger
        self._px4, self._firmware, self._effect = px4, firmware, effect

    async def offsets_still_hold(self, *, push: bool) -> bool:
        """Read the offsets afresh; False when they were not, or not surely, those under which was measured.

        Raises:
            AutopilotError: they cannot be read; or what was unsure could not be made sure.
            StorageError: the old values could not be kept.
        """
        held = True
        for imu in self._imus.values():
            held &= await imu.refresh()
        return held and not (push and await self._px4.make_sure(list(self._imus.values())))

    @contextlib.asynccontextmanager
    async def written(self, plan: Plan, draft: Draft, go_on: Callable[[str], None]) -> AsyncIterator[Plan]:
        """Write and read back; on failure, also of the block, the old values are put back.

        The block verifies what was written: `verify` alone lets it stay.

        Yields:
            The plan, and what the firmware has changed besides.

        Raises:
            AutopilotError: what went wrong, and which parameters could not be put back, if any.
            StorageError: the old values could not be kept, so nothing was written.
        """
        await self._wait_disarmed()
        firmware = await self._firmware.prepare(plan.gyros, draft.warnings.append)
        async with self._ledger.transaction(ChangeSet.of(self._vehicle.system_id, plan.everything)):
            with self._changing(plan, everything=firmware is not None):
                try:
                    plan = await self._write(plan, firmware, draft, go_on)
                except WriteFailedError as error:
                    plan.note(draft, error.written)
                    raise
            yield plan

    async def _write(
        self, plan: Plan, firmware: GyroParameters | None, draft: Draft, go_on: Callable[[str], None]
    ) -> Plan:
        if firmware is None:
            async with self._px4.standing_by([(t.calibration, t.changes) for t in plan.targets]) as look:
                plan.note(draft, await self._writer.apply(plan.changes, look))
            return plan
        done = await self._firmware.write(plan.changes, plan.gyros, firmware, go_on)
        plan.note(draft, done.written)
        draft.warnings += done.warnings
        return dataclasses.replace(plan, collateral=done.collateral, firmware=done.outcome)

    async def verify(self, plan: Plan, before: Window, draft: Draft, go_on: Callable[[str], None]) -> None:
        """Watch the telemetry take the step that it must; `go_on(words)` is called now and then meanwhile.

        Raises:
            AutopilotError: the autopilot does not use what it stored; the old values are back, or it is said which
                are not.
            JobCancelledError: raised by `go_on`; likewise.
        """
        try:
            problems = await self._problems(plan, before, draft, go_on)
        except JobCancelledError as cancelled:
            raise JobCancelledError(await self._roll_back(plan, draft, str(cancelled))) from None
        if problems:
            raise AutopilotError(await self._roll_back(plan, draft, "; ".join(problems)))
        try:
            await self._ledger.done(ChangeSet.of(self._vehicle.system_id, plan.everything))
        except StorageError as error:
            # What cannot be undone later must not stay.
            raise AutopilotError(await self._roll_back(plan, draft, str(error))) from error

    async def _problems(self, plan: Plan, before: Window, draft: Draft, go_on: Callable[[str], None]) -> list[str]:
        """Why what was written must not stay."""
        verdicts, why_not = await self._effect.look(plan, before, go_on, plan.boots)
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
        return f"{reason}; old values put back"

    async def _no_longer_in_force(self, plan: Plan) -> list[str]:
        """What somebody has changed while we looked at the telemetry."""
        changed: list[str] = []
        try:
            for change in plan.changes:
                now = await self._parameters.read(change.parameter)
                if not same_float32(now, change.after):
                    changed.append(f"{change.parameter} is {now:.6g}, somebody changed it right after the write")
        except AutopilotError as error:
            changed.append(str(error))
        return changed

    def _changing(self, plan: Plan, *, everything: bool) -> contextlib.AbstractContextManager[None]:
        """While offsets change: those of the plan's IMUs, or of all."""
        ours = {target.name for target in plan.targets}
        return changing(imu for name, imu in self._imus.items() if everything or name in ours)

    async def _wait_disarmed(self) -> None:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + DISARMED_WITHIN_S
        while self._vehicle.arm_state is ArmState.UNKNOWN and loop.time() < deadline_s:
            await asyncio.sleep(POLL_S)
        if self._vehicle.arm_state is ArmState.ARMED:
            raise NotDisarmedError("armed before the biases could be written; nothing was written")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            raise NotDisarmedError("no heartbeat, so nobody knows whether the aircraft is armed; nothing was written")


def _note_verdicts(plan: Plan, target: Target, verdicts: list[Verdict], draft: Draft) -> list[str]:
    """Set the outcomes of one IMU's parameters; returns what is wrong, in words."""
    problems = [f"imu {target.name}: {in_short(verdict)}" for verdict in verdicts if not verdict.ok]
    for verdict in verdicts:
        for words in (*verdict.problems, *verdict.warnings):
            draft.warn(target.name, words)
        for axis in verdict.axes:
            # A vector whose step as a whole was seen is in use; an axis that hardly changed cannot show more.
            # Where the integers show no step at all, the dither has shown that they follow these parameters.
            seen = verdict.ok and (not verdict.warnings or target.solution.dithered)
            plan.mark(draft, [axis.parameter], "verified" if seen else verdict.outcome(axis.parameter))
    return problems
