"""The record of one alignment: the gradienter's zero, what it belongs to, and what else the stands told.

Its keys are a surface that others rely on, like the calibration's. What is unknown is None, never zero.
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from companion.calibration.alignment.align import Alignment, Figures, ImuAlignment
from companion.calibration.alignment.align_model import Stand
from companion.physics.frames import Array, roll_pitch_from_up, vector
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import Vector

FORMAT_VERSION = 1
MOST_DEG = 90.0
"""Of a gradienter's zero and of its sigma."""

Pair = tuple[float, float]
Kind = Literal["zero", "tilts"]


class GradienterSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The gradienter that an alignment belongs to, as configured when it was measured."""

    port: str
    protocol: str
    law: str
    mounting: str | Vector
    offset_deg: Pair


class Determined(msgspec.Struct, frozen=True, kw_only=True):
    """Three figures, one sigma each; `known`: the stands determine it, else it is little more than was known before."""

    value: Vector
    sigma: Vector
    known: tuple[bool, bool, bool]


class ImuAlignmentRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU, vehicle FRD. Of an autopilot's IMU all is of its output, from which it has taken its own offsets."""

    name: str
    temperature_degc: float | None
    level_bias_mg: Vector
    """The effective accelerometer bias when level: what a calibration there finds."""
    level_sigma_mg: Vector
    accel_bias_mg: Determined
    """Without scale, shear and misalignment, each of which looks like a bias in one pose."""
    accel_scale: Determined
    accel_shear: Determined
    """xy, xz, yz."""
    misalignment_deg: Determined
    """Small rotation from the gradienter's axes to this IMU's."""
    gyro_bias_deg_h: Determined


class StandRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One still window, as it was measured."""

    x_deg: float | None
    """The gradienter's own readings."""
    y_deg: float | None
    roll_deg: float
    """With the zero that was found."""
    pitch_deg: float
    heading_deg: float
    on_spot: bool
    seconds: float


class AlignmentRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A finished alignment."""

    format_version: int = FORMAT_VERSION
    kind: Kind
    measured_at: str
    """UTC, ISO 8601; the host's clock."""
    gradienter: GradienterSettings
    offset_deg: Pair
    """What the gradienter shows too much, on top of `gradienter.offset_deg`."""
    sigma_deg: float
    """Of both axes: the larger."""
    covariance_deg2: tuple[Pair, Pair]
    slope_deg: float
    """Of the spot."""
    checked: bool
    """Whether a spot that moved between the stands would have been noticed."""
    chi_square: float
    freedom: int
    temperature_degc: float | None
    """Of the gradienter."""
    stands: tuple[StandRecord, ...]
    imus: tuple[ImuAlignmentRecord, ...]
    warnings: tuple[str, ...] = ()


def check(record: AlignmentRecord) -> None:
    """Whether a record can be used.

    Raises:
        msgspec.ValidationError: figures that no gradienter has.
    """
    figures = [*record.offset_deg, record.sigma_deg]
    if not np.abs(figures).max() < MOST_DEG or record.sigma_deg <= 0.0:
        raise msgspec.ValidationError(f"offset and sigma {figures} cannot be")


def stand_record(stand: Stand, result: Alignment, number: int, seconds: float, configured: Pair) -> StandRecord:
    """One stand as it turned out; `number` counts from 0."""
    attitude = result.attitudes[number]
    roll, pitch = roll_pitch_from_up(-attitude[:, 2])
    tilt = stand.tilt_deg
    return StandRecord(
        x_deg=None if tilt is None else round(tilt[0] + configured[0], 5),
        y_deg=None if tilt is None else round(tilt[1] + configured[1], 5),
        roll_deg=round(roll / DEG, 4),
        pitch_deg=round(pitch / DEG, 4),
        heading_deg=round(float(np.degrees(np.arctan2(attitude[0, 1], attitude[0, 0]))) % 360.0, 2),
        on_spot=stand.on_spot,
        seconds=seconds,
    )


def imu_record(imu: ImuAlignment, temperature_degc: float | None) -> ImuAlignmentRecord:
    """One IMU in the units that people know."""
    return ImuAlignmentRecord(
        name=imu.name,
        temperature_degc=temperature_degc,
        level_bias_mg=_axes(imu.level_bias_m_s2 / MG),
        level_sigma_mg=_axes(np.sqrt(np.diag(imu.level_covariance_m2_s4)) / MG),
        accel_bias_mg=determined(imu.accel_bias_m_s2, MG),
        accel_scale=determined(imu.scale, 1.0),
        accel_shear=determined(imu.shear, 1.0),
        misalignment_deg=determined(imu.misalignment_rad, DEG),
        gyro_bias_deg_h=determined(imu.gyro_bias_rad_s, DEG_H),
    )


def determined(figures: Figures, unit: float) -> Determined:
    """In another unit, rounded."""
    x, y, z = (bool(one) for one in figures.determined)
    return Determined(value=_axes(figures.value / unit), sigma=_axes(figures.sigma / unit), known=(x, y, z))


def _axes(values: Array) -> Vector:
    return vector(np.round(values, 7))
