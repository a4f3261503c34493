"""From estimates to the record."""

from __future__ import annotations

import dataclasses
import datetime
from typing import Literal

import numpy as np

from companion.estimation.records.history import Point
from companion.estimation.records.record import (
    AlignmentUsed,
    CrossCovariance,
    ImuRecord,
    Record,
    Standing,
    WrittenParameter,
)
from companion.estimation.solution.doubt import Doubt
from companion.estimation.solution.solve import ImuSolution, Solution
from companion.physics.frames import Array, Matrix, vector
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import Triad, Vector


@dataclasses.dataclass(slots=True)
class Draft:
    """A record in the making: filled as the calibration proceeds, so that a failure keeps what was known."""

    started_at: datetime.datetime
    system_id: int | None = None
    solution: Solution | None = None
    whole: dict[str, tuple[Array | None, Array | None]] = dataclasses.field(default_factory=dict)
    """By IMU: whole gyro and accelerometer bias, where the owner of the IMU subtracts offsets already."""
    written: dict[str, dict[str, WrittenParameter]] = dataclasses.field(default_factory=dict)
    """By IMU: parameters."""
    warnings: list[str] = dataclasses.field(default_factory=list)
    measured_s: tuple[float, float] | None = None
    """Start and end of the window behind the solution, on the loop's clock."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """What belongs into the reason besides the figures."""
    alignment: AlignmentUsed | None = None
    """What was in force of the gradienter's alignment."""
    imu_warnings: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    device_ids: dict[str, tuple[int | None, int | None]] = dataclasses.field(default_factory=dict)
    """By IMU of the autopilot: gyro and accelerometer."""
    points: dict[str, Point] = dataclasses.field(default_factory=dict)
    """By IMU: what later calibrations may know of this one, once it has come to a good end."""

    held_back: dict[tuple[str, Triad], Doubt] = dataclasses.field(default_factory=dict)
    """By IMU and triad, what is not to be written, and why."""
    unchanged: set[tuple[str, Triad]] = dataclasses.field(default_factory=set)
    """By IMU and triad, whose output is right with the offsets that it has."""
    before: Record | None = None
    """The calibration before, if what it has found was good and has not been undone."""

    @property
    def started(self) -> str:
        """When it began: UTC, ISO 8601."""
        return self.started_at.isoformat(timespec="milliseconds")

    def warn(self, imu: str, *lines: str) -> None:
        """Add warnings to one IMU, each once."""
        warnings = self.imu_warnings.setdefault(imu, [])
        warnings += [words for words in dict.fromkeys(lines) if words not in warnings]

    def begin_again(self, why: str) -> None:
        """Forget what was found and written, but not why."""
        self.solution = self.measured_s = None
        self.whole.clear()
        self.written.clear()
        self.imu_warnings.clear()
        self.points.clear()
        self.held_back.clear()
        self.unchanged.clear()
        self.warnings.append(why)

    def record(self, state: Literal["done", "failed", "cancelled"], reason: str, duration_s: float) -> Record:
        """The finished record."""
        solution = self.solution
        return Record(
            state=state,
            reason=reason,
            warnings=(*(solution.warnings if solution else ()), *unseen_turn(solution), *self.warnings),
            started_at=self.started,
            duration_s=round(duration_s, 3),
            pose=solution.pose if solution else None,
            site=solution.site if solution else None,
            system_id=self.system_id,
            magnetic=solution.magnetic if solution else None,
            alignment=self.alignment,
            standing=_standing(solution) if solution else None,
            imus=tuple(self._imu(estimate) for estimate in solution.imus) if solution else (),
            cross_covariance=_cross(solution) if solution else (),
        )

    def _imu(self, estimate: ImuSolution) -> ImuRecord:
        owner_corrects = estimate.name in self.whole
        gyro, accel = self.whole.get(estimate.name, (estimate.gyro_rad_s, estimate.accel_m_s2))
        gyro_id, accel_id = self.device_ids.get(estimate.name, (None, None))
        has_gyro, has_accel = estimate.gyro_rad_s is not None, estimate.accel_m_s2 is not None
        return ImuRecord(
            name=estimate.name,
            samples=estimate.samples,
            temperature_degc=estimate.temperature_degc,
            gyro_bias_rad_s=_axes(gyro),
            gyro_sigma_stat_rad_s=_axes(estimate.sigma_stat[:3] if has_gyro else None),
            gyro_sigma_use_rad_s=_axes(estimate.gyro_sigma_use_rad_s if has_gyro else None),
            accel_bias_m_s2=_axes(accel),
            accel_sigma_stat_m_s2=_axes(estimate.sigma_stat[3:] if has_accel else None),
            accel_sigma_use_m_s2=_axes(estimate.accel_sigma_use_m_s2 if has_accel else None),
            covariance=_where_known(estimate.use_covariance, _known(estimate), _known(estimate)),
            gyro_sigma_warm_up_rad_s=_axes(np.sqrt(estimate.warm_up_variance[:3]) if has_gyro else None),
            accel_sigma_warm_up_m_s2=_axes(np.sqrt(estimate.warm_up_variance[3:]) if has_accel else None),
            residual_gyro_rad_s=_axes(estimate.gyro_rad_s if owner_corrects else None),
            residual_accel_m_s2=_axes(estimate.accel_m_s2 if owner_corrects else None),
            warnings=(*estimate.warnings, *estimate.drifting, *self.imu_warnings.get(estimate.name, ())),
            written=self.written.get(estimate.name, {}),
            prior=estimate.prior,
            effective=estimate.effective,
            when_warm=estimate.when_warm,
            held_back=tuple(triad for name, triad in self.held_back if name == estimate.name),
            gyro_id=gyro_id,
            accel_id=accel_id,
            unchanged=tuple(sorted(triad for name, triad in self.unchanged if name == estimate.name)),
        )


