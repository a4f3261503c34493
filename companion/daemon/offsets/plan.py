"""Planned parameter changes of one write of offsets, and the log of their outcomes."""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.base import SlotMemory
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.px4 import warnings_about
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.gyro_calibration import GyroOutcome
from companion.errors import AutopilotError
from companion.estimation.records.record import ImuRecord, Outcome, WrittenParameter
from companion.estimation.records.validity import RESIDUAL_SIGMAS
from companion.estimation.solution.solve import ImuSolution, Shared
from companion.messages import message
from companion.physics.frames import Array
from companion.physics.units import MG
from companion.samples import TRIADS, Triad, rows_of

COARSE_ACCEL_MG: Final = 5.0
"""Sigma above which new accelerometer offsets cause a warning: autopilots' own level calibrations reach this sigma."""

AS_GOOD: Final = 1.5
"""Largest error of old offsets, in units of the new offsets' expected error, that is not worth the flash's wear."""


@dataclasses.dataclass(slots=True)
class WriteLog:
    """Log of one run: parameters written, by IMU and name, and warnings; after a failure, those up to the failure."""

    started_at: datetime.datetime = dataclasses.field(default_factory=lambda: datetime.datetime.now(tz=datetime.UTC))
    written: dict[str, dict[str, WrittenParameter]] = dataclasses.field(default_factory=dict)
    warnings: list[str] = dataclasses.field(default_factory=list)
    imu_warnings: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)  # Texts added to the result of the run

    @property
    def started(self) -> str:
        return self.started_at.isoformat(timespec="milliseconds")

    @property
    def all_warnings(self) -> tuple[str, ...]:
        return (*self.warnings, *(words for each in self.imu_warnings.values() for words in each))

    def warn(self, imu: str, *lines: str) -> None:
        warnings = self.imu_warnings.setdefault(imu, [])
        warnings += [words for words in dict.fromkeys(lines) if words not in warnings]


Residual = tuple[Array | None, Array | None]
"""IMU output error that a write removes: gyro (rad/s), accelerometer (m/s^2); x y z, vehicle FRD; None: not written."""


@dataclasses.dataclass(frozen=True, slots=True)
class ImuPlan:
    name: str
    calibration: ImuCalibration
    changes: tuple[Change, ...]
    residual: Residual
    watched: bool
    """True if the telemetry contains this IMU's output, so that the effect of the write can be checked."""
    unseen: tuple[Change, ...] = ()
    """Changes that together leave the IMU's output unchanged, so that telemetry cannot show them."""

    @property
    def all(self) -> tuple[Change, ...]:
        return (*self.changes, *self.unseen)


@dataclasses.dataclass(frozen=True, slots=True)
class Plan:
    targets: tuple[ImuPlan, ...]
    boots: int
    """Number of autopilot restarts seen when the plan was made; a later one shows as a larger number."""
    collateral: tuple[Change, ...] = ()
    """Changes made by the firmware's own gyro calibration: offsets, temperatures and ids of gyros outside the plan."""
    firmware: GyroOutcome | None = None  # Outcome of the firmware's gyro calibration; None: not used

    @property
    def changes(self) -> tuple[Change, ...]:
        return tuple(change for target in self.targets for change in target.all)

    @property
    def gyros(self) -> tuple[Change, ...]:
        return tuple(
            change
            for target in self.targets
            for change in target.changes
            if change.parameter in target.calibration.parameters.gyro_offset
        )

    def note(self, log: WriteLog, written: Mapping[str, WrittenParameter]) -> None:
        for target in self.targets:
            kept = log.written.setdefault(target.name, {})
            kept.update({c.parameter: written[c.parameter] for c in target.all if c.parameter in written})

    def mark(self, log: WriteLog, parameters: Collection[str], outcome: Outcome) -> None:
        for target in self.targets:
            kept = log.written.get(target.name, {})
            for name in kept.keys() & set(parameters):
                kept[name] = msgspec.structs.replace(kept[name], outcome=outcome)


