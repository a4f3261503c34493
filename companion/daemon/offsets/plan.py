"""What is to be written: from biases to parameters and their new values."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.gyro_calibration import Outcome as FirmwareOutcome
from companion.autopilot.firmware.imu_calibration import ImuCalibration, changes_for, whole_of
from companion.autopilot.firmware.px4 import SlotMemory, warnings_about
from companion.autopilot.parameters.change import Change
from companion.autopilot.telemetry.imu_stream import StreamKind
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.offsets.rivalry import Rivalry
from companion.errors import AutopilotError
from companion.estimation.means.windows import ImuWindow
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.estimation.records.validity import RESIDUAL_SIGMAS
from companion.estimation.solution.draft import Draft
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.physics.frames import Array, vector
from companion.physics.units import MG
from companion.samples import Triad, Vector, rows_of

COARSE_ACCEL_MG: Final = 5.0
"""What the autopilots' own calibrations reach on a level table; a new offset known worse than that is worth a word."""

AS_GOOD: Final = 1.5
"""Offsets are as good as new ones up to this ratio of their expected errors: a write would better nothing worth its
wear."""


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
    read_m_s2: Vector = (0.0, 0.0, 0.0)
    """What its accelerometers read before; needed where scales are changed."""
    unseen: tuple[Change, ...] = ()
    """Changes that together leave the output as it is."""

    @property
    def all(self) -> tuple[Change, ...]:
        """In the order of writing."""
        return (*self.changes, *self.unseen)


@dataclasses.dataclass(frozen=True, slots=True)
class Plan:
    """What is to be changed."""

    targets: tuple[Target, ...]
    boots: int
    """How often the autopilot had rebooted when this was made."""
    collateral: tuple[Change, ...] = ()
    """What the firmware's own gyro calibration has changed besides: offsets, temperatures and ids of other gyros."""
    firmware: FirmwareOutcome | None = None
    """How that ended; None where it was not used."""

    @property
    def changes(self) -> tuple[Change, ...]:
        """All that we calibrate, in the order of writing."""
        return tuple(change for target in self.targets for change in target.all)

    @property
    def gyros(self) -> tuple[Change, ...]:
        """The gyros' part of it."""
        return tuple(
            change
            for target in self.targets
            for change in target.changes
            if change.parameter in target.calibration.parameters.gyro_offset
        )

    def note(self, draft: Draft, written: Mapping[str, WrittenParameter]) -> None:
        """Enter what became of the parameters."""
        for target in self.targets:
            kept = draft.written.setdefault(target.name, {})
            kept.update({c.parameter: written[c.parameter] for c in target.all if c.parameter in written})

    def mark(self, draft: Draft, parameters: Collection[str], outcome: Outcome) -> None:
        """Change what was entered of these."""
        for target in self.targets:
            kept = draft.written.get(target.name, {})
            for name in kept.keys() & set(parameters):
                kept[name] = msgspec.structs.replace(kept[name], outcome=outcome)

    @property
    def everything(self) -> tuple[Change, ...]:
        """All that has changed, in the order in which it did."""
        return (*self.collateral, *self.changes)


