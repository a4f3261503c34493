"""ArduPilot's bias parameters: names, sign, order, frame, and what is sane to write.

Per sample ArduPilot computes, with R its board orientation (autopilots 1.2):

    gyro  = R (raw - GYROFFS)
    accel = R diag(ACCSCAL) (raw - ACCOFFS)

so offsets live in the board's own axes, before scale and before rotation. The temperature calibration, where one is
active, takes its part off `raw` first; `CALTEMP` is left alone, for then new = old + residual holds (recipe (a) of
autopilots 1.6). AHRS_TRIM turns the reported attitude only, never IMU data.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from companion.autopilot.board_rotation import read_board_rotation
from companion.autopilot.float32 import float32
from companion.autopilot.parameters import ParameterClient
from companion.autopilot.writer import Change
from companion.errors import AutopilotError, AutopilotRebootedError, CalibrationRefusedError
from companion.physics.frames import Array, Matrix
from companion.physics.units import DEG
from companion.samples import Vector

MAX_GYRO_RESIDUAL_RAD_S: Final = 5.0 * DEG
"""More than this left in the output is a moving aircraft or a broken sensor, not a bias: ArduPilot itself takes 5
deg/s between two gyros for a fault ("Gyros inconsistent"), and current MEMS gyros start within 1 deg/s."""

MAX_ACCEL_RESIDUAL_M_S2: Final = 1.0
"""As above: the worst parts still flown are specified at 80 mg (0.8 m/s^2, MPU-6000, vertical axis), ArduPilot
refuses to arm at 0.75 m/s^2 between two accelerometers, and a wrong mounting or gradienter law soon exceeds it."""

MAX_GYRO_OFFSET_RAD_S: Final = 20.0 * DEG
"""Whole offset: the loosest zero-rate specification of a part still flown (MPU-6000, 20 deg/s)."""

MAX_ACCEL_OFFSET_M_S2: Final = 3.5
"""Whole offset: ArduPilot's documented range of INS_ACCOFFS, which nothing enforces."""

ACCEL_SCALE_RANGE: Final = (0.8, 1.2)
"""ArduPilot's documented range of INS_ACCSCAL, which nothing enforces."""

NOT_ZERO_M_S2: Final = 1e-6
"""Three accelerometer offsets of exactly zero mean "not calibrated" to ArduPilot: it would refuse to arm."""

_TCAL_LEARNING: Final = 2
_AXES: Final = "XYZ"


@dataclasses.dataclass(frozen=True, slots=True)
class _Names:
    """Patterns of one instance; the first is irregular (autopilots 1.1)."""

    gyro_offset: str
    accel_offset: str
    accel_scale: str
    gyro_id: str
    accel_id: str
    gyro_caltemp: str
    accel_caltemp: str
    tcal_enable: str
    use: str


# Instances 4 and 5 exist from 4.4 on boards with auxiliary instances, as INS4_GYROFFS_X and so on.
_NAMES: Final = {
    1: _Names(
        gyro_offset="INS_GYROFFS_{}",
        accel_offset="INS_ACCOFFS_{}",
        accel_scale="INS_ACCSCAL_{}",
        gyro_id="INS_GYR_ID",
        accel_id="INS_ACC_ID",
        gyro_caltemp="INS_GYR1_CALTEMP",
        accel_caltemp="INS_ACC1_CALTEMP",
        tcal_enable="INS_TCAL1_ENABLE",
        use="INS_USE",
    ),
    **{
        n: _Names(
            gyro_offset=f"INS_GYR{n}OFFS_{{}}",
            accel_offset=f"INS_ACC{n}OFFS_{{}}",
            accel_scale=f"INS_ACC{n}SCAL_{{}}",
            gyro_id=f"INS_GYR{n}_ID",
            accel_id=f"INS_ACC{n}_ID",
            gyro_caltemp=f"INS_GYR{n}_CALTEMP",
            accel_caltemp=f"INS_ACC{n}_CALTEMP",
            tcal_enable=f"INS_TCAL{n}_ENABLE",
            use=f"INS_USE{n}",
        )
        for n in (2, 3)
    },
}


