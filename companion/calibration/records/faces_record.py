"""The record of accelerometers measured in stands of any orientation.

Its keys are a surface that others rely on, like the alignment's.
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from companion.calibration.alignment.align import DETERMINED, Figures
from companion.calibration.alignment.faces import BIAS, PRIOR_BIAS_M_S2, PRIOR_SCALE, PRIOR_SHEAR, SCALE, SHEAR, Faces
from companion.calibration.records.align_record import Determined, determined
from companion.calibration.records.record import WrittenParameter
from companion.physics.units import MG
from companion.samples import Vector

FORMAT_VERSION = 1
SAME_START_S = 30.0
"""By how much two clocks run apart in weeks; a restart takes away at least all the time that it had been on."""


class FaceRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One stand: up in the aircraft's axes, forward, right, down."""

    up: Vector
    seconds: float


class Running(msgspec.Struct, frozen=True, kw_only=True):
    """Which run of a sensor it was; another one has other biases."""

    host: str
    """Which start of the companion computer, whose clock counts."""
    started_s: float
    """When the sensor's device started, on that clock."""
    up_s: float
    """For how long it had been on."""

    def is_same(self, other: Running) -> bool:
        """Whether the power has surely been on in between."""
        return self.host == other.host != "" and abs(self.started_s - other.started_s) < SAME_START_S


class FacesImuRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU, in its own axes, of its output as it was: what the autopilot takes off already is not in it."""

    name: str
    accel_id: int | None
    """The accelerometer's device id in the autopilot."""
    corrections: dict[str, float]
    """Offsets and scales in force meanwhile, by parameter."""
    temperature_degc: float | None
    running: Running | None = None
    """None where the device does not tell since when it has been on."""
    accel_bias_mg: Determined
    accel_scale: Determined
    accel_shear: Determined
    """xy, xz, yz; no firmware takes it off."""
    left_out: tuple[int, ...]
    """Stands, from 1, that do not fit the others."""
    scatter_mg: float
    """Rms by which the stands' readings, corrected, miss the length of gravity."""
    written: dict[str, WrittenParameter]
    """Empty where nothing was to be written."""


class FacesRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Finished."""

    format_version: int = FORMAT_VERSION
    kind: Literal["faces"] = "faces"
    measured_at: str
    gravity_m_s2: float
    stands: tuple[FaceRecord, ...]
    imus: tuple[FacesImuRecord, ...]
    warnings: tuple[str, ...] = ()


def check(record: FacesRecord) -> None:
    """Whether a record can be used.

    Raises:
        msgspec.ValidationError: figures that no accelerometer has.
    """
    for imu in record.imus:
        for found, most in ((imu.accel_bias_mg, 1e4), (imu.accel_scale, 0.5)):
            if not np.abs([*found.value, *found.sigma]).max() < most or min(found.sigma) <= 0.0:
                raise msgspec.ValidationError(f"bias or scale of {imu.name} cannot be")


def faces_imu_record(
    found: Faces,
    *,
    name: str,
    accel_id: int | None,
    corrections: dict[str, float],
    temperature_degc: float | None,
    running: Running | None,
) -> FacesImuRecord:
    """One IMU in the units that people know, before anything is written."""
    kept = [k for k in range(len(found.off_m_s2)) if k not in found.left_out]
    return FacesImuRecord(
        name=name,
        accel_id=accel_id,
        corrections=corrections,
        temperature_degc=temperature_degc,
        running=running,
        accel_bias_mg=_determined(found, BIAS, MG, PRIOR_BIAS_M_S2),
        accel_scale=_determined(found, SCALE, 1.0, PRIOR_SCALE),
        accel_shear=_determined(found, SHEAR, 1.0, PRIOR_SHEAR),
        left_out=tuple(k + 1 for k in found.left_out),
        scatter_mg=round(float(np.sqrt(np.mean(np.square(found.off_m_s2[kept])))) / MG, 4),
        written={},
    )


def _determined(found: Faces, part: slice, unit: float, before: float) -> Determined:
    sigma = found.sigma[part]
    return determined(Figures(found.figures[part], sigma, sigma < DETERMINED * before), unit)
