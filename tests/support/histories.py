"""Records of an aircraft whose biases are known: what pages are made of."""

from __future__ import annotations

import datetime
import math
import random
from pathlib import Path

import msgspec
import numpy as np

from companion.estimation.records.history import MeasuredBias, Point, PowerUp, kept
from companion.estimation.records.record import (
    ArmingRecord,
    ImuRecord,
    Pose,
    PoseSigma,
    Record,
    SiteRecord,
    WrittenParameter,
)
from companion.physics.frames import Array
from companion.physics.units import DEG_H, MG
from companion.samples import Vector
from companion.storage.records import RecordStore
from companion.storage.state import write_atomically

FIRST = datetime.datetime(2026, 5, 1, 6, 30, tzinfo=datetime.UTC)
GYRO_DEG_H = (162.234, 169.563, -98.289)
ACCEL_MG = (2.4125, -2.1596, 0.89809)
PER_K_DEG_H = (1.5, -0.8, 0.3)
SLOPES_DEG_H_K = (30.0, -12.0, 0.0)
OFFSET_DEG_H = 5.0
"""Offset of a power-up, one sigma."""


def _axes(values: object) -> Vector:
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z


def imu_record(
    name: str = "fc", seed: int = 0, temperature_degc: float | None = 25.0, *, written: bool = True
) -> ImuRecord:
    """One IMU, its bias moved by the temperature and by chance."""
    rng = np.random.default_rng(seed)
    warmer = 0.0 if temperature_degc is None else temperature_degc - 25.0
    gyro = (np.add(GYRO_DEG_H, np.multiply(PER_K_DEG_H, warmer)) + rng.normal(0.0, 3.0, 3)) * DEG_H
    accel = (np.array(ACCEL_MG) + rng.normal(0.0, 0.05, 3)) * MG
    changes = {
        f"INS_GYROFFS_{axis}": WrittenParameter(
            before=0.00012345, after=float(np.float32(value)), read_back=float(np.float32(value)), outcome="verified"
        )
        for axis, value in zip("XYZ", gyro, strict=True)
    } | {
        f"INS_ACCOFFS_{axis}": WrittenParameter(
            before=None if axis == "Z" else -0.0123456,
            after=float(np.float32(value)),
            read_back=float(np.float32(value)),
            outcome="stored" if axis == "Z" else "verified",
        )
        for axis, value in zip("XYZ", accel, strict=True)
    }
    sigma_gyro, sigma_accel = np.array([3.4, 3.6, 3.5]) * DEG_H, np.array([0.11, 0.12, 0.05]) * MG
    return ImuRecord(
        name=name,
        samples=3000,
        temperature_degc=temperature_degc,
        gyro_bias_rad_s=_axes(gyro),
        gyro_sigma_stat_rad_s=_axes(sigma_gyro * 0.3),
        gyro_sigma_use_rad_s=_axes(sigma_gyro),
        accel_bias_m_s2=_axes(accel),
        accel_sigma_stat_m_s2=_axes(sigma_accel * 0.08),
        accel_sigma_use_m_s2=_axes(sigma_accel),
        covariance=None,
        residual_gyro_rad_s=_axes(gyro * 0.1) if written else None,
        residual_accel_m_s2=_axes(accel * 0.1) if written else None,
        written=changes if written else {},
    )


def record(
    number: int = 0,
    *,
    state: str = "done",
    reason: str = "sigma 3.6 deg/h, 0.12 mg",
    temperature_degc: float | None = 25.0,
    imus: tuple[ImuRecord, ...] | None = None,
    system_id: int | None = 1,
    started_at: str | None = None,
    warnings: tuple[str, ...] = (),
) -> Record:
    """One calibration; number k began 5 hours after number k - 1."""
    known = state == "done"
    if imus is None:
        fc = imu_record("fc", number, temperature_degc)
        own = imu_record("own", number + 1000, temperature_degc, written=False)
        imus = (fc, own) if known else ()
    began = (FIRST + number * datetime.timedelta(hours=5)).isoformat(timespec="milliseconds")
    return Record(
        state=state,  # type: ignore[arg-type]
        reason=reason,
        warnings=warnings,
        started_at=started_at or began,
        duration_s=41.3,
        pose=Pose(theta_deg=5.02, gamma_deg=-2.98, psi_deg=40.3, sigma_deg=PoseSigma(theta=0.005, gamma=0.005, psi=1.1))
        if known
        else None,
        site=SiteRecord(
            latitude_deg=40.0, height_m=50.0, gravity_m_s2=9.80154, declination_deg=-7.11, source="configuration"
        )
        if known
        else None,
        imus=imus,
        system_id=system_id,
    )