@dataclasses.dataclass(frozen=True, slots=True)
class ImuParameters:
    """The names of one IMU's parameters, `instance` counting from 1.

    Raises:
        AutopilotError: no such instance.
    """

    instance: int

    def __post_init__(self) -> None:
        if self.instance not in _NAMES:
            raise AutopilotError(f"IMU {self.instance} is not known; allowed are {', '.join(map(str, _NAMES))}")

    @property
    def gyro_offset(self) -> tuple[str, str, str]:
        """X, Y, Z; rad/s."""
        return _xyz(_NAMES[self.instance].gyro_offset)

    @property
    def accel_offset(self) -> tuple[str, str, str]:
        """X, Y, Z; m/s^2."""
        return _xyz(_NAMES[self.instance].accel_offset)

    @property
    def accel_scale(self) -> tuple[str, str, str]:
        """X, Y, Z; no unit."""
        return _xyz(_NAMES[self.instance].accel_scale)

    @property
    def gyro_id(self) -> str:
        """The gyro's device id; 0 where there is none."""
        return _NAMES[self.instance].gyro_id

    @property
    def accel_id(self) -> str:
        """The accelerometer's device id; 0 where there is none."""
        return _NAMES[self.instance].accel_id

    @property
    def gyro_caltemp(self) -> str:
        """Temperature of the gyro's calibration, deg C; never written."""
        return _NAMES[self.instance].gyro_caltemp

    @property
    def accel_caltemp(self) -> str:
        """Temperature of the accelerometer's calibration, deg C; never written."""
        return _NAMES[self.instance].accel_caltemp

    @property
    def tcal_enable(self) -> str:
        """Temperature calibration: 0 off, 1 on, 2 learning."""
        return _NAMES[self.instance].tcal_enable

    @property
    def use(self) -> str:
        """Whether the autopilot uses this IMU."""
        return _NAMES[self.instance].use


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImuCalibration:
    """What the autopilot corrects one IMU with, as read."""

    instance: int
    gyro_offset_rad_s: Vector
    accel_offset_m_s2: Vector
    accel_scale: Vector
    gyro_id: int | None
    accel_id: int | None
    tcal_enable: int | None
    """None where the firmware has no temperature calibration."""
    orientation: Matrix
    """3x3, board to vehicle FRD."""
    gyr_cal: int | None
    """INS_GYR_CAL: 1 = every boot measures the gyro offsets anew and overwrites ours."""
    warnings: tuple[str, ...] = ()

    @property
    def parameters(self) -> ImuParameters:
        """The names."""
        return ImuParameters(self.instance)


async def read_calibration(parameters: ParameterClient, instance: int) -> ImuCalibration:
    """Read afresh what the autopilot corrects one of its IMUs with.

    Raises:
        AutopilotError: not ArduPilot, no such IMU, its temperature calibration is learning, an orientation or a
            value that cannot be worked with; or no answer (ParameterTimeoutError), or a restart meanwhile
            (AutopilotRebootedError).
    """
    vehicle = parameters.vehicle
    if vehicle.firmware == "px4":
        raise AutopilotError("PX4 is not supported yet by this version")
    if vehicle.firmware == "other":
        raise AutopilotError("this autopilot is neither ArduPilot nor PX4; it is not supported")
    names = ImuParameters(instance)
    boots = vehicle.boots
    if await parameters.read_optional(names.gyro_offset[0]) is None:
        raise AutopilotError(f"the autopilot has no IMU {instance}: {names.gyro_offset[0]} does not exist")
    gyro_id = await _read_integer(parameters, names.gyro_id)
    accel_id = await _read_integer(parameters, names.accel_id)
    for sensor, name, found in (("gyro", names.gyro_id, gyro_id), ("accelerometer", names.accel_id, accel_id)):
        if found == 0:
            raise AutopilotError(f"the autopilot has no IMU {instance}: {name} = 0, so there is no {sensor}")
    tcal_enable = await _read_integer(parameters, names.tcal_enable)
    if tcal_enable == _TCAL_LEARNING:
        raise AutopilotError(
            f"{names.tcal_enable} = 2: IMU {instance} is learning its temperature calibration;"
            " let it finish, or set it to 0 or 1"
        )
    calibration = ImuCalibration(
        instance=instance,
        gyro_offset_rad_s=await _read_vector(parameters, names.gyro_offset),
        accel_offset_m_s2=await _read_vector(parameters, names.accel_offset),
        accel_scale=await _read_vector(parameters, names.accel_scale),
        gyro_id=gyro_id,
        accel_id=accel_id,
        tcal_enable=tcal_enable,
        orientation=await read_board_rotation(parameters),
        gyr_cal=await _read_integer(parameters, "INS_GYR_CAL"),
    )
    used = await _read_integer(parameters, names.use)
    await vehicle.hear_boot_time()
    if vehicle.boots != boots:
        raise AutopilotRebootedError(f"{vehicle.name} restarted while the parameters of IMU {instance} were read")
    return dataclasses.replace(calibration, warnings=_warnings(calibration, used=used != 0))


