"""Temporary large offsets ("far values") in a write to PX4, which ignores small offset changes.

Each far value also shows which IMU's output an offset moves. PX4's calibration parameters are numbered by slot, and
which slot belongs to which SCALED_IMU message is a guess (autopilot/firmware/px4.py) until telemetry of all IMUs shows
the step. The step is large compared with noise and truncation, and only one sensor makes one at a time.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import logging
import math
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import NO_IMU, SlotMemory
from companion.autopilot.firmware.imu_calibration import FAR_ACCEL_M_S2, ImuCalibration, output_step, vector_changes
from companion.autopilot.firmware.imu_messages import all_zero
from companion.autopilot.firmware.px4 import IGNORED_STEP, MARGIN, WORDS, accel_offset_with
from companion.autopilot.parameters.change import Change, FarProbe, WriteFailedError
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleTimer
from companion.component.statustext import Say, Severity, Weight
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.offsets.journal import WriteJournal
from companion.daemon.offsets.plan import ImuPlan
from companion.links.mavlink.link import MavlinkLink, Message
from companion.messages import message
from companion.physics.frames import Array
from companion.physics.units import DEG, MG
from companion.samples import ImuSample, Triad, Vector
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

RATE_HZ: Final = 50.0
"""Message rate requested for IMUs that PX4 does not already stream."""
HEAR_S: Final = 0.4
BEFORE_S: Final = 1.0
"""Span of telemetry averaged before a temporary large offset is written, for comparison with later output."""
MEAN_S: Final = 0.4
"""Span of telemetry averaged while a temporary large offset is in use; earlier samples are left out."""
PATIENCE_S: Final = 2.5
"""Longest wait for the step in the telemetry. If somebody else writes too, PX4 applies our value up to 1 s later."""
KEPT_S: Final = 4.0
LEAST_SAMPLES: Final = 5
MATCH: Final = 0.2
"""Tolerance of an observed step, as a fraction of the expected step, in addition to small changes that PX4 ignores."""
CHECK_S: Final = 0.1


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ExpectedStep:
    """Expected step of one IMU's output when PX4 applies a temporary large offset ("far value") of one sensor."""

    instance: int
    sensor: Triad
    device_id: int
    slot: str
    step: Array
    """Expected step of the output, x y z in vehicle FRD; rad/s for a gyro, m/s^2 for an accelerometer."""
    rest: Array
    """Expected step when all new offsets replace the temporary large one, x y z, in units and frame of `step`."""
    unknown: float
    """Uncertainty of the expected step, as a fraction: PX4 may use offsets that differ a little from its parameters."""

    def moved(self, made: Array) -> bool:
        return bool(np.linalg.norm(made - self.step) < (self.unknown + MATCH) * np.linalg.norm(self.step))

    def stayed(self, made: Array) -> bool:
        return bool(np.linalg.norm(made) < (1.0 - self.unknown - MATCH) * np.linalg.norm(self.step))


Mean = tuple[Array, Array]
"""Mean of an IMU output and its sigma, each x y z in vehicle FRD, in rad/s or m/s^2."""
UnderFarOffset = Mapping[Triad, tuple[Mean, Array]]
"""Mean output (integer messages) under a temporary large offset, and expected step to the new offsets, by triad."""