def arming(of: Record, *, good: bool = True) -> ArmingRecord:
    """An arming three minutes after that calibration began."""
    at = datetime.datetime.fromisoformat(of.started_at) + datetime.timedelta(minutes=3)
    return ArmingRecord(
        armed_at=at.isoformat(timespec="milliseconds"),
        state="calibrated" if good else "uncalibrated",
        reason="calibrated 3 min ago, sigma 3.6 deg/h, 0.12 mg" if good else "last calibration failed",
        at_arm="warn",
        calibration=of.started_at if good else None,
        calibrated_ago_s=180.0 if good else None,
        confirmed_ago_s=5.0 if good else None,
        gyro_sigma_use_rad_s=3.6 * DEG_H if good else None,
        accel_sigma_use_m_s2=0.12 * MG if good else None,
    )


def a_season(directory: Path, number: int = 30) -> list[Record]:
    """Fill a storage folder: temperatures from 8 to 31 degC, every seventh one failed, some armings."""
    directory.mkdir(parents=True, exist_ok=True)
    store, records, armings = RecordStore(directory), [], []
    rng = np.random.default_rng(3)
    for k in range(number):
        if k % 7 == 3:
            made = record(
                k,
                state="failed",
                reason="not finished in the time given: hold still: gyro fc moves 0.31 deg/s, max 0.10",
            )
        elif k % 11 == 5:
            made = record(k, state="cancelled", reason="cancelled by companion cancel")
        else:
            made = record(k, temperature_degc=round(float(rng.uniform(8.0, 31.0)), 2))
        store.save(made)
        records.append(made)
        if k % 2 == 0:
            armings.append(arming(made, good=made.state == "done"))
    write_atomically(directory / "armings.json", msgspec.json.encode(armings))
    return records


def gyro_deg_h_at(degc: float) -> Array:
    """Gyro biases of `windows_of_days` at a temperature without the offset of each power-up, (3,)."""
    return np.array([100.0, -50.0, 0.0]) + np.array(SLOPES_DEG_H_K) * (degc - 20.0)


def windows_of_days(days: int, windows: int = 3, *, step_k: float = 3.0) -> list[Point]:
    """One power-up a day, each somewhat warmer than that before, of a gyro that follows a line."""
    random, found = np.random.default_rng(2), []
    for day in range(days):
        power_up = PowerUp(host=f"boot {day}", since_unix_s=1.78e9 + 86400.0 * day)
        offset = random.normal(0.0, OFFSET_DEG_H, 3)
        for k in range(windows):
            degc = 8.0 + step_k * day + 1.5 * k
            gyro = _measured((gyro_deg_h_at(degc) + offset) * DEG_H, 2.0 * DEG_H)
            found.append(
                Point(
                    started_at="", unix_s=1.78e9 + 86400.0 * day + 100.0 * (k + 1), power_up=power_up,
                    temperature_degc=degc, up=(0.0, 0.0, -1.0), gyro=gyro,
                    accel=_measured(np.array([2.0, -2.0, 0.01 * degc]) * MG, 0.1 * MG),
                )
            )  # fmt: skip
    return found


def _measured(bias: Array, sigma: float) -> MeasuredBias:
    each = (sigma, sigma, sigma)
    x, y, z = bias.tolist()
    return MeasuredBias(bias=(x, y, z), sigma_stat=each, sigma_use=each, sigma_shared=(0.0, 0.0, 0.0))


def _triad(dice: random.Random, scale: float) -> MeasuredBias:

    def axes(sigma: float) -> Vector:
        x, y, z = (round(dice.uniform(0.1, 1.0) * sigma, 9) for _ in "xyz")
        return x, y, z

    return MeasuredBias(
        bias=axes(-scale), sigma_stat=axes(scale / 100), sigma_use=axes(scale / 50), sigma_shared=axes(scale / 60)
    )


def _day(number: int, dice: random.Random) -> list[Point]:
    """A warm-up of eight kelvin and more, colder in winter."""
    return [
        Point(
            started_at="" if step else f"2026-11-23T10:{step:02}:00.123456+00:00",
            unix_s=1.7e9 + 86400.0 * number + 30.123456 * step,
            power_up=PowerUp(host=f"{dice.getrandbits(128):032x}", since_unix_s=1.7e9 + 86400.0 * number + 0.1),
            temperature_degc=15.0 + 12.345678 * math.sin(number / 58.1) + 2.0 * step,
            k_s=dice.random() / 50.0,
            up=(0.087155743, -0.052335956, -0.994822123),
            zero="inclinometer_xy axis 0 90 0 0.123456 -0.0987654 2026-11-23T10:34:56.123456+00:00",
            zero_sigma_rad=dice.random() / 1000.0,
            gyro=_triad(dice, 1e-2),
            accel=_triad(dice, 1.0),
        )
        for step in range(8)
    ]


def two_years() -> tuple[Point, ...]:
    """Points of one IMU after two years of daily sessions."""
    dice = random.Random(1)
    points: tuple[Point, ...] = ()
    for first in range(0, 730, 73):
        points = kept((*points, *(point for number in range(first, first + 73) for point in _day(number, dice))))
    return points
