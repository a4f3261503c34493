"""What a write to PX4 needs besides the writing: whose output it moves, and which offsets are in use at all.

Which slot belongs to which SCALED_IMU is a guess (autopilot.firmware.px4) until a far value is in force and seen in the
telemetry of all IMUs. The far step is large beside noise and truncation, and each IMU that is written makes another
one, so a second of samples tells them apart; the small change itself often could not be seen at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import logging
import math
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step, vector_changes
from companion.autopilot.firmware.px4 import NO_IMU, WORDS, SlotMemory, accel_offset_with
from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.parameters.writer import Look, ParameterWriter
from companion.autopilot.telemetry import imu_messages
from companion.autopilot.vehicle.vehicle import ArmState, Moment, Vehicle
from companion.component.statustext import Say, Severity, Weight
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.offsets.ledger import Ledger
from companion.links.mavlink.link import MavlinkLink, Message
from companion.physics.frames import Array, vector
from companion.samples import Triad, Vector
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

RATE_HZ: Final = 50.0
"""Rate asked of IMUs that nobody listens to otherwise."""
HEAR_S: Final = 0.4
BEFORE_S: Final = 1.0
SETTLE_S: Final = 1.3
"""PX4 looks at its parameters at most once a second (autopilots 9.2)."""
LOOK_S: Final = 1.2
LEAST_SAMPLES: Final = 5
MATCH: Final = 0.4
"""Of the expected step: so far may what was seen be from it. PX4 may have used other offsets than its parameters say,
by up to 0.01 of the 0.035 rad/s (0.087 m/s^2) that a far step has at least."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FarStep:
    """What the output of one IMU must do when a far value comes into force in the slot of one of its sensors."""

    instance: int
    sensor: Triad
    device_id: int
    slot: str
    """For people: CAL_GYRO0."""
    step: Array
    """(3,), rad/s or m/s^2, vehicle FRD."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FarMean:
    """An output while a far value was in force: mean and its sigma, (3,), rad/s or m/s^2, vehicle FRD."""

    mean: Array
    sigma: Array


class _Sums:
    """Samples of all IMUs over one stretch."""

    def __init__(self) -> None:
        self._sums: dict[tuple[int, Triad], list[Array]] = {}

    def add(self, instance: int, reading: imu_messages.Reading) -> None:
        self._sums.setdefault((instance, "gyro"), []).append(np.array(reading.gyro_rad_s))
        self._sums.setdefault((instance, "accel"), []).append(np.array(reading.accel_m_s2))

    def mean(self, instance: int, sensor: Triad) -> FarMean | None:
        samples = self._sums.get((instance, sensor), ())
        if len(samples) < LEAST_SAMPLES:
            return None
        values = np.array(samples)
        return FarMean(values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(samples)))


class _FarStepWatch:
    """Watches the telemetry of all IMUs over a write in two steps, and tells the memory what was seen."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, memory: SlotMemory) -> None:
        self.means: Mapping[tuple[int, Triad], FarMean] = {}
        """By instance, from the last look: only of what moved as it should."""
        self._link, self._vehicle, self._memory = link, vehicle, memory
        self.learned = False
        """Whether the last look has told anything of the slots that was not known."""
        self._sums: _Sums | None = None
        self._heard: set[int] = set()
        self._unknown: set[int] = set()
        """IMUs of which nobody could say whether there is such a one."""

    @contextlib.asynccontextmanager
    async def watching(self, steps: Sequence[FarStep]) -> AsyncIterator[Look | None]:
        """Collect from now on; gives what to call while the far values are in force (None: there are none)."""
        self.means, self.learned = {}, False
        if not steps:
            yield None
            return
        self._heard.clear()
        self._unknown.clear()
        boots = self._vehicle.boots
        subscriptions = [self._subscribe(instance) for instance in imu_messages.PX4]
        asked: list[int] = []
        try:
            await asyncio.sleep(HEAR_S)
            for instance, (message, *_) in imu_messages.PX4.items():
                if instance not in self._heard:
                    asked.append(message.message.id)
                    self._unknown.add(instance)
                    answer = self._vehicle.commands.request_message_interval(message.message.id, RATE_HZ)
                    answer.add_done_callback(functools.partial(self._answered, instance))
            self._sums = before = _Sums()
            await Moment(self._vehicle).let_pass(BEFORE_S)
            self._sums = None

            async def look() -> str | None:
                await Moment(self._vehicle).let_pass(SETTLE_S)
                self._sums = during = _Sums()
                await Moment(self._vehicle).let_pass(LOOK_S)
                self._sums = None
                # A restart brings other offsets into use by itself: whoever moved or did not, it says nothing.
                return None if self._vehicle.boots != boots else self._judge(steps, before, during)

            yield look
        finally:
            self._sums = None
            for unsubscribe in subscriptions:
                unsubscribe()
            for message_id in asked:
                self._vehicle.commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 0.0)

    def _answered(self, instance: int, answer: asyncio.Future[int | None]) -> None:
        if answer.result() is not None:
            self._unknown.discard(instance)

    def _subscribe(self, instance: int) -> Callable[[], None]:
        kind = imu_messages.PX4[instance][0]

        def take(message: Message, _t_s: float) -> None:
            reading = kind.decode(message) if self._vehicle.sent(message) else ""
            if not isinstance(reading, str) and not reading.all_zero:
                self._heard.add(instance)
                if self._sums is not None:
                    self._sums.add(instance, reading)

        return self._link.subscribe(kind.message, take)

    def _judge(self, steps: Sequence[FarStep], before: _Sums, during: _Sums) -> str | None:
        """Remember whose output moved; why this is not as it was believed, if so."""
        wrong: list[str] = []
        means: dict[tuple[int, Triad], FarMean] = {}
        for step in steps:
            rivals = [each for each in steps if each.sensor == step.sensor]
            moved: list[int] = []
            still: list[int] = []
            for instance in imu_messages.PX4:
                was, now = before.mean(instance, step.sensor), during.mean(instance, step.sensor)
                if was is None or now is None:
                    continue
                made = now.mean - was.mean
                cause = _cause(made, rivals)
                if cause is step:
                    moved.append(instance)
                    if instance == step.instance:
                        means[instance, step.sensor] = now
                elif cause is not None or np.linalg.norm(made) < MATCH * np.linalg.norm(step.step):
                    still.append(instance)
            words = self._conclude(step, moved, still)
            if words is not None:
                wrong.append(words)
        self.means = means
        return "; ".join(wrong) or None

    def _conclude(self, step: FarStep, moved: list[int], still: list[int]) -> str | None:
        word = WORDS[step.sensor]
        if moved == [step.instance]:
            self._memory.learn(step.sensor, step.device_id, step.instance)
            return None
        if len(moved) == 1 and step.instance in still:
            self._learn(step, moved[0])
            return f"the offsets in {step.slot} act on the {word} of IMU {moved[0]}, not of IMU {step.instance}"
        if not moved and step.instance in still:
            words = f"the offsets in {step.slot} do not act on the {word} of IMU {step.instance}"
            if self._memory.holds_strangers(step.sensor, len(self._heard | self._unknown)):
                self._learn(step, NO_IMU)
                return words
            # Every slot is somebody's: there is another reason, and what would be tried next is another IMU's.
            return f"{words}: PX4 does not use what it has stored, or it moved"
        if len(moved) > 1:
            return f"the offsets in {step.slot} seem to act on IMU {' and '.join(map(str, moved))} at once"
        logger.warning("%s: it cannot be told yet which IMU its offsets act on", step.slot)
        return None

    def _learn(self, step: FarStep, instance: int) -> None:
        self.learned = True
        self._memory.learn(step.sensor, step.device_id, instance)