def _axes(values: Array | None) -> Vector | None:
    return None if values is None else vector(values)


def _standing(solution: Solution) -> Standing:
    turn, told = solution.turn, solution.turn.is_told
    return Standing(
        platform=solution.platform,
        turn_deg_s=round(turn.rate_rad_s / DEG, 6) if told else None,
        turn_sigma_deg_s=round(turn.sigma_rad_s / DEG, 6) if told else None,
        told_by=turn.by if told else None,
    )


def unseen_turn(solution: Solution | None) -> tuple[str, ...]:
    """What a pilot without a compass should know: a platform that has turned from the start looks still."""
    if solution is None or solution.platform == "deck" or all(imu.gyro_rad_s is None for imu in solution.imus):
        return ()
    turn = solution.turn
    if not turn.is_told:
        return ("no compass: nothing saw whether the ground turns",)
    if turn.by == "earlier calibrations" and not turn.is_chance:
        return (f"the aircraft {turn.in_words}, or its gyros are unlike in earlier power-ups: sigma widened",)
    return ()


def when_warm(solution: Solution) -> list[str]:
    """What the biases will be when it is warm, where that is known and worth saying."""
    return [words for imu in solution.imus if imu.when_warm is not None for words in imu.when_warm.words]


def _known(imu: ImuSolution) -> list[bool]:
    return [imu.gyro_rad_s is not None] * 3 + [imu.accel_m_s2 is not None] * 3


def _cross(solution: Solution) -> tuple[CrossCovariance, ...]:
    known = {imu.name: _known(imu) for imu in solution.imus}
    found = {pair: _where_known(matrix, *(known[name] for name in pair)) for pair, matrix in solution.cross.items()}
    return tuple(CrossCovariance(imus=pair, covariance=matrix) for pair, matrix in found.items() if matrix is not None)


def _where_known(matrix: Matrix, rows: list[bool], columns: list[bool]) -> tuple[tuple[float | None, ...], ...] | None:
    if not any(rows) or not any(columns):
        return None
    return tuple(tuple(float(matrix[i, j]) if rows[i] and columns[j] else None for j in range(6)) for i in range(6))


def in_words(draft: Draft) -> str:
    """The figures of a result: the largest sigma over axes and IMUs; short enough for one STATUSTEXT."""
    solution = draft.solution
    if solution is None:
        return "nothing measured"
    parts: list[str] = []
    imus = draft.record("done", "", 0.0).imus
    gyros = [sigma for imu in imus if (sigma := imu.sigma_in_force("gyro")) is not None]
    accels = [sigma for imu in imus if (sigma := imu.sigma_in_force("accel")) is not None]
    if gyros:
        # Without decimals, so that it stays one STATUSTEXT.
        sigma_deg_h = np.max(gyros) / DEG_H
        parts.append(f"{sigma_deg_h:.0f} deg/h warming" if _warms(solution) else f"{sigma_deg_h:.1f} deg/h")
    if accels:
        parts.append(f"{np.max(accels) / MG:.2f} mg")
    unknown = ", ".join(f"{triad} {name}" for name, triad in solution.unknown)
    begin = "unchanged," if draft.unchanged and not any(draft.written.values()) else "sigma"
    return f"{begin} {', '.join(parts)}{f'; not known: {unknown}' if unknown else ''}"


def _warms(solution: Solution) -> bool:
    """Whether the gyros' sigma is that of a warm-up above all."""
    gyros = [imu for imu in solution.imus if imu.gyro_rad_s is not None]
    worst = max(gyros, key=lambda imu: float(imu.gyro_sigma_use_rad_s.max()))
    return bool(worst.warm_up_variance[:3].max() > np.diag(worst.covariance)[:3].max())