class Px4Writes:
    """Observer of the telemetry while temporary large offsets are written to PX4; learns which IMU each one moves."""

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        writer: ParameterWriter,
        journal: WriteJournal,
        memory: SlotMemory,
        say: Say,
    ) -> None:
        self._link, self._vehicle, self._writer, self._journal = link, vehicle, writer, journal
        self._memory, self._say = memory, say
        self._steps: dict[str, ExpectedStep] = {}
        self.under_far_offset: defaultdict[int, dict[Triad, tuple[Mean, Array]]] = defaultdict(dict)
        """Mean outputs under the latest write's temporary large offsets, by IMU, of outputs that moved as expected."""
        self._learned = False  # True: this write has found the true parameter slot of a sensor
        self._boots = 0
        self._samples: defaultdict[int, deque[ImuSample]] = defaultdict(deque)
        self._before: dict[int, Mean | None] = {}
        self._unheard: set[int] = set()

    @contextlib.asynccontextmanager
    async def observing(
        self, targets: Sequence[ImuPlan], before: Mapping[str, Vector]
    ) -> AsyncIterator[FarProbe | None]:
        """Observe telemetry during a write; yield the check of temporary large offsets, or None if there are none.

        `before`: accelerometer outputs before the write, by IMU name.
        """
        self._learned, self._steps = False, {}
        self.under_far_offset.clear()
        for target in targets:
            self._steps |= far_steps(target.calibration, target.all, before.get(target.name, (0.0, 0.0, 0.0)))
        try:
            async with self._listening():
                yield self.watch if self._steps else None
        except WriteFailedError as error:
            if self._vehicle.arm_state is ArmState.ARMED:
                # A temporary large offset may be left, and nothing may be written while the aircraft is armed.
                for name in self._writer.left_far:
                    self._say(Severity.CRITICAL, _danger(self._steps[name]), Weight.RESULT)
            if error.kind == "wrong slot, orientation or scale" and not self._learned:
                # No other slot was learned, so another attempt would fail too: report a different error.
                raise WriteFailedError("without effect", error.reason, error.written, error.left_changed) from error
            raise
        # Reached only after a successful write.
        for target in targets:
            calibration, written = target.calibration, {change.parameter for change in target.all}
            names = calibration.parameters.accel_offset
            if calibration.far_axis is not None and written.intersection(names):
                self._memory.brought_into_use(names, accel_offset_with(calibration, target.all), self._vehicle.boots)

    async def apply_stored_offsets(self, imus: Sequence[AutopilotImu]) -> bool:
        """Make PX4 apply stored offsets that it possibly ignores, without changing them; return whether there were any.

        After an AutopilotError, `Recovery` restores any changed values. After a StorageError nothing was written.
        """
        unsure = [imu for imu in imus if imu.in_force.accel_offset_may_be_unused]
        targets = [
            ImuPlan(imu.name, imu.in_force, _same_again(imu.in_force), (None, None), watched=False) for imu in unsure
        ]
        changes = [change for target in targets for change in target.all]
        if not changes:
            return False
        logger.info("bringing offsets into use that PX4 may have ignored: %s", ", ".join(c.parameter for c in changes))
        try:
            async with self._journal.transaction(ChangeSet.of(self._vehicle.system_id, changes)):
                with changing(unsure):
                    async with self.observing(targets, {}) as probe:
                        await self._writer.apply(changes, probe)
                await self._journal.undone()
        except WriteFailedError as error:
            if error.kind != "wrong slot, orientation or scale" or error.left_changed:
                raise
            # The true slot was learned: the caller reads the offsets again from there.
        return True

    # --- the probe

    def watch(self, parameter: str) -> Callable[[], Awaitable[str | None]]:
        """Store mean outputs before a temporary large offset is written; return the function that checks its effect."""
        step = self._steps.get(parameter)
        if step is not None:
            now_s = asyncio.get_running_loop().time()
            imus = self._vehicle.kind.imu_messages
            self._before = {instance: self._mean(instance, step.sensor, now_s - BEFORE_S, now_s) for instance in imus}
        return functools.partial(self._verify, step)

    async def _verify(self, step: ExpectedStep | None) -> str | None:
        """Find the IMU whose output moved, and learn its parameter slot; return the fault, if any, as text."""
        if step is None:
            return None
        since, loop = VehicleTimer(self._vehicle), asyncio.get_running_loop()
        from_s = to_s = loop.time()
        while not since.has_passed(PATIENCE_S):
            await asyncio.sleep(CHECK_S)
            from_s, to_s = max(from_s, loop.time() - MEAN_S), loop.time()
            middle_s = to_s - MEAN_S / 2.0
            halves = (self._moves(step, from_s, middle_s), self._moves(step, middle_s, to_s))
            if all(step.instance in moved for moved, _ in halves):
                break
        else:
            from_s = loop.time() - BEFORE_S
        if self._vehicle.boots != self._boots:
            # A restart applies other offsets too, so a moved output proves nothing.
            return None
        moved, still = self._moves(step, from_s, loop.time())
        if step.instance in moved and (now := self._mean(step.instance, step.sensor, from_s, loop.time())):
            self.under_far_offset[step.instance][step.sensor] = now, step.rest
        return self._conclude(step, moved, still)

    def _conclude(self, step: ExpectedStep, moved: list[int], still: list[int]) -> str | None:
        word = WORDS[step.sensor]
        if moved == [step.instance]:
            self._memory.learn(step.sensor, step.device_id, step.instance)
            return None
        if len(moved) == 1 and step.instance in still:
            self._correct(step, moved[0])
            effect = f"act on the {word} of IMU {moved[0]}, not of IMU {step.instance}"
        elif not moved and step.instance in still:
            effect = f"do not act on the {word} of IMU {step.instance}"
            if self._memory.holds_strangers(step.sensor, len(self._samples.keys() | self._unheard)):
                self._correct(step, NO_IMU)
            else:
                # Each slot belongs to a known IMU, so the slot is right and the cause is another one.
                effect += ": PX4 does not use the stored values, or the aircraft moved"
        elif len(moved) > 1:
            effect = f"act on {len(moved)} IMUs at once: {', '.join(map(str, moved))}"
        else:
            logger.warning("%s", message("px4_slot_unclear", slot=step.slot, effect="belong to an IMU not known yet"))
            return None
        return message("px4_slot_unclear", slot=step.slot, effect=effect)

    def _correct(self, step: ExpectedStep, instance: int) -> None:
        self._learned = True
        self._memory.learn(step.sensor, step.device_id, instance)

    def _moves(self, step: ExpectedStep, from_s: float, to_s: float) -> tuple[list[int], list[int]]:
        moved: list[int] = []
        still: list[int] = []
        for instance in self._vehicle.kind.imu_messages:
            was, now = self._before.get(instance), self._mean(instance, step.sensor, from_s, to_s)
            if was is None or now is None:
                continue
            made = now[0] - was[0]
            if step.moved(made):
                moved.append(instance)
            elif step.stayed(made):
                still.append(instance)
        return moved, still

    # --- the telemetry of all IMUs

    @contextlib.asynccontextmanager
    async def _listening(self) -> AsyncIterator[None]:
        if not self._steps:
            yield
            return
        self._samples.clear()
        self._unheard.clear()
        self._boots = self._vehicle.boots
        messages = {instance: each[-1].message for instance, each in self._vehicle.kind.imu_messages.items()}
        subscriptions = [self._subscribe(instance) for instance in messages]
        asked: list[int] = []
        try:
            await asyncio.sleep(HEAR_S)
            for instance in messages.keys() - self._samples.keys():
                asked.append(messages[instance].id)
                self._unheard.add(instance)
                answer = self._vehicle.commands.request_message_interval(messages[instance].id, RATE_HZ)
                answer.add_done_callback(functools.partial(self._answered, instance))
            yield
        finally:
            for unsubscribe in subscriptions:
                unsubscribe()
            for message_id in asked:
                self._vehicle.commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 0.0)

    def _answered(self, instance: int, answer: asyncio.Future[int | None]) -> None:
        if answer.result() is not None:
            self._unheard.discard(instance)

    def _subscribe(self, instance: int) -> Callable[[], None]:
        kind = self._vehicle.kind.imu_messages[instance][-1]

        def take(message: Message, t_s: float) -> None:
            sample = kind.decode(message, t_s) if self._vehicle.sent(message) else ""
            if not isinstance(sample, str) and not all_zero(sample):
                kept = self._samples[instance]
                kept.append(sample)
                while kept[0].t_s < t_s - KEPT_S:
                    kept.popleft()

        return self._link.subscribe(kind.message, take)

    def _mean(self, instance: int, sensor: Triad, from_s: float, to_s: float) -> Mean | None:
        found = [
            sample.gyro_rad_s if sensor == "gyro" else sample.accel_m_s2
            for sample in self._samples.get(instance, ())
            if from_s <= sample.t_s <= to_s
        ]
        if len(found) < LEAST_SAMPLES:
            return None
        values = np.array(found)
        return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(found))


