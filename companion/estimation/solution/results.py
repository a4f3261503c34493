"""Conversion of estimated biases to a calibration record, to points of the bias history, and to text."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from companion.estimation.records.history import MeasuredBias, Point, PowerUp
from companion.estimation.records.record import ImuRecord, PlatformTurn, Record, sigma_texts
from companion.estimation.solution.doubt import Inconsistency
from companion.estimation.solution.solve import ImuSolution, Solution
from companion.messages import message
from companion.physics.frames import Array, Matrix, vector
from companion.physics.units import DEG
from companion.samples import TRIADS, Triad, Vector, rows_of


def record_of(
    solution: Solution | None,
    started_at: datetime.datetime,
    duration_s: float,
    *,
    state: Literal["done", "failed", "cancelled"] = "done",
    reason: str | None = None,
    warnings: Sequence[str] = (),
    imus: Sequence[ImuRecord] | None = None,
) -> Record:
    """Build the calibration record of a solution; without a solution the record has no IMUs.

    Without `reason`, the record has a summary of the figures. `imus` replaces the IMU records made from the solution.
    """
    imus = imu_records(solution) if imus is None else tuple(imus)
    standing = None
    if solution is not None:
        turn = solution.turn if solution.turn.is_told else None
        standing = PlatformTurn(
            platform=solution.platform,
            turn_deg_s=None if turn is None else round(turn.rate_rad_s / DEG, 6),
            turn_sigma_deg_s=None if turn is None else round(turn.sigma_rad_s / DEG, 6),
            told_by=None if turn is None else turn.by,
        )
    return Record(
        state=state,
        reason=in_words(solution, imus) if reason is None else reason,
        warnings=tuple(warnings) if solution is None else (*solution.warnings, *unseen_turn(solution), *warnings),
        started_at=started_at.isoformat(timespec="milliseconds"),
        duration_s=round(duration_s, 3),
        pose=None if solution is None else solution.pose,
        site=None if solution is None else solution.site,
        magnetic=None if solution is None else solution.magnetic,
        standing=standing,
        imus=imus,
    )


def imu_records(solution: Solution | None) -> tuple[ImuRecord, ...]:
    return () if solution is None else tuple(_imu(imu) for imu in solution.imus)


def _imu(estimate: ImuSolution) -> ImuRecord:
    (gyro, accel), is_corrected = estimate.whole, estimate.subtracted is not None
    has_gyro, has_accel = gyro is not None, accel is not None
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
        covariance=_where_known(estimate.use_covariance, [has_gyro] * 3 + [has_accel] * 3),
        gyro_sigma_warm_up_rad_s=_axes(np.sqrt(estimate.warm_up_variance[:3]) if has_gyro else None),
        accel_sigma_warm_up_m_s2=_axes(np.sqrt(estimate.warm_up_variance[3:]) if has_accel else None),
        residual_gyro_rad_s=_axes(estimate.gyro_rad_s if is_corrected else None),
        residual_accel_m_s2=_axes(estimate.accel_m_s2 if is_corrected else None),
        warnings=(*estimate.warnings, *estimate.drifting),
        prior=estimate.prior,
        effective=estimate.effective,
        when_warm=estimate.when_warm,
    )


def _axes(values: Array | None) -> Vector | None:
    return None if values is None else vector(values)


def unseen_turn(solution: Solution) -> tuple[str, ...]:
    if solution.platform == "deck" or all(imu.gyro_rad_s is None for imu in solution.imus):
        return ()
    turn = solution.turn
    if not turn.is_told:
        return (message("ground_turn_unseen"),)
    if turn.by == "earlier calibrations" and not turn.is_chance:
        return (message("turns_or_gyros_changed", turns=turn.in_words),)
    return ()


def _where_known(matrix: Matrix, known: list[bool]) -> tuple[tuple[float | None, ...], ...] | None:
    if not any(known):
        return None
    return tuple(tuple(float(matrix[i, j]) if known[i] and known[j] else None for j in range(6)) for i in range(6))


def in_words(solution: Solution | None, imus: Sequence[ImuRecord]) -> str:
    """Summarise a result for one STATUSTEXT: the largest sigma over all axes of `imus`."""
    if solution is None:
        return "nothing measured"
    known = ([max(sigma) for imu in imus if (sigma := imu.sigma_in_force(triad)) is not None] for triad in TRIADS)
    gyro, accel = (max(sigmas, default=None) for sigmas in known)
    warms = False
    if gyro is not None:
        names = {imu.name for imu in imus}
        measured = [imu for imu in solution.imus if imu.name in names and imu.gyro_rad_s is not None]
        worst = max(measured, key=lambda imu: float(imu.gyro_sigma_use_rad_s.max()))
        warms = worst.warm_up_variance[:3].max() > np.diag(worst.covariance)[:3].max()
    unknown = ", ".join(f"{triad} {name}" for name, triad in solution.unknown)
    kept = any(imu.unchanged for imu in imus) and not any(imu.written for imu in imus)
    begin = "unchanged," if kept else "sigma"
    result = f"{begin} {', '.join(sigma_texts(gyro, accel, ' warming' if warms else ''))}"
    return message("biases_not_known", result=result, biases=unknown) if unknown else result


def points(
    solution: Solution,
    doubts: Iterable[Inconsistency],
    *,
    started_at: str,
    unix_s: float,
    power_ups: Mapping[str, PowerUp],
    zero: str | None,
) -> dict[str, Point]:
    """Make each IMU's point of the bias history, from the readings alone; triads in `doubts` are marked as suspect."""
    shared = solution.shared
    doubted = {(doubt.triad, name) for doubt in doubts for name in doubt.names}
    common = np.diag(shared.covariance).copy()
    common[3:] = np.maximum(common[3:] - np.diag(shared.by_zero @ shared.by_zero.T), 0.0)

    def measured(imu: ImuSolution, triad: Triad) -> MeasuredBias | None:
        bias = imu.whole[TRIADS.index(triad)]
        if bias is None:
            return None
        part = rows_of(triad)
        return MeasuredBias(
            bias=_short(bias if imu.warming is None else bias - imu.warming.ahead(triad)),
            sigma_stat=_short(imu.sigma_stat[part]),
            sigma_use=_short(np.sqrt(imu.own_variance(shared)[part])),
            sigma_shared=_short(np.sqrt(common[part])),
            suspect=(triad, imu.name) in doubted,
        )

    return {
        imu.name: Point(
            started_at=started_at,
            unix_s=unix_s,
            power_up=power_ups[imu.name],
            temperature_degc=imu.mean_degc,
            k_s=imu.k_s,
            up=_short(shared.up),
            zero=zero if imu.accel_m_s2 is not None else None,
            zero_sigma_rad=shared.zero_sigma_rad,
            gyro=measured(imu, "gyro"),
            accel=measured(imu, "accel"),
        )
        for imu in solution.imus
    }


def _short(values: Array) -> Vector:
    return vector(np.round(values, 9))