def _cause(made: Array, steps: Sequence[FarStep]) -> FarStep | None:
    """The step that an output made, if it made one."""
    nearest = min(steps, key=lambda step: float(np.linalg.norm(made - step.step)))
    off = float(np.linalg.norm(made - nearest.step))
    return nearest if off < MATCH * float(np.linalg.norm(nearest.step)) else None


class Px4Writes:
    """Stands by while parameters are written; of ArduPilot's it has nothing to say."""

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        writer: ParameterWriter,
        ledger: Ledger,
        memory: SlotMemory,
        say: Say,
    ) -> None:
        self._vehicle, self._writer, self._ledger = vehicle, writer, ledger
        self._watch, self._memory, self._say = _FarStepWatch(link, vehicle, memory), memory, say

    @contextlib.asynccontextmanager
    async def standing_by(
        self, targets: Sequence[tuple[ImuCalibration, Sequence[Change], Vector]]
    ) -> AsyncIterator[Look | None]:
        """Over a write of these changes; gives what to call while the far values are in force (None: no need).

        The last of each target is what its accelerometers read.
        """
        steps = [step for calibration, changes, read in targets for step in far_steps(calibration, changes, read)]
        try:
            async with self._watch.watching(steps) as look:
                yield look
        except WriteFailedError as error:
            if steps and error.left_changed and self._vehicle.arm_state is ArmState.ARMED:
                # Between the steps the offsets are wrong on purpose, and while it is armed nobody may mend that.
                self._say(Severity.CRITICAL, "DISARM NOW: the offsets are wrong", Weight.RESULT)
            if error.kind == "not as believed" and not self._watch.learned:
                # Nothing was learned: the same slot again, and not for ever.
                raise WriteFailedError("without effect", error.reason, error.written, error.left_changed) from error
            raise
        # Only a write that came to its end comes here.
        for calibration, changes, _ in targets:
            written = {change.parameter for change in changes}
            if calibration.far_step is not None and written.intersection(calibration.parameters.accel_offset):
                after = accel_offset_with(calibration, changes)
                self._memory.brought_into_use(calibration.parameters.accel_offset, after, self._vehicle.boots)

    def seen_far(self, calibration: ImuCalibration) -> Mapping[Triad, FarMean]:
        """The output of an IMU while the far values of the last write were in force, as far as it was seen."""
        return {of: mean for (number, of), mean in self._watch.means.items() if number == calibration.instance}

    async def make_sure(self, imus: Sequence[AutopilotImu]) -> bool:
        """Bring offsets that may not be in use into use, unchanged; True when there were any.

        Raises:
            AutopilotError: this failed; the recovery puts right what may be left.
            StorageError: the values could not be kept, so nothing was written.
        """
        unsure = [imu for imu in imus if imu.in_force.accel_offset_may_be_unused]
        changes = [change for imu in unsure for change in _again(imu.in_force)]
        if not changes:
            return False
        logger.info("bringing offsets into use that PX4 may have ignored: %s", ", ".join(c.parameter for c in changes))
        targets = [(imu.in_force, _again(imu.in_force), (0.0, 0.0, 0.0)) for imu in unsure]
        try:
            async with self._ledger.transaction(ChangeSet.of(self._vehicle.system_id, changes)):
                with changing(unsure):
                    async with self.standing_by(targets) as look:
                        await self._writer.apply(changes, look)
                await self._ledger.undone()
        except WriteFailedError as error:
            if error.kind != "not as believed" or error.left_changed:
                raise
            # Something was learned: the offsets are read again, from another slot.
        return True


