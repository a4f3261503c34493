"""ArduPilot's bias parameters: names, what R is made of, and what is odd about them.

R is the board orientation, AHRS_ORIENTATION (autopilots 1.2); AHRS_TRIM turns the reported attitude only, never IMU
data. A calibration leaves `CALTEMP` alone, for then new = old + residual holds (recipe (a) of autopilots 1.6).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

from companion.autopilot.firmware.ardupilot_tcal import TcalParameters, names_of, read_thermal
from companion.autopilot.firmware.imu_calibration import ACCEL_SCALE_RANGE, ImuCalibration, ImuParameters, read_rivals
from companion.autopilot.parameters.reading import SCALES, Parameters, read_integer, read_vector
from companion.errors import AutopilotError
from companion.physics.frames import Matrix, rotation_matrix
from companion.rotations import ROTATION_NAMES

INSTANCES: Final = (1, 2, 3, 4, 5)
"""4 and 5 exist from 4.4 on boards with auxiliary instances; no message carries them, so none can be measured."""

TRIM: Final = ("AHRS_TRIM_X", "AHRS_TRIM_Y")
"""Roll and pitch of the board against the aircraft, rad; taken off the attitude, never off IMU data."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ArduPilotParameters(ImuParameters):
    """The names of one IMU's parameters; the first instance is irregular, 4 and 5 are again (autopilots 1.1)."""

    tcal: TcalParameters
    use: str


def parameters_of(instance: int) -> ArduPilotParameters:
    """The names of one IMU's parameters, `instance` counting from 1.

    Raises:
        AutopilotError: no such instance.
    """
    if instance not in INSTANCES:
        raise AutopilotError(f"IMU {instance} is not known; allowed are {', '.join(map(str, INSTANCES))}")
    # INS_GYROFFS, INS_GYR2OFFS, INS4_GYROFFS; but INS_GYR1_CALTEMP, INS_TCAL1_ENABLE (`ardupilot_tcal`).
    ins, n = (f"INS{instance}_", "") if instance > 3 else ("INS_", "" if instance == 1 else str(instance))
    return ArduPilotParameters(
        gyro_offset=_xyz(f"{ins}GYR{n}OFFS_{{}}"),
        accel_offset=_xyz(f"{ins}ACC{n}OFFS_{{}}"),
        accel_scale=_xyz(f"{ins}ACC{n}SCAL_{{}}"),
        gyro_id=f"{ins}GYR{n}_ID",
        accel_id=f"{ins}ACC{n}_ID",
        tcal=names_of(instance),
        use=f"{ins}USE{n}",
    )


async def read_calibration(parameters: Parameters, instance: int) -> ImuCalibration:
    """Read afresh what ArduPilot corrects one of its IMUs with.

    Raises:
        AutopilotError: no such IMU, its temperature calibration is learning, an orientation or a value that cannot be
            worked with; or no answer (ParameterTimeoutError).
    """
    names = parameters_of(instance)
    if await parameters.read_optional(names.gyro_offset[0]) is None:
        raise AutopilotError(f"the autopilot has no IMU {instance}: {names.gyro_offset[0]} does not exist")
    gyro_id = await read_integer(parameters, names.gyro_id)
    accel_id = await read_integer(parameters, names.accel_id)
    for sensor, name, found in (("gyro", names.gyro_id, gyro_id), ("accelerometer", names.accel_id, accel_id)):
        if found == 0:
            raise AutopilotError(f"the autopilot has no IMU {instance}: {name} = 0, so there is no {sensor}")
    thermal = await read_thermal(parameters, instance)
    calibration = ImuCalibration(
        instance=instance,
        parameters=names,
        gyro_offset_rad_s=await read_vector(parameters, names.gyro_offset),
        accel_offset_m_s2=await read_vector(parameters, names.accel_offset),
        accel_scale=await read_vector(parameters, names.accel_scale, *SCALES),
        gyro_id=gyro_id,
        accel_id=accel_id,
        orientation=await read_board_rotation(parameters),
        thermal=thermal,
        zero_is_uncalibrated=True,
        rivals=await read_rivals(parameters),
    )
    used = await read_integer(parameters, names.use)
    return dataclasses.replace(calibration, warnings=_warnings(calibration, names, used=used != 0))


def _warnings(calibration: ImuCalibration, names: ArduPilotParameters, *, used: bool) -> tuple[str, ...]:
    instance = calibration.instance
    found = [rival.words for rival in calibration.rivals]
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


def _xyz(pattern: str) -> tuple[str, str, str]:
    x, y, z = (pattern.format(axis) for axis in "XYZ")
    return x, y, z


_ARDUPILOT_ONLY_DEG: Final = {41: (0.0, 7.0, 0.0), 42: (45.0, 0.0, 0.0), 43: (315.0, 0.0, 0.0)}
"""PITCH_7, ROLL_45, ROLL_315 (ArduPilot's rotations.h)."""

_CUSTOM_NAMES: Final = {
    100: ("AHRS_CUSTOM_ROLL", "AHRS_CUSTOM_PIT", "AHRS_CUSTOM_YAW"),  # up to 4.1
    101: ("CUST_ROT1_ROLL", "CUST_ROT1_PITCH", "CUST_ROT1_YAW"),
    102: ("CUST_ROT2_ROLL", "CUST_ROT2_PITCH", "CUST_ROT2_YAW"),
}


async def read_board_rotation(parameters: Parameters) -> Matrix:
    """The 3x3 matrix from the board's axes to the vehicle's FRD.

    Raises:
        AutopilotError: an orientation that is not known, or a custom one that is not in force; or as
            `Parameters.read`.
    """
    value = await parameters.read("AHRS_ORIENTATION")
    number = round(value) if math.isfinite(value) else -1
    if 0 <= number < len(ROTATION_NAMES):
        return rotation_matrix(ROTATION_NAMES[number])
    if number in _ARDUPILOT_ONLY_DEG:
        return rotation_matrix(_ARDUPILOT_ONLY_DEG[number])
    if number not in _CUSTOM_NAMES:
        raise AutopilotError(f"AHRS_ORIENTATION = {value:g} is not known")
    # A custom rotation that is set but switched off is an internal error to ArduPilot: nobody knows what it does.
    if number > 100 and not await parameters.read_optional("CUST_ROT_ENABLE"):
        raise AutopilotError(f"AHRS_ORIENTATION = {number} needs CUST_ROT_ENABLE = 1")
    roll_deg, pitch_deg, yaw_deg = [await parameters.read(name) for name in _CUSTOM_NAMES[number]]
    if not all(map(math.isfinite, (roll_deg, pitch_deg, yaw_deg))):
        raise AutopilotError(f"AHRS_ORIENTATION = {number}: its angles are {roll_deg}, {pitch_deg}, {yaw_deg}")
    return rotation_matrix((roll_deg, pitch_deg, yaw_deg))
