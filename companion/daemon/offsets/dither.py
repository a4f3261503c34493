"""Offset dither: steps the autopilot's offsets below the last digit of an integer stream, and restores them.

The old values and all values of the steps are on disk before the first write; the recovery restores the old ones after
whatever ends the dither too early: a cancel, arming, a reboot, a lost link, the daemon's death.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Moment
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.plan import WriteLog
from companion.errors import AutopilotError, CalibrationRefusedError, CompanionError
from companion.estimation.collector.intake import LIMITS_IMU
from companion.estimation.machine import Event
from companion.estimation.means.dither import SECONDS, STEPS, Dithered, Step, combine, shifts_lsb, why_void
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.physics.frames import Array, vector
from companion.samples import ImuSample, Vector
from companion.storage.changes import Changed, ChangeSet

logger = logging.getLogger(__name__)

WRITE_S: Final = 0.5
POLL_S: Final = 0.2
SLACK_S: Final = 6.0
"""Extra time of a step when readings are lost."""
MOST_VOID: Final = 6
"""Void steps after which a dither fails."""
BACK_WITHIN_S: Final = 20.0
"""Longest wait for the recovery before the job ends without it."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Work:
    """One IMU's dither."""

    imu: AutopilotImu
    calibration: ImuCalibration
    steps_si: Array
    values: tuple[dict[str, float], ...]
    """Parameters by step."""
    boots: int

    @property
    def before(self) -> dict[str, float]:
        """Old parameter values."""
        return self.calibration.offsets

    def step(self, values: Mapping[str, float], batches: Sequence[Batch]) -> Step:
        """Make a step from the batches collected under these parameters."""
        changes = [Change(name, before, values[name]) for name, before in self.before.items()]
        return Step(np.concatenate(output_step(self.calibration, changes)) / self.steps_si, batches)


