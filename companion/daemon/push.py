"""Biases into the autopilot: plan, write, look in the telemetry, and put back what did not work."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from companion.autopilot.ardupilot import ImuCalibration, changes_for, read_calibration, whole_bias
from companion.autopilot.float32 import same_float32
from companion.autopilot.imu_stream import StreamKind
from companion.autopilot.parameters import ParameterClient
from companion.autopilot.vehicle import ArmState, Vehicle
from companion.autopilot.verify import Verdict
from companion.autopilot.writer import Change, ParameterWriter, WriteFailedError
from companion.calibration.record import Outcome, WrittenParameter
from companion.calibration.rolling import RollingCollector, Window
from companion.calibration.solve import ImuSolution, Solution
from companion.config import Config
from companion.daemon.autopilot_imu import AutopilotImu
from companion.daemon.effect import Sides, in_short, judge_vectors, nearly_visible
from companion.daemon.ledger import Ledger
from companion.daemon.report import Draft
from companion.errors import AutopilotError, CalibrationRefusedError, NotDisarmedError, StorageError
from companion.physics.frames import Array
from companion.samples import Vector
from companion.storage.changes import Changed, ChangeSet

logger = logging.getLogger(__name__)

SETTLE_S: Final = 1.0
"""ArduPilot's telemetry shows a new offset within 60 ms (its 20 Hz filter); a second covers slower links."""
VERIFY_MAX_S: Final = 60.0
"""So long the aircraft may move after the write before its effect counts as not seen."""
LOOK_LONGER_S: Final = 30.0
"""So long at most for a change that a few seconds do not show; beyond it flicker hides more than averaging shows."""
DISARMED_WITHIN_S: Final = 10.0
"""A heartbeat lost just before the write is waited for so long."""
POLL_S: Final = 0.2


@dataclasses.dataclass(frozen=True, slots=True)
class Target:
    """One autopilot IMU that gets new offsets."""

    name: str
    calibration: ImuCalibration
    changes: tuple[Change, ...]
    solution: ImuSolution
    kind: StreamKind | None
    watched: bool
    """Whether its output is in the telemetry that we collect."""