class Planner:
    """Works out what a solution means for the parameters of the autopilot."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], memory: SlotMemory, rivalry: Rivalry) -> None:
        self._vehicle, self._parameters, self._imus = core.vehicle, core.parameters, imus
        self._memory, self._rivalry, self._wanted = memory, rivalry, core.wanted
        self._sources = {imu.name: imu for imu in core.config.imu}

    async def plan(self, solution: Solution, draft: Draft, *, anyway: bool) -> Plan:
        """Work out which parameter gets which value; fills the draft's whole biases and warnings.

        Offsets of a calibration as good, under which the output is right, are not written again, unless `anyway`.

        Raises:
            AutopilotError: a parameter cannot be read, or the autopilot cannot be calibrated as it is.
            CalibrationRefusedError: what was found is no bias.
        """
        targets: list[Target] = []
        push = self._wanted.push  # may be switched while parameters are read: for all IMUs or for none
        for found in solution.imus:
            imu, source = self._imus.get(found.name), self._sources[found.name]
            whole, found = found, _to_be_written(found, draft)
            if imu is not None:
                calibration = imu.in_force
                draft.whole[found.name] = whole_of(calibration, whole)
                found = found if anyway or not push else _less_noise(calibration, found, solution.shared, draft)
                gyro, accel = found.gyro_rad_s, found.accel_m_s2
            elif source.autopilot_instance is not None:
                calibration = await read_calibration(self._parameters, source.autopilot_instance, self._memory)
                gyro, accel = _residual_of_consumer(calibration, found)
            else:
                continue
            draft.warn(found.name, *self._rivalry.left_of(calibration))
            changes = changes_for(
                calibration, None if gyro is None else vector(gyro), None if accel is None else vector(accel)
            )
            if push:
                coarse_mg = math.sqrt(np.diag(found.covariance)[3:].max()) / MG if accel is not None else 0.0
                if coarse_mg > COARSE_ACCEL_MG:
                    draft.warn(
                        found.name,
                        f"accel {found.name} is known to {coarse_mg:.0f} mg only: the gradienter is too coarse for it"
                        " (companion align, or calibrate --gyros)",
                    )
                draft.warn(found.name, *warnings_about(calibration, changes))
                kind = imu.stream.own_kind if imu is not None else None
                targets.append(Target(found.name, calibration, tuple(changes), found, kind, watched=imu is not None))
        self._refuse_shared(targets)
        if targets:
            stops = self._rivalry.changes([target.calibration for target in targets])
            # First of all, so that nobody acts between it and the biases; undone last.
            targets[0] = dataclasses.replace(targets[0], changes=(*stops, *targets[0].changes))
            for change in stops:
                draft.warn(targets[0].name, f"{change.parameter} is switched off; companion undo switches it on again")
        return Plan(tuple(targets), self._vehicle.boots)

    def _refuse_shared(self, targets: Sequence[Target]) -> None:
        """Two IMUs in one of PX4's slots: what was learned of the slots cannot be right.

        Raises:
            AutopilotError: so it is; what was learned is forgotten.
        """
        owners: dict[str, str] = {}
        for target in targets:
            for name in (*target.calibration.parameters.gyro_offset, *target.calibration.parameters.accel_offset):
                other = owners.setdefault(name, target.name)
                if other != target.name:
                    self._memory.forget()
                    raise AutopilotError(
                        f"imu {other} and imu {target.name} seem to share {name}, which cannot be; what was learned"
                        " about PX4's slots is forgotten; calibrate again"
                    )


def _to_be_written(found: ImuSolution, draft: Draft) -> ImuSolution:
    """What was found in one IMU, less what is held back."""
    return dataclasses.replace(
        found,
        gyro_rad_s=None if (found.name, "gyro") in draft.held_back else found.gyro_rad_s,
        accel_m_s2=None if (found.name, "accel") in draft.held_back else found.accel_m_s2,
    )


def _less_noise(calibration: ImuCalibration, found: ImuSolution, shared: Shared, draft: Draft) -> ImuSolution:
    """The solution of one IMU, less the half where the offsets in force are as good: to write would be noise.

    They are as good where the last calibration wrote them, and the residual is within the errors of both estimates or
    adds little to what the next minutes do to old and new offsets alike.
    """
    before = None if draft.before is None else next((imu for imu in draft.before.imus if imu.name == found.name), None)
    if before is None:
        return found
    names, written = calibration.parameters, {name: one.after for name, one in before.written.items()}
    variance, left = np.diag(found.covariance), {"gyro": found.gyro_rad_s, "accel": found.accel_m_s2}
    estimated = np.minimum(np.square(found.sigma_stat) + np.diag(shared.covariance), variance)
    halves: tuple[tuple[Triad, Sequence[str], Vector, Vector | None], ...] = (
        ("gyro", names.gyro_offset, calibration.gyro_offset_rad_s, before.gyro_sigma_stat_rad_s),
        ("accel", names.accel_offset, calibration.accel_offset_m_s2, before.accel_sigma_stat_m_s2),
    )
    for triad, offsets, offset, averaged in halves:
        residual, then = left[triad], before.sigma_in_force(triad)
        # What has no offsets counts as uncalibrated to the autopilot itself.
        if residual is None or then is None or not any(offset):
            continue
        if triad == "accel" and calibration.accel_offset_may_be_unused:
            continue
        # For instance by the autopilot's own calibration at its start.
        if calibration.contradicts({name: written[name] for name in offsets if name in written}):
            continue
        rows = rows_of(triad)
        both = estimated[rows] + np.square(np.zeros(3) if averaged is None else averaged)
        most = np.maximum(RESIDUAL_SIGMAS**2 * both, (AS_GOOD**2 - 1.0) * variance[rows])
        if (np.square(residual) <= most).all() and (np.asarray(then) <= AS_GOOD * np.sqrt(variance[rows])).all():
            draft.unchanged.add((found.name, triad))
            left[triad] = None
    return dataclasses.replace(found, gyro_rad_s=left["gyro"], accel_m_s2=left["accel"])


def left_in(imu: ImuWindow, gyro_rad_s: Array | None, accel_m_s2: Array | None) -> ImuSolution:
    """What is to be taken out of the output of an IMU that read so, where no calibration has worked it out."""
    sigma = np.concatenate([imu.gyro_sigma_use_rad_s, imu.accel_sigma_use_m_s2])
    return ImuSolution(
        name=imu.name,
        samples=imu.samples,
        temperature_degc=imu.temperature_degc,
        gyro_rad_s=gyro_rad_s,
        accel_m_s2=accel_m_s2,
        sigma_stat=np.array([*imu.gyro_sigma_stat_rad_s, *imu.accel_sigma_stat_m_s2]),
        covariance=np.diag(sigma**2),
        warnings=(),
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