def offsets_after(
    calibration: ImuCalibration, gyro_residual_rad_s: Vector, accel_residual_m_s2: Vector
) -> tuple[Vector, Vector]:
    """The gyro (rad/s) and accelerometer (m/s^2) offsets that take the residuals out of the output.

    Args:
        calibration: in force while the residuals were measured.
        gyro_residual_rad_s: mean output minus truth, vehicle FRD.
        accel_residual_m_s2: likewise.

    Raises:
        CalibrationRefusedError: not plausible, see the limits at the top.
    """
    return gyro_offset_after(calibration, gyro_residual_rad_s), accel_offset_after(calibration, accel_residual_m_s2)


def gyro_offset_after(calibration: ImuCalibration, residual_rad_s: Vector) -> Vector:
    """GYROFFS + R^-1 residual, rounded to float32; see `offsets_after`."""
    _require_plausible("gyro residual", residual_rad_s, MAX_GYRO_RESIDUAL_RAD_S, DEG, "deg/s", calibration.instance)
    step = calibration.orientation.T @ np.asarray(residual_rad_s)
    after = _vector(np.asarray(calibration.gyro_offset_rad_s) + step)
    _require_plausible("gyro offset", after, MAX_GYRO_OFFSET_RAD_S, DEG, "deg/s", calibration.instance)
    return after


def accel_offset_after(calibration: ImuCalibration, residual_m_s2: Vector) -> Vector:
    """ACCOFFS + diag(1/ACCSCAL) R^-1 residual, rounded to float32, never all zero; see `offsets_after`."""
    _require_plausible(
        "accelerometer residual", residual_m_s2, MAX_ACCEL_RESIDUAL_M_S2, 1.0, "m/s^2", calibration.instance
    )
    step = (calibration.orientation.T @ np.asarray(residual_m_s2)) / np.asarray(calibration.accel_scale)
    after = _vector(np.asarray(calibration.accel_offset_m_s2) + step)
    _require_plausible("accelerometer offset", after, MAX_ACCEL_OFFSET_M_S2, 1.0, "m/s^2", calibration.instance)
    return after if any(after) else (float32(NOT_ZERO_M_S2), 0.0, 0.0)


def changes_for(
    calibration: ImuCalibration, gyro_residual_rad_s: Vector | None, accel_residual_m_s2: Vector | None
) -> list[Change]:
    """What to write, accelerometers first (autopilots 9.3: the better order); None: that half stays as it is.

    Raises:
        CalibrationRefusedError: as `offsets_after`.
    """
    names = calibration.parameters
    changes: list[Change] = []
    if accel_residual_m_s2 is not None:
        after = accel_offset_after(calibration, accel_residual_m_s2)
        changes += map(Change, names.accel_offset, calibration.accel_offset_m_s2, after)
    if gyro_residual_rad_s is not None:
        after = gyro_offset_after(calibration, gyro_residual_rad_s)
        changes += map(Change, names.gyro_offset, calibration.gyro_offset_rad_s, after)
    return changes


