"""Biases into the autopilot: write, look in the telemetry, and put back what did not work."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from companion.autopilot.firmware.firmwares import settle_s
from companion.autopilot.firmware.gyro_calibration import GyroParameters
from companion.autopilot.parameters.change import NothingWrittenError, WriteFailedError
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.float32 import same_float32
from companion.autopilot.parameters.pace import has_passed, moment
from companion.autopilot.parameters.verify import Verdict
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.calibration.collector.rolling import RollingCollector, Window
from companion.calibration.solution.draft import Draft
from companion.calibration.solution.record import Outcome, WrittenParameter
from companion.calibration.solution.solve import Solution
from companion.config import Config
from companion.daemon import offload as estimating
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import JobCancelledError
from companion.daemon.offload import Offload
from companion.daemon.offsets.effect import OnTheWay, Sides, in_short, judge_vectors, nearly_visible
from companion.daemon.offsets.firmware_calibration import FirmwareCalibration, settles_within_s
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import Plan, Planner, Target
from companion.daemon.offsets.px4_writes import Px4Writes, step_from_far
from companion.errors import AutopilotError, CalibrationRefusedError, NotDisarmedError, StorageError
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

VERIFY_MAX_S: Final = 60.0
"""So long the aircraft may move after the write before its effect counts as not seen."""
LOOK_S: Final = 10.0
"""Seconds that show a step, where a calibration must be still for longer."""
LOOK_LONGER_S: Final = 30.0
"""So long at most for a change that a few seconds do not show; beyond it flicker hides more than averaging shows."""
DISARMED_WITHIN_S: Final = 10.0
"""A heartbeat lost just before the write is waited for so long."""
TELEMETRY_S: Final = 2.0
"""So long after a write the telemetry may seem to be missing."""
POLL_S: Final = 0.2


class Pusher:
    """Writes the result of a calibration, all or nothing."""

    def __init__(
        self,
        config: Config,
        vehicle: Vehicle,
        parameters: ParameterClient,
        imus: Mapping[str, AutopilotImu],
        collector: RollingCollector,
        writer: ParameterWriter,
        ledger: Ledger,
        px4: Px4Writes,
        planner: Planner,
        firmware: FirmwareCalibration,
        offload: Offload,
    ) -> None:
        self._offload = offload
        self._px4, self._planner, self._firmware = px4, planner, firmware
        self._vehicle, self._parameters = vehicle, parameters
        self._imus, self._collector = imus, collector
        self._writer, self._ledger = writer, ledger
        self._sources = {imu.name: imu for imu in config.imu}
        self.enabled = config.push.parameters
        self._look_s = min(LOOK_S, config.calibration.min_still_s)

    async def offsets_still_hold(self) -> bool:
        """Read the offsets afresh; False when they were not, or not surely, those under which was measured.

        Raises:
            AutopilotError: they cannot be read; or what was unsure could not be made sure.
            StorageError: the old values could not be kept.
        """
        held = True
        for imu in self._imus.values():
            held &= await imu.refresh()
        return held and not (self.enabled and await self._px4.make_sure(list(self._imus.values())))

    async def plan(self, solution: Solution, draft: Draft) -> Plan:
        """As `Planner.plan`; nothing to write where results are not pushed."""
        return await self._planner.plan(solution, draft, push=self.enabled)

    @contextlib.asynccontextmanager
    async def written(self, plan: Plan, draft: Draft, go_on: Callable[[str], None]) -> AsyncIterator[Plan]:
        """Write and read back; on failure, also of the block, the old values are put back.

        The block verifies what was written: `verify` alone lets it stay.

        Args:
            plan: what to write.
            draft: filled with what was.
            go_on: told what takes longer.

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
                    self._note(plan, draft, error.written)
                    raise
            yield plan

    async def _write(
        self, plan: Plan, firmware: GyroParameters | None, draft: Draft, go_on: Callable[[str], None]
    ) -> Plan:
        if firmware is None:
            async with self._px4.standing_by([(t.calibration, t.changes) for t in plan.targets]) as look:
                self._note(plan, draft, await self._writer.apply(plan.changes, look))
            return plan
        done = await self._firmware.write(plan.changes, plan.gyros, firmware, go_on)
        self._note(plan, draft, done.written)
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
        verdicts, why_not = await self._look(plan, before, go_on)
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
                problems += self._note_verdicts(target, verdicts[target.name], draft)
        return problems

    async def look_again(self, plan: Plan, before: Window, go_on: Callable[[str], None]) -> tuple[list[str], str]:
        """After a restart: what the telemetry shows to be wrong; and why it could not be looked at, if so."""
        verdicts, why_not = await self._look(dataclasses.replace(plan, boots=self._vehicle.boots), before, go_on)
        found = verdicts or {}
        return [f"imu {name}: {in_short(v)}" for name, each in found.items() for v in each if not v.ok], why_not

    @staticmethod
    def settles_within_s(plan: Plan) -> float:
        """So long at most `settle` waits."""
        return settles_within_s(plan.firmware)

    async def settle(self, plan: Plan, go_on: Callable[[str], None]) -> str | None:
        """Wait until the autopilot's EKF agrees with the new gyro offsets; what a pilot should know, if it does not."""
        return await self._firmware.settle(plan.gyros, plan.firmware, go_on)

    async def _roll_back(self, plan: Plan, draft: Draft, reason: str) -> str:
        """Put the old values back; `reason`, and what became of them."""
        left: Sequence[str] = ()
        end = "will be once disarmed"
        with contextlib.suppress(NotDisarmedError):
            await self._wait_disarmed()  # after a restart the first heartbeat is still to come
        with self._changing(plan, everything=bool(plan.collateral)):
            try:
                self._note(plan, draft, await self._writer.restore(plan.everything))
            except WriteFailedError as error:
                self._note(plan, draft, error.written)
                left = error.left_changed
                if error.kind == "changed by someone else":
                    end = "somebody else changed them"
            except NothingWrittenError:
                left = [change.parameter for change in plan.everything]
                self._mark(plan, draft, left, "failed")
        if left:
            return f"{reason}; old values NOT back in {', '.join(left)}: {end}"
        with contextlib.suppress(StorageError):
            await self._ledger.undone()
        return f"{reason}; old values put back"

    def mark_lost(self, plan: Plan, draft: Draft, parameters: Iterable[str]) -> None:
        """These have been written and seen, and are no longer there."""
        for target in plan.targets:
            self._mark(Plan((target,), plan.boots), draft, list(parameters), "failed")

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

    @contextlib.contextmanager
    def _changing(self, plan: Plan, *, everything: bool) -> Iterator[None]:
        """While offsets change: those of the plan's IMUs, or of all."""
        ours = {target.name for target in plan.targets}
        with contextlib.ExitStack() as stack:
            for name, imu in self._imus.items():
                if everything or name in ours:
                    stack.enter_context(imu.changing())
            yield

    @staticmethod
    def _note(plan: Plan, draft: Draft, written: Mapping[str, WrittenParameter]) -> None:
        for target in plan.targets:
            kept = draft.written.setdefault(target.name, {})
            kept.update({c.parameter: written[c.parameter] for c in target.changes if c.parameter in written})

    @staticmethod
    def _mark(plan: Plan, draft: Draft, parameters: Sequence[str], outcome: Outcome) -> None:
        for target in plan.targets:
            kept = draft.written.get(target.name, {})
            for name in set(parameters) & set(kept):
                old = kept[name]
                kept[name] = WrittenParameter(
                    before=old.before, after=old.after, read_back=old.read_back, outcome=outcome
                )

    async def _wait_disarmed(self) -> None:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + DISARMED_WITHIN_S
        while self._vehicle.arm_state is ArmState.UNKNOWN and loop.time() < deadline_s:
            await asyncio.sleep(POLL_S)
        if self._vehicle.arm_state is ArmState.ARMED:
            raise NotDisarmedError("armed before the biases could be written; nothing was written")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            raise NotDisarmedError("no heartbeat, so nobody knows whether the aircraft is armed; nothing was written")

    async def _look(
        self, plan: Plan, before: Window, go_on: Callable[[str], None]
    ) -> tuple[dict[str, list[Verdict]] | None, str]:
        """Verdicts by IMU from a still stretch after the write, or why there was none to be had.

        A step that only just cannot be seen is looked at for longer.
        """
        watched = [target for target in plan.targets if target.watched]
        if not watched:
            return None, "no autopilot IMU is in the telemetry"
        loop = asyncio.get_running_loop()
        written = moment(self._vehicle)
        while not has_passed(self._vehicle, written, settle_s(self._vehicle.firmware)):
            go_on("waiting for the telemetry")
            await asyncio.sleep(POLL_S)
        since_s = loop.time()
        verdicts: dict[str, list[Verdict]] | None = None
        words = "waiting for the telemetry"
        while loop.time() < since_s + VERIFY_MAX_S:
            go_on(words)
            if self._vehicle.arm_state is ArmState.ARMED:
                return verdicts, "armed right after the write"
            if self._vehicle.boots != plan.boots:
                return None, "the autopilot rebooted right after the write"
            status = self._collector.status(loop.time())
            words = status.waiting_for or ""
            if words and status.still_s > 0.0:
                # How long a calibration must be still says nothing about how long a step takes to show.
                moves = self._collector.glance(loop.time()).obstacle
                words = "" if moves is None else moves.words
                if not words and status.still_s < self._look_s:
                    words = f"hold still {self._look_s - status.still_s:.0f} s more"
            if words and loop.time() < since_s + TELEMETRY_S:
                words = "waiting for the telemetry"  # which was not taken during the write
            elif words:
                words = f"checking the new offsets: {words}"
            else:
                try:
                    after = await estimating.window(self._collector, self._offload, since_s=since_s)
                except CalibrationRefusedError as error:
                    words = str(error)
                else:
                    verdicts = {target.name: self._judge(target, before, after) for target in watched}
                    found = [verdict for each in verdicts.values() for verdict in each]
                    hidden = any(nearly_visible(verdict) for verdict in found)
                    # The scatter of two seconds says little of their mean: nothing is called wrong on so little.
                    hasty = loop.time() < since_s + LOOK_S and not all(verdict.ok for verdict in found)
                    if not (hidden or hasty) or loop.time() > since_s + LOOK_LONGER_S:
                        return verdicts, ""
                    words = f"the change {'does not show' if hasty else 'is small'}: looking longer"
            await asyncio.sleep(POLL_S)
        return verdicts, f"not still within {VERIFY_MAX_S:.0f} s after the write ({words})"

    def _judge(self, target: Target, before: Window, after: Window) -> list[Verdict]:
        sides = Sides(
            before=next(imu for imu in before.imus if imu.name == target.name),
            after=next(imu for imu in after.imus if imu.name == target.name),
            gyro_residual=target.solution.gyro_rad_s,
            accel_residual=target.solution.accel_m_s2,
        )
        profile = self._sources[target.name].profile
        on_the_way = OnTheWay(
            self._px4.seen_far(target.calibration), *step_from_far(target.calibration, target.changes)
        )
        return judge_vectors(sides, target.calibration, list(target.changes), target.kind, profile, on_the_way)

    def _note_verdicts(self, target: Target, verdicts: list[Verdict], draft: Draft) -> list[str]:
        """Set the outcomes of one IMU's parameters; returns what is wrong, in words."""
        problems: list[str] = []
        for verdict in verdicts:
            if not verdict.ok:
                problems.append(f"imu {target.name}: {in_short(verdict)}")
            for words in (*verdict.problems, *verdict.warnings):
                draft.warn(target.name, words)
            for axis in verdict.axes:
                # A vector whose step as a whole was seen is in use; an axis that hardly changed cannot show more.
                # Where the integers show no step at all, the dither has shown that they follow these parameters.
                seen = verdict.ok and (not verdict.warnings or target.solution.dithered)
                outcome: Outcome = "verified" if seen else verdict.outcome(axis.parameter)
                self._mark(Plan((target,), 0), draft, [axis.parameter], outcome)
        return problems