def far_steps(calibration: ImuCalibration, changes: Sequence[Change], accel_m_s2: Vector) -> list[FarStep]:
    """What the output must do when the far values of these changes come into force; it reads `accel_m_s2` before."""
    gyro, accel = output_step(calibration, _far(changes), accel_m_s2)
    names, found = calibration.parameters, []
    halves: tuple[tuple[Triad, int | None, str, Vector], ...] = (
        ("gyro", calibration.gyro_id, names.gyro_id, gyro),
        ("accel", calibration.accel_id, names.accel_id, accel),
    )
    for kind, device_id, name, step in halves:
        if any(step) and device_id is not None:
            found.append(FarStep(calibration.instance, kind, device_id, name.removesuffix("_ID"), np.array(step)))
    return found


def step_from_far(calibration: ImuCalibration, changes: Sequence[Change], accel_m_s2: Vector) -> tuple[Vector, Vector]:
    """By how much the output must move from the far values to the new ones: gyro rad/s, accelerometer m/s^2."""
    indirect = [change for change in changes if change.via is not None]
    far = _far(changes)
    whole, there = (output_step(calibration, each, accel_m_s2) for each in (indirect, far))
    return vector(np.subtract(whole[0], there[0])), vector(np.subtract(whole[1], there[1]))


def _far(changes: Sequence[Change]) -> list[Change]:
    return [dataclasses.replace(c, after=c.via, via=None) for c in changes if c.via is not None]


def _again(calibration: ImuCalibration) -> list[Change]:
    offset, far = calibration.accel_offset_m_s2, calibration.far_step
    if far is None:
        return []
    return vector_changes(calibration.parameters.accel_offset, offset, offset, far.accel_m_s2)
