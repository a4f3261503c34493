"""The calibration that people look at: biases with sigma an axis, in the units that pilots know, and its age."""

from __future__ import annotations

from companion.calibration.solution.record import ImuRecord, Record
from companion.daemon.arming.in_force import InForce
from companion.physics.units import DEG_H, MG
from companion.samples import Vector


def shown_calibration(in_force: InForce, last: Record | None, now_s: float) -> dict[str, object] | None:
    """The calibration in force, else the last one if that was good and has not been undone; None without either.

    `calibrated_ago_s` and `confirmed_ago_s` are null where that is not known to be in force: a wall clock that was
    wrong in the field tells no age.
    """
    record = in_force.calibration
    known = record is not None
    if record is None and last is not None and last.state == "done" and last.undone_at is None and not in_force.undone:
        record = last
    if record is None:
        return None
    calibrated_s, confirmed_s = in_force.calibrated_s, in_force.confirmed_s
    return {
        "in_force": known,
        "started_at": record.started_at,
        "calibrated_ago_s": round(now_s - calibrated_s, 1) if known and calibrated_s is not None else None,
        "confirmed_ago_s": round(now_s - confirmed_s, 1) if confirmed_s is not None else None,
        "imus": [_imu(imu, in_force.temperature_degc(imu.name)) for imu in record.imus],
    }


def _imu(imu: ImuRecord, now_degc: float | None) -> dict[str, object]:
    return {
        "name": imu.name,
        "temperature_degc": imu.temperature_degc,
        "temperature_now_degc": now_degc,
        "gyro_bias_deg_h": _scaled(imu.gyro_bias_rad_s, DEG_H, 2),
        "gyro_sigma_deg_h": _scaled(imu.gyro_sigma_use_rad_s, DEG_H, 2),
        "accel_bias_mg": _scaled(imu.accel_bias_m_s2, MG, 4),
        "accel_sigma_mg": _scaled(imu.accel_sigma_use_m_s2, MG, 4),
        "held_back": list(imu.held_back),
    }


def _scaled(axes: Vector | None, unit: float, decimals: int) -> list[float] | None:
    return None if axes is None else [round(value / unit, decimals) for value in axes]