class Ditherer:
    """Replaces means that the last digit of integers hides, where the configuration allows it."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], writer: ParameterWriter, ledger: Ledger) -> None:
        self._allowed, self._wanted = core.config.push.dither, core.wanted
        self._vehicle, self._parameters, self._collector = core.vehicle, core.parameters, core.collector
        self._machine, self._imus, self._writer, self._ledger = core.machine, imus, writer, ledger
        self._profiles = core.profiles

    async def refine(self, window: Window, job: Job, log: WriteLog) -> Window:
        """Dither every IMU of the window that needs it; returns the window with their means in place.

        Raises:
            AutopilotError: moved too often, armed, out of time, a write failed or the autopilot restarted; the old
                values are back, or it is said that they will be.
            JobCancelledError: cancelled; likewise.
            StorageError: the old values could not be kept; nothing was written.
        """
        if not (self._allowed and self._wanted.push):
            return window
        found: list[ImuWindow] = []
        for each in window.imus:
            imu = self._imus.get(each.name)
            if imu is None or not each.hidden:
                found.append(each)
                continue
            # PX4's own calibration would take a far offset for a bias in the middle of it.
            rivals = [rival.words for rival in imu.in_force.rivals if rival.parameter == "IMU_GYRO_CAL_EN"]
            if rivals:
                log.warn(each.name, f"imu {each.name}: offsets not dithered: {rivals[0]}")
                found.append(each)
                continue
            writes = self._parameters.writes
            self._machine.on(Event.DITHER)
            result = await self._dither(each, imu, job)
            writes = self._parameters.writes - writes
            log.warn(each.name, f"imu {each.name}: offsets dithered and put back, {writes} parameter writes")
            found.append(_with(each, result))
        return msgspec.structs.replace(window, imus=tuple(found))

    async def _dither(self, window: ImuWindow, imu: AutopilotImu, job: Job) -> Dithered:
        work = self._prepare(window, imu)
        with imu.changing():
            try:
                async with self._ledger.transaction(self._journal(work), stepwise=True):
                    done = await self._steps(work, job)
                    await self._ledger.undone()
            except (CompanionError, JobCancelledError) as error:
                if not self._ledger.pending:
                    raise  # the old values could not be kept, so nothing was written
                words = f"{error}; {await self._put_back()}"
                kind = JobCancelledError if isinstance(error, JobCancelledError) else AutopilotError
                raise kind(words) from error
        await imu.refresh()
        if imu.in_force.offsets != work.before:
            raise AutopilotError(f"imu {work.imu.name}: somebody changed its offsets while they were dithered")
        return combine(
            done, work.steps_si, noise_profile(self._profiles.of(window.name)), self._wanted.settings.horizon_s
        )

    async def _steps(self, work: _Work, job: Job) -> list[Step]:
        """Carry out all steps, then restore the old values."""
        in_force = work.before
        done: list[Step] = []
        voids = 0
        while len(done) < STEPS:
            job.progress(0.0, f"dithering IMU {work.imu.instance}: step {len(done) + 1}/{STEPS}")
            job.lasts((STEPS - len(done)) * self._step_s())
            self._check(job, work)
            wanted = work.values[len(done)]
            await self._writer.apply([Change(name, in_force[name], wanted[name]) for name in wanted])
            in_force = wanted
            step, moved = await self._collect(work, wanted, job)
            why = moved or why_void(done, step, work.steps_si)
            if why is None:
                done.append(step)
                continue
            voids += 1
            logger.info("dithering %s: step %d is void: %s", work.imu.name, len(done) + 1, why)
            if voids > MOST_VOID:
                raise CalibrationRefusedError(f"imu {work.imu.name}: not still while its offsets dithered: {why}")
        job.progress(0.0, f"dithering IMU {work.imu.instance}: putting its offsets back")
        await self._writer.restore([Change(name, before, in_force[name]) for name, before in work.before.items()])
        return done

    def _step_s(self) -> float:
        """Duration of a step: write, delay of the telemetry, whole seconds."""
        return WRITE_S + self._vehicle.kind.settle_s + SECONDS + 1.0

    def _prepare(self, window: ImuWindow, imu: AutopilotImu) -> _Work:
        calibration, kind = imu.in_force, imu.stream.kind
        if kind is None or not kind.truncates:
            raise AutopilotError(f"imu {window.name}: its integer telemetry has gone")
        steps_si = np.repeat([kind.gyro_step_rad_s, kind.accel_step_m_s2], 3)
        reading = np.array([*window.gyro_rad_s, *window.accel_m_s2]) / steps_si
        shifts = shifts_lsb(reading, alternate=self._vehicle.kind.ignores_small_steps)
        values = tuple(_offsets(calibration, shift * steps_si) for shift in shifts)
        return _Work(imu, calibration, steps_si, values, self._vehicle.boots)

    def _journal(self, work: _Work) -> ChangeSet:
        return ChangeSet(
            system_id=self._vehicle.system_id or 0,
            changes=tuple(
                Changed(
                    name, before, after=work.values[0][name], also=tuple(values[name] for values in work.values[1:])
                )
                for name, before in work.before.items()
            ),
        )

    def _check(self, job: Job, work: _Work) -> None:
        job.check_cancelled()
        if self._vehicle.arm_state is ArmState.ARMED:
            raise CalibrationRefusedError("armed while the offsets dithered")
        if self._vehicle.arm_state is ArmState.UNKNOWN:
            raise AutopilotError("no heartbeat while the offsets dithered")
        if self._vehicle.boots != work.boots:
            raise AutopilotError("the autopilot rebooted while the offsets dithered")
        job.check_time()

    async def _collect(self, work: _Work, values: Mapping[str, float], job: Job) -> tuple[Step, str | None]:
        """Collect the seconds of one step once the telemetry shows it; returns words on a movement too."""
        loop = asyncio.get_running_loop()
        written = Moment(self._vehicle)
        while not written.has_passed(self._vehicle.kind.settle_s):
            await job.pause(POLL_S)
            self._check(job, work)
        settled_s = loop.time()
        source = BatchSource(LIMITS_IMU, SECONDS + 2, steps=work.steps_si)
        deadline_s = settled_s + SECONDS + 1.0 + SLACK_S
        moved: str | None = None

        def take(sample: ImuSample) -> None:
            if sample.t_s >= settled_s and len(source.batches) < SECONDS:
                source.add(sample.t_s, sample.gyro_rad_s + sample.accel_m_s2, None, sample.t_device_s)

        stop = work.imu.on_sample.add(take)
        try:
            while len(source.batches) < SECONDS and loop.time() < deadline_s:
                await job.pause(POLL_S)
                self._check(job, work)
                source.close_before(loop.time() - 0.5)
                moved = moved or self._moving(work.imu.name)
        finally:
            stop()
        batches: Sequence[Batch] = list(source.batches.values())[:SECONDS]
        return work.step(values, batches), moved

    def _moving(self, own: str) -> str | None:
        """Return words of another device on a movement; the dithered IMU takes no part."""
        for source in self._collector.status(asyncio.get_running_loop().time()).sources:
            if source.name != own and not source.still and source.words:
                return source.words
        return None

    async def _put_back(self) -> str:
        """Let the recovery restore the old offsets; returns the result in words."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + BACK_WITHIN_S
        while loop.time() < deadline_s and self._vehicle.arm_state is not ArmState.ARMED:
            if not self._ledger.pending:
                return "old values back"
            await asyncio.sleep(POLL_S)
        return "old values NOT back yet: disarm, keep it connected"


def _offsets(calibration: ImuCalibration, shift: Array) -> dict[str, float]:
    """Compute parameters that shift the output (6, vehicle FRD): off - R^-1 shift, accelerometer over scale."""
    names, rotation = calibration.parameters, calibration.orientation
    gyro = np.asarray(calibration.gyro_offset_rad_s) - rotation.T @ shift[:3]
    accel = np.asarray(calibration.accel_offset_m_s2) - (rotation.T @ shift[3:]) / np.asarray(calibration.accel_scale)
    pairs = [*zip(names.gyro_offset, gyro, strict=True), *zip(names.accel_offset, accel, strict=True)]
    # As the autopilot keeps them: the shift that is taken off again is that of the rounded values.
    return {name: float(np.float32(value)) for name, value in pairs}


def _with(window: ImuWindow, found: Dithered) -> ImuWindow:
    """Replace the hidden means of a window by dithered ones."""
    changes: dict[str, Vector] = {}
    for part, unit, rows in (("gyro", "rad_s", slice(0, 3)), ("accel", "m_s2", slice(3, 6))):
        if part in window.hidden:
            changes[f"{part}_{unit}"] = vector(found.mean[rows])
            changes[f"{part}_sigma_stat_{unit}"] = vector(found.sigma_stat[rows])
            changes[f"{part}_sigma_use_{unit}"] = vector(found.sigma_use[rows])
    return msgspec.structs.replace(window, hidden={}, dithered=True, **changes)