def warnings_of(target: ImuPlan, estimate: ImuSolution) -> list[str]:
    name, found = target.name, list[str]()
    coarse_mg = math.sqrt(np.diag(estimate.covariance)[3:].max()) / MG if estimate.accel_m_s2 is not None else 0.0
    if coarse_mg > COARSE_ACCEL_MG:
        found.append(message("accelerometer_known_coarsely", imu=name, sigma=f"{coarse_mg:.0f}"))
    return [*found, *warnings_about(target.calibration, target.changes)]


def refuse_shared(targets: Sequence[ImuPlan], memory: SlotMemory) -> None:
    """If two IMUs seem to use the same PX4 parameters, forget the learned slots, and raise AutopilotError."""
    owners: dict[str, str] = {}
    for target in targets:
        for name in (*target.calibration.parameters.gyro_offset, *target.calibration.parameters.accel_offset):
            other = owners.setdefault(name, target.name)
            if other != target.name:
                memory.forget()
                effect = f"seem to be shared by IMU {other} and {target.name}: calibrate again"
                raise AutopilotError(message("px4_slot_unclear", slot=name, effect=effect))


def as_good(
    calibration: ImuCalibration, found: ImuSolution, shared: Shared, before: ImuRecord | None
) -> frozenset[Triad]:
    """Return the triads (gyro, accelerometer) whose old offsets are as good as new ones: a write would only add noise.

    Old offsets are as good if the last calibration wrote them and the residual is small: within the errors of both
    estimates, or small compared with the drift of the next minutes, which affects old and new offsets alike.
    """
    if before is None:
        return frozenset()
    names, written = calibration.parameters, {name: one.after for name, one in before.written.items()}
    variance, kept = np.diag(found.covariance), set[Triad]()
    estimated = np.minimum(np.square(found.sigma_stat) + np.diag(shared.covariance), variance)
    for triad, residual, offsets in zip(TRIADS, found.biases, (names.gyro_offset, names.accel_offset), strict=True):
        then, averaged = before.sigma_in_force(triad), before.of(triad).sigma_stat
        # The autopilot itself regards an IMU without offsets as uncalibrated, so write them.
        if residual is None or then is None or not any(calibration.offsets[name] for name in offsets):
            continue
        if triad == "accel" and calibration.accel_offset_may_be_unused:
            continue
        # The offsets were replaced, for instance by the autopilot's own calibration at its start.
        if calibration.contradicts({name: written[name] for name in offsets if name in written}):
            continue
        rows = rows_of(triad)
        both = estimated[rows] + np.square(np.zeros(3) if averaged is None else averaged)
        most = np.maximum(RESIDUAL_SIGMAS**2 * both, (AS_GOOD**2 - 1.0) * variance[rows])
        if (np.square(residual) <= most).all() and (np.asarray(then) <= AS_GOOD * np.sqrt(variance[rows])).all():
            kept.add(triad)
    return frozenset(kept)


def without(found: ImuSolution, triads: Collection[Triad]) -> ImuSolution:
    return dataclasses.replace(
        found,
        gyro_rad_s=None if "gyro" in triads else found.gyro_rad_s,
        accel_m_s2=None if "accel" in triads else found.accel_m_s2,
    )


def residual_of_consumer(calibration: ImuCalibration, found: ImuSolution) -> Residual:
    """Return the error that the autopilot sees of the companion's own IMU after subtracting its present offsets."""
    rotation, scale = calibration.orientation, np.asarray(calibration.accel_scale)
    gyro = accel = None
    if found.gyro_rad_s is not None:
        gyro = found.gyro_rad_s - rotation @ np.asarray(calibration.gyro_offset_rad_s)
    if found.accel_m_s2 is not None:
        board = rotation.T @ found.accel_m_s2
        accel = rotation @ (scale * (board - np.asarray(calibration.accel_offset_m_s2)))
    return gyro, accel