@dataclasses.dataclass(frozen=True, slots=True)
class Plan:
    """What is to be changed."""

    targets: tuple[Target, ...]
    boots: int
    """How often the autopilot had rebooted when this was made."""

    @property
    def changes(self) -> tuple[Change, ...]:
        """All of it, in the order of writing."""
        return tuple(change for target in self.targets for change in target.changes)


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
    ) -> None:
        self._vehicle, self._parameters = vehicle, parameters
        self._imus, self._collector = imus, collector
        self._writer, self._ledger = writer, ledger
        self._sources = {imu.name: imu for imu in config.imu}
        self.enabled = config.push.parameters

    async def offsets_still_hold(self) -> bool:
        """Read the offsets afresh; False when they were not those under which was measured."""
        held = True
        for imu in self._imus.values():
            held &= await imu.refresh()
        return held

    async def plan(self, solution: Solution, draft: Draft) -> Plan:
        """Work out which parameter gets which value; fills the draft's whole biases and warnings.

        Raises:
            AutopilotError: a parameter cannot be read, or the autopilot cannot be calibrated as it is.
            CalibrationRefusedError: what was found is no bias.
        """
        targets: list[Target] = []
        for found in solution.imus:
            imu, source = self._imus.get(found.name), self._sources[found.name]
            if imu is not None:
                calibration = imu.in_force
                draft.whole[found.name] = _whole(calibration, found)
                gyro, accel = found.gyro_rad_s, found.accel_m_s2
            elif source.autopilot_instance is not None:
                calibration = await read_calibration(self._parameters, source.autopilot_instance)
                gyro, accel = _residual_of_consumer(calibration, found)
            else:
                continue
            for warning in calibration.warnings:
                draft.warn(found.name, warning)
            changes = changes_for(calibration, _vector(gyro), _vector(accel))
            if self.enabled:
                kind = imu.stream.kind if imu is not None else None
                targets.append(Target(found.name, calibration, tuple(changes), found, kind, watched=imu is not None))
        return Plan(tuple(targets), self._vehicle.boots)

    async def write(self, plan: Plan, draft: Draft) -> None:
        """Write and read back; on failure the old values are put back.

        Raises:
            AutopilotError: what went wrong, and which parameters could not be put back, if any.
            StorageError: the old values could not be kept, so nothing was written.
        """
        await self._wait_disarmed()
        await self._ledger.begin(self._change_set(plan))
        with self._changing(plan):
            try:
                self._note(plan, draft, await self._writer.apply(plan.changes))
            except WriteFailedError as error:
                self._note(plan, draft, error.written)
                await self._settle(error.left_changed)
                raise
            except BaseException:
                # Nothing was written, or we are being torn down: the mender looks what is in force.
                self._ledger.orphaned.set()
                raise

    async def verify(self, plan: Plan, before: Window, draft: Draft, go_on: Callable[[str], None]) -> None:
        """Watch the telemetry take the step that it must; `go_on(words)` is called now and then meanwhile.

        Raises:
            AutopilotError: the autopilot does not use what it stored; the old values are back, or it is said which
                are not.
        """
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
        if problems:
            await self.roll_back(plan, draft, "; ".join(problems))
        try:
            await self._ledger.commit(self._change_set(plan))
        except StorageError as error:
            # What cannot be undone later must not stay.
            await self.roll_back(plan, draft, str(error))

    async def roll_back(self, plan: Plan, draft: Draft, reason: str) -> None:
        """Put the old values back and say so.

        Raises:
            AutopilotError: always; `reason`, and what became of the old values.
        """
        left: Sequence[str]
        end = "will be once disarmed"
        with contextlib.suppress(NotDisarmedError):
            await self._wait_disarmed()  # after a restart the first heartbeat is still to come
        with self._changing(plan):
            try:
                self._note(plan, draft, await self._writer.restore(plan.changes))
                left = ()
            except WriteFailedError as error:
                self._note(plan, draft, error.written)
                left = error.left_changed
                if error.kind == "changed by someone else":
                    end = "somebody else changed them"
            except NotDisarmedError:
                left = [change.parameter for change in plan.changes]
                self._mark(plan, draft, left, "failed")
        await self._settle(left)
        if left:
            raise AutopilotError(f"{reason}; old values NOT back in {', '.join(left)}: {end}")
        raise AutopilotError(f"{reason}; old values put back")

    async def _settle(self, left: Sequence[str]) -> None:
        """After a write that failed: nothing is open any more, or the mender has to end it."""
        if left:
            self._ledger.orphaned.set()
        else:
            try:
                await self._ledger.abandon()
            except StorageError:
                self._ledger.orphaned.set()

    def leave_to_mender(self) -> None:
        """Whatever is open and has not been brought to an end is the mender's now."""
        if self._ledger.open is not None:
            self._ledger.orphaned.set()

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
    def _changing(self, plan: Plan) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            for target in plan.targets:
                if target.watched:
                    stack.enter_context(self._imus[target.name].changing())
            yield

    def _change_set(self, plan: Plan) -> ChangeSet:
        return ChangeSet(
            system_id=self._vehicle.system_id or 0,
            changes=tuple(Changed(change.parameter, change.before, change.after) for change in plan.changes),
        )

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
        since_s = loop.time() + SETTLE_S
        verdicts: dict[str, list[Verdict]] | None = None
        words = "waiting for the telemetry"
        while loop.time() < since_s + VERIFY_MAX_S:
            go_on(words)
            if self._vehicle.arm_state is ArmState.ARMED:
                return verdicts, "armed right after the write"
            if self._vehicle.boots != plan.boots:
                return None, "the autopilot rebooted right after the write"
            words = self._collector.status(loop.time()).waiting_for or ""
            if not words:
                try:
                    after = self._collector.window(loop.time(), since_s=since_s)
                except CalibrationRefusedError as error:
                    words = str(error)
                else:
                    verdicts = {target.name: self._judge(target, before, after) for target in watched}
                    hidden = any(nearly_visible(verdict) for each in verdicts.values() for verdict in each)
                    if not hidden or loop.time() > since_s + LOOK_LONGER_S:
                        return verdicts, ""
                    words = "the change is small: looking longer"
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
        return judge_vectors(sides, target.calibration, list(target.changes), target.kind, profile)

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
                seen = verdict.ok and not verdict.warnings
                outcome: Outcome = "verified" if seen else verdict.outcome(axis.parameter)
                self._mark(Plan((target,), 0), draft, [axis.parameter], outcome)
        return problems


def _whole(calibration: ImuCalibration, found: ImuSolution) -> tuple[Array | None, Array | None]:
    gyro, accel = whole_bias(calibration, _vector(found.gyro_rad_s) or _ZERO, _vector(found.accel_m_s2) or _ZERO)
    return (
        np.array(gyro) if found.gyro_rad_s is not None else None,
        np.array(accel) if found.accel_m_s2 is not None else None,
    )


def _residual_of_consumer(calibration: ImuCalibration, found: ImuSolution) -> tuple[Array | None, Array | None]:
    """What is left in the output of an autopilot that consumes our own IMU, from the IMU's whole bias."""
    rotation, scale = calibration.orientation, np.asarray(calibration.accel_scale)
    gyro = accel = None
    if found.gyro_rad_s is not None:
        gyro = found.gyro_rad_s - rotation @ np.asarray(calibration.gyro_offset_rad_s)
    if found.accel_m_s2 is not None:
        board = rotation.T @ found.accel_m_s2
        accel = rotation @ (scale * (board - np.asarray(calibration.accel_offset_m_s2)))
    return gyro, accel


_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


def _vector(values: Array | None) -> Vector | None:
    if values is None:
        return None
    x, y, z = (float(value) for value in values)
    return x, y, z