def output_step(calibration: ImuCalibration, changes: list[Change]) -> tuple[Vector, Vector]:
    """By how much the output must move when the changes are in force: gyro rad/s, accelerometer m/s^2, vehicle FRD."""
    names = calibration.parameters
    by_name = {change.parameter: change.after - change.before for change in changes}
    gyro = np.array([by_name.get(name, 0.0) for name in names.gyro_offset])
    accel = np.array([by_name.get(name, 0.0) for name in names.accel_offset])
    rotation = calibration.orientation
    return _plain(-rotation @ gyro), _plain(-rotation @ (np.asarray(calibration.accel_scale) * accel))


def whole_bias(
    calibration: ImuCalibration, gyro_residual_rad_s: Vector, accel_residual_m_s2: Vector
) -> tuple[Vector, Vector]:
    """The sensor's whole bias: what it would show without any offset (its scale kept) minus truth, vehicle FRD.

    residual + R GYROFFS, and residual + R diag(ACCSCAL) ACCOFFS.
    """
    rotation = calibration.orientation
    gyro = np.asarray(gyro_residual_rad_s) + rotation @ np.asarray(calibration.gyro_offset_rad_s)
    scaled = np.asarray(calibration.accel_scale) * np.asarray(calibration.accel_offset_m_s2)
    return _plain(gyro), _plain(np.asarray(accel_residual_m_s2) + rotation @ scaled)


def _warnings(calibration: ImuCalibration, *, used: bool) -> tuple[str, ...]:
    names, instance = calibration.parameters, calibration.instance
    found: list[str] = []
    if calibration.gyr_cal not in (0, None):
        found.append(
            f"INS_GYR_CAL = {calibration.gyr_cal}: the next boot measures the gyros itself and overwrites these gyro"
            " offsets; set it to 0 to keep them"
        )
    if not any(calibration.accel_offset_m_s2):
        found.append(
            f"{names.accel_offset[0]}, _Y and _Z are 0: the autopilot takes IMU {instance}'s accelerometers for"
            ' uncalibrated and may still refuse to arm ("3D Accel calibration needed") until its accelerometer'
            " calibration is accepted once (PREFLIGHT_CALIBRATION, param5 = 76)"
        )
    low, high = ACCEL_SCALE_RANGE
    if not all(low <= scale <= high for scale in calibration.accel_scale):
        found.append(f"{names.accel_scale[0]}, _Y or _Z is outside {low} to {high}: the scale calibration looks wrong")
    if not used:
        found.append(f"{names.use} = 0: the autopilot does not use IMU {instance}")
    return tuple(found)


def _require_plausible(what: str, vector: Vector, limit: float, unit: float, words: str, instance: int) -> None:
    for axis, value in zip(_AXES, vector, strict=True):
        if not math.isfinite(value):
            raise CalibrationRefusedError(f"IMU {instance}: {what} {axis} is {value}")
        if abs(value) > limit:
            raise CalibrationRefusedError(
                f"IMU {instance}: {what} {axis} is {value / unit:.3g} {words}, allowed are {limit / unit:.3g}"
            )


async def _read_vector(parameters: ParameterClient, names: tuple[str, str, str]) -> Vector:
    values = [await parameters.read(name) for name in names]
    scale = "SCAL" in names[0]
    for name, value in zip(names, values, strict=True):
        # Offsets are added to, so any finite one will do; a scale is divided by.
        if not math.isfinite(value) or (scale and not 0.5 <= value <= 2.0):
            raise AutopilotError(f"{name} is {value:.9g}; this cannot be right, calibrate the accelerometers first")
    return values[0], values[1], values[2]


async def _read_integer(parameters: ParameterClient, name: str) -> int | None:
    value = await parameters.read_optional(name)
    if value is None:
        return None
    if not math.isfinite(value):
        raise AutopilotError(f"{name} is {value}; a whole number was expected")
    return round(value)


def _xyz(pattern: str) -> tuple[str, str, str]:
    x, y, z = (pattern.format(axis) for axis in _AXES)
    return x, y, z


def _vector(values: Array) -> Vector:
    x, y, z = (float32(float(value)) for value in values)
    return x, y, z


def _plain(values: Array) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z