def far_steps(calibration: ImuCalibration, changes: Sequence[Change], accel_m_s2: Vector) -> dict[str, ExpectedStep]:
    """Return the expected step of each temporary large offset, by parameter; `accel_m_s2`: output before the write."""
    names, found = calibration.parameters, dict[str, ExpectedStep]()
    new = {change.parameter: change.after for change in changes}
    in_use = {change.parameter: change.before for change in changes}

    def output(values: Mapping[str, float], triad: Triad) -> Array:
        """Return the output, x y z, under the parameters `values`, minus the output under those before the write."""
        there = [dataclasses.replace(change, after=values[change.parameter]) for change in changes]
        return np.array(output_step(calibration, there, accel_m_s2)[0 if triad == "gyro" else 1])

    for change in changes:
        if change.via is None:
            continue
        triad: Triad = "accel"
        device_id, name = calibration.accel_id, names.accel_id
        if change.parameter in names.gyro_offset:
            triad, device_id, name = "gyro", calibration.gyro_id, names.gyro_id
        far = output(in_use | {change.parameter: change.far}, triad)
        if (step := far - output(in_use, triad)).any() and device_id is not None:
            unknown = MARGIN * IGNORED_STEP / abs(change.via - change.before)
            slot = name.removesuffix("_ID")
            found[change.parameter] = ExpectedStep(
                calibration.instance, triad, device_id, slot, step, output(new, triad) - far, unknown
            )
        # PX4 uses the whole new vector before the next temporary large offset is written.
        for vector in (names.gyro_offset, names.accel_offset, names.accel_scale):
            if change.parameter in vector:
                in_use |= {one: new[one] for one in vector if one in new}
    return found


def _danger(step: ExpectedStep) -> str:
    size = float(np.linalg.norm(step.step))
    if step.sensor == "gyro":
        return message("disarm_now", quantity="yaw rate", error=f"{size / DEG:.1f} deg/s")
    return message("disarm_now", quantity="vertical acceleration", error=f"{size / MG:.0f} mg")


def _same_again(calibration: ImuCalibration) -> tuple[Change, ...]:
    offset, axis = calibration.accel_offset_m_s2, calibration.far_axis
    if axis is None:
        return ()
    return tuple(vector_changes(calibration.parameters.accel_offset, offset, offset, axis, FAR_ACCEL_M_S2))
