"""The record of an aircraft turned on its spot, without a gradienter; its keys are a surface that others rely on."""

from __future__ import annotations

from typing import Literal

import msgspec

from companion.calibration.alignment.align import ImuAlignment
from companion.calibration.records.align_record import Determined, StandRecord, imu_record
from companion.calibration.records.record import WrittenParameter
from companion.samples import Vector

FORMAT_VERSION = 1


class TurnImuRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU, vehicle FRD, of its output as it was."""

    name: str
    temperature_degc: float | None
    level_bias_mg: Vector
    """What the accelerometers of the aircraft read too much when its base is level."""
    level_sigma_mg: Vector
    gyro_bias_deg_h: Determined
    written: dict[str, WrittenParameter] = {}
    """Empty where nothing was to be written."""


class BoardRecord(msgspec.Struct, frozen=True, kw_only=True):
    """How the board sits against the base: what its attitude (roll right side down) shows too much on a level base."""

    imu: str
    """Whose accelerometers told; their bias and scale are known from all sides."""
    faces_measured_at: str
    roll_deg: float
    pitch_deg: float
    sigma_deg: tuple[float, float]
    written: dict[str, WrittenParameter] = {}


class TurnRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Finished; figures as in `AlignmentRecord`."""

    format_version: int = FORMAT_VERSION
    kind: Literal["turn"] = "turn"
    measured_at: str
    slope_deg: float
    checked: bool
    chi_square: float
    freedom: int
    stands: tuple[StandRecord, ...]
    imus: tuple[TurnImuRecord, ...]
    board: BoardRecord | None = None
    """None where nothing is known from all sides."""
    warnings: tuple[str, ...] = ()


def turn_imu_record(
    imu: ImuAlignment, temperature_degc: float | None, written: dict[str, WrittenParameter]
) -> TurnImuRecord:
    """One IMU in the units that people know."""
    told = msgspec.convert(imu_record(imu, temperature_degc), TurnImuRecord, from_attributes=True)
    return msgspec.structs.replace(told, written=written)
