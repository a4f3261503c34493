"""ArduPilot: names, ranges and peculiarities of the parameters that the companion reads or writes.

R, the rotation from the IMU's axes to the vehicle's, comes from AHRS_ORIENTATION (docs/reference/autopilots 1.2), or
from BRD_ORIENTATION where ArduPilot has moved it there (pull request 34173).
AHRS_TRIM rotates the reported attitude only, not IMU data. A calibration leaves CALTEMP unchanged, so a new offset is
the old offset plus the residual (recipe (a) of docs/reference/autopilots 1.6).

The temperature calibration INS_TCALn_* (AP_InertialSensor_tempcal.cpp, docs/reference/autopilots 10.1) corrects a
reading in the IMU's axes. Here d is a temperature minus 35 degC. Temperature and CALTEMP are limited to TMIN and TMAX:

    raw - (P(d) - P(d at CALTEMP)) - offset,    P(d) = (c1 d + c2 d^2 + c3 d^3) 1e-6

So a curve, CALTEMP and the offset belong together. Gyros and accelerometers have their own coefficients and CALTEMP,
but share ENABLE, TMIN and TMAX.

The hover bias INS_ACC_VRFB_Z (pull request 32471) is the whole vertical bias, from vibration and from what the offsets
left, as Copter's EKF finds it in hover. While armed, the EKF subtracts it (ACC_ZBIAS_LEARN, bit 1); telemetry and log
show readings before that.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import Firmware, HeadingFallback, HeadingSetting, SlotMemory
from companion.autopilot.firmware.compass_calibration import (
    CompassCalibration,
    compass_ranges,
    no_compass,
    read_vectors,
)
from companion.autopilot.firmware.imu_calibration import (
    DEGC_RANGE,
    DEVICE_ID_RANGE,
    HOVER_BIAS,
    SWITCH_RANGE,
    ImuCalibration,
    ImuParameters,
    Range,
    Rival,
    Thermal,
    offset_ranges,
    vector_changes,
)
from companion.autopilot.firmware.imu_messages import HIGHRES, SCALED, SCALED2, SCALED3, SCRIPT
from companion.autopilot.parameters.change import SCALES, Change, FirmwareName, Names, Parameters, implausible
from companion.errors import AutopilotError
from companion.estimation.solution.curve import ZERO, Polynomial
from companion.messages import message
from companion.physics.frames import Matrix, rotation_matrix, vector
from companion.rotations import ROTATION_NAMES
from companion.samples import Vector

INSTANCES: Final = (1, 2, 3, 4, 5)
"""Numbers of IMUs; 4 and 5 exist since ArduPilot 4.4 for auxiliary IMUs, whose samples no message carries."""

AT_START: Final = "INS_GYR_CAL"  # 1: the gyros are calibrated at every start

REFERENCE_DEGC: Final = 35.0
_TCAL_UNIT: Final = 1e-6
_TCAL_ON: Final = 1
_TCAL_LEARNING: Final = 2

TRIM: Final = ("AHRS_TRIM_X", "AHRS_TRIM_Y")
"""Parameters for roll and pitch of the board in the aircraft, rad; they correct the attitude, not IMU data."""
_TRIM_RANGE: Final = Range(-math.radians(10.0), math.radians(10.0), unit="rad")  # ArduPilot's own limits
_TCAL_RANGE: Final = Range(-1e6, 1e6)  # millionths of rad/s or m/s^2 per K, K^2 or K^3

_EXTNAV, _COMPASS, _GYROS = 6.0, 1.0, 0.0  # EK3_SRCn_YAW; gyros: no yaw source, GNSS corrects the yaw
_HEADING_SCRIPT: Final = "CMPG_HEADING"
_GATE_SCRIPT: Final = "CMPG_ENABLE"  # parameter of the script (companion/lua), which exists while the script runs

_ARDUPILOT_ONLY_DEG: Final = {41: (0.0, 7.0, 0.0), 42: (45.0, 0.0, 0.0), 43: (315.0, 0.0, 0.0)}  # rotations.h
_CUSTOM_NAMES: Final = {
    100: ("AHRS_CUSTOM_ROLL", "AHRS_CUSTOM_PIT", "AHRS_CUSTOM_YAW"),  # up to 4.1
    101: ("CUST_ROT1_ROLL", "CUST_ROT1_PITCH", "CUST_ROT1_YAW"),
    102: ("CUST_ROT2_ROLL", "CUST_ROT2_PITCH", "CUST_ROT2_YAW"),
}


_COMPASS_SLOTS: Final = ("", "2", "3")
_COMPASS_LEARN: Final = "COMPASS_LEARN"
_COMPASS_OFFSET: Final = Range(-2000.0, 2000.0, unit="mG")
_COMPASS_SCALE: Final = Range(1.0 / 1.5, 1.5)  # ArduPilot ignores a scale outside (AP_Compass_config.h)


def _compass_names(slot: str) -> tuple[Names, Names, Names]:
    return _xyz(f"COMPASS_OFS{slot}_"), _xyz(f"COMPASS_DIA{slot}_"), _xyz(f"COMPASS_ODI{slot}_")


class ArduPilotParameters(ImuParameters):
    """Parameter names of IMU 1 to 5; the names of IMU 1, 4 and 5 are irregular (docs/reference/autopilots 1.1)."""

    def __init__(self, instance: int) -> None:
        """Make the names; raise AutopilotError if ArduPilot has no IMU with this number."""
        if instance not in INSTANCES:
            reason = f"allowed are {', '.join(map(str, INSTANCES))}"
            raise AutopilotError(message("autopilot_has_no_imu", imu=instance, reason=reason))
        # INS_GYROFFS, INS_GYR2OFFS, INS4_GYROFFS; but INS_GYR1_CALTEMP, INS_TCAL1_ENABLE.
        ins, n = (f"INS{instance}_", "") if instance > 3 else ("INS_", "" if instance == 1 else str(instance))
        tcal = f"INS{instance}_TCAL_" if instance > 3 else f"INS_TCAL{instance}_"
        caltemp = f"INS{instance}_{{}}_CALTEMP" if instance > 3 else f"INS_{{}}{instance}_CALTEMP"
        super().__init__(
            gyro_offset=_xyz(f"{ins}GYR{n}OFFS_"),
            accel_offset=_xyz(f"{ins}ACC{n}OFFS_"),
            accel_scale=_xyz(f"{ins}ACC{n}SCAL_"),
            gyro_id=f"{ins}GYR{n}_ID",
            accel_id=f"{ins}ACC{n}_ID",
            hover_bias=f"{ins}ACC{n}_VRFB_Z",
        )
        self.use = f"{ins}USE{n}"
        self.gyro_caltemp, self.accel_caltemp = caltemp.format("GYR"), caltemp.format("ACC")
        """Temperature at which the temperature correction is zero, deg C; -300: unknown, and ArduPilot uses TMIN."""
        self.tcal_enable, self.tcal_low, self.tcal_high = f"{tcal}ENABLE", f"{tcal}TMIN", f"{tcal}TMAX"
        """Switch of the correction (0 off, 1 on, 2 learning until the next boot), lowest and highest temperature."""
        self.tcal_gyro = [_xyz(f"{tcal}GYR{power}_") for power in (1, 2, 3)]  # Coefficients by power of the temperature
        self.tcal_accel = [_xyz(f"{tcal}ACC{power}_") for power in (1, 2, 3)]
        coefficients = (name for names in (*self.tcal_accel, *self.tcal_gyro) for name in names)
        self.tcal = (self.tcal_low, self.tcal_high, *coefficients, self.tcal_enable)
        """Parameters of the temperature correction, the switch last; without CALTEMP, which ArduPilot sets itself."""


def _xyz(stem: str) -> Names:
    return f"{stem}X", f"{stem}Y", f"{stem}Z"


def _ranges() -> dict[str, Range]:
    found: dict[str, Range] = {AT_START: SWITCH_RANGE}
    for names in map(ArduPilotParameters, INSTANCES):
        # The firmware's own gyro calibration, which we start, sets CALTEMP and id, and an undo restores both.
        found |= {**offset_ranges(names), **dict.fromkeys(names.tcal, _TCAL_RANGE)}
        found |= dict.fromkeys((names.gyro_caltemp, names.accel_caltemp, names.tcal_low, names.tcal_high), DEGC_RANGE)
        found |= {names.tcal_enable: SWITCH_RANGE, names.gyro_id: DEVICE_ID_RANGE, names.hover_bias: HOVER_BIAS}
    for slot in _COMPASS_SLOTS:
        found |= compass_ranges(_compass_names(slot), _COMPASS_OFFSET)
    return found | dict.fromkeys(TRIM, _TRIM_RANGE)


class ArduPilot(Firmware):
    """ArduPilot's Copter, Plane and Rover with the estimator EKF3."""

    name: FirmwareName = "ardupilot"
    words = "ArduPilot"
    mav_autopilot = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    heartbeat_rate_hz = 5.0  # at 1 Hz an arming would show too late (docs/reference/autopilots 5.1)
    integers_bytewise = False
    settle_s = 1.0  # new offsets show within 60 ms (20 Hz filter); the rest is for slower links
    write_s = 5.0  # 4 s, including its own gyro calibration
    ekf_reset_s = 3.0
    imu_messages = {1: (HIGHRES, SCRIPT[1], SCALED), 2: (SCRIPT[2], SCALED2), 3: (SCRIPT[3], SCALED3)}
    gyro_calibration_resets_ekf = True
    estimator_message = mavlink.MAVLink_ekf_status_report_message
    faster_log = "LOG_BITMASK with IMU_FAST"
    ranges = _ranges()
    rivals = (
        Rival(
            AT_START,
            "the next boot measures the gyros itself and overwrites these gyro offsets",
            at_start=True,
            known=1,
        ),
    )
    parts = {
        (0x2B, 0x2B): "bmi088",
        # ADIS16470, or the better ADIS16477, which has the same driver.
        (0x31, 0x31): "adis16470",
        (0x34, 0x34): "icm42688p",
    }
    """IMU models by the device types of gyro and accelerometer (AP_InertialSensor_Backend.h, DevTypes)."""

    def compass_ratio(self, message: Any) -> float:
        fit = message.flags & mavlink.EKF_ATTITUDE and not message.flags & mavlink.EKF_UNINITIALIZED
        return float(message.compass_variance) if fit else 0.0

    # --- IMUs

    async def read_calibration(self, parameters: Parameters, instance: int, memory: SlotMemory) -> ImuCalibration:
        names = ArduPilotParameters(instance)
        if await parameters.read_optional(names.gyro_offset[0]) is None:
            missing = f"{names.gyro_offset[0]} does not exist"
            raise AutopilotError(message("autopilot_has_no_imu", imu=instance, reason=missing))
        gyro_id = await parameters.read_integer(names.gyro_id)
        accel_id = await parameters.read_integer(names.accel_id)
        for name, found in ((names.gyro_id, gyro_id), (names.accel_id, accel_id)):
            if found == 0:
                raise AutopilotError(message("autopilot_has_no_imu", imu=instance, reason=f"{name} = 0"))
        thermal = await _read_thermal(parameters, instance)
        accel_offset = await parameters.read_vector(names.accel_offset)
        warnings: list[str] = []
        if not any(accel_offset):
            zero = f"{names.accel_offset[0]}, _Y and _Z"
            warnings.append(message("ardupilot_accelerometers_uncalibrated", parameters=zero, imu=instance))
        if await parameters.read_integer(names.use) == 0:
            warnings.append(message("imu_switched_off", parameter=names.use, sensor=f"IMU {instance}"))
        return ImuCalibration(
            instance=instance,
            parameters=names,
            gyro_offset_rad_s=await parameters.read_vector(names.gyro_offset),
            accel_offset_m_s2=accel_offset,
            accel_scale=await parameters.read_vector(names.accel_scale, *SCALES),
            gyro_id=gyro_id,
            accel_id=accel_id,
            orientation=await _read_board_rotation(parameters),
            thermal=thermal,
            zero_is_uncalibrated=True,
            warnings=tuple(warnings),
        )

    async def thermal_changes(
        self,
        parameters: Parameters,
        calibration: ImuCalibration,
        gyro: Polynomial,
        accel: Polynomial | None,
        degc: float,
    ) -> list[Change]:
        """Plan the changes that write temperature curves (reference 35 degC), and the offsets that are right at `degc`.

        Without a new accelerometer curve, an active old curve stays, limited to the new temperature span. An inactive
        old curve is cleared, because ENABLE would switch it on together with the gyros' curve.
        """
        assert gyro.reference_degc == REFERENCE_DEGC
        names, thermal = ArduPilotParameters(calibration.instance), calibration.thermal
        if not thermal.values:
            missing = f"{names.tcal_enable} does not exist (boards of 1 MB have none)"
            raise AutopilotError(message("curves_not_written", why=missing))
        acts = accel is not None or any(map(any, thermal.accel.coefficients))
        caltemps = [names.gyro_caltemp, *([names.accel_caltemp] if acts else [])]
        before = await parameters.read_many((*names.tcal, *caltemps))
        wanted = {name: before[name] if thermal.enabled_by else 0.0 for each in names.tcal_accel for name in each}
        for of, curve in ((names.tcal_gyro, gyro), *(((names.tcal_accel, accel),) if accel is not None else ())):
            for each, values in zip(of, curve.coefficients[1:], strict=True):
                wanted |= zip(each, (value / _TCAL_UNIT for value in values), strict=True)
        wanted |= {names.tcal_low: gyro.low_degc, names.tcal_high: gyro.high_degc, names.tcal_enable: float(_TCAL_ON)}
        wanted |= dict.fromkeys(caltemps, degc)

        def moved(of: Names, offset: Vector, by: Vector) -> list[Change]:
            return vector_changes(of, offset, vector(np.add(offset, by)))

        taken_gyro, taken_accel = thermal.taken_off(degc)
        changes = [
            *moved(names.accel_offset, calibration.accel_offset_m_s2, vector(taken_accel)),
            *moved(names.gyro_offset, calibration.gyro_offset_rad_s, vector(taken_gyro)),
            # The switch is written last, and restored first.
            *(Change(name, before[name], wanted[name]) for name in (*caltemps, *names.tcal)),
        ]
        return [change for change in changes if change.before != change.after]

    async def plan_level(
        self, parameters: Parameters, roll_rad: float, pitch_rad: float
    ) -> tuple[list[Change], Matrix]:
        # The trim does not affect IMU data, so the board's whole measured tilt is the new trim.
        old, new = [await parameters.read(name) for name in TRIM], [roll_rad, pitch_rad]
        before, after = (rotation_matrix((x, y, 0.0)) for x, y in np.degrees([old, new]).tolist())
        return list(map(Change, TRIM, old, new)), after @ before.T

    # --- compasses

    sensor_switches = {"gyro": "INS_USE{0}", "accel": "INS_USE{0}", "compass": "COMPASS_USE{0}"}
    compass_messages = {
        1: mavlink.MAVLink_raw_imu_message,
        2: mavlink.MAVLink_scaled_imu2_message,
        3: mavlink.MAVLink_scaled_imu3_message,
    }

    compass_rival = mavlink.MAVLink_mag_cal_progress_message

    async def read_compass(self, parameters: Parameters, number: int) -> CompassCalibration:
        priority, use = f"COMPASS_PRIO{number}_ID", f"COMPASS_USE{'' if number == 1 else number}"
        device_id, warnings = await parameters.read_integer(priority), []
        slots = [
            n for n in _COMPASS_SLOTS if device_id and await parameters.read_integer(f"COMPASS_DEV_ID{n}") == device_id
        ]
        if not slots or not await parameters.read_integer(use):
            raise no_compass(number, f"{priority} = {device_id}" if not slots else f"{use} = 0")
        if await parameters.read_integer(_COMPASS_LEARN):
            warnings.append(message("rival_may_rewrite", what="compass", parameter=_COMPASS_LEARN))
        scale = await parameters.read_optional(f"COMPASS_SCALE{slots[0]}") or 0.0
        names = _compass_names(slots[0])
        offset, diagonal, beside = await read_vectors(parameters, names)
        return CompassCalibration(
            number=number,
            device_id=device_id or 0,
            names=names,
            offset=offset,
            diagonal=diagonal,
            beside=beside,
            unit_gauss=1e-3 * (scale if _COMPASS_SCALE.holds(scale) else 1.0),
            in_vehicle=np.eye(3),
            reads_raw=False,
            offset_range=_COMPASS_OFFSET,
            warnings=tuple(warnings),
        )

    # --- heading from outside

    heading_settings = (
        HeadingSetting("VISO_TYPE", 1.0, "listens to VISION_POSITION_ESTIMATE"),
        HeadingSetting("EK3_SRC1_YAW", _EXTNAV, "EKF3 takes its heading from it (source set 1)"),
        HeadingSetting("EK3_SRC2_YAW", _COMPASS, "where that ends on the ground, from its compass (source set 2)"),
        HeadingSetting("EK3_SRC3_YAW", _GYROS, "where that ends in flight, from gyros and GNSS (source set 3)"),
        *(
            HeadingSetting(f"EK3_SRC{number}_{what}", value, "and the rest as in set 1", like=f"EK3_SRC1_{what}")
            for number in (2, 3)
            for what, value in (("POSXY", 3.0), ("VELXY", 3.0), ("POSZ", 1.0), ("VELZ", 3.0))
        ),
    )
    heading_watched = (_HEADING_SCRIPT,)
    heading_risks = ("ArduPilot does not arm while the companion's heading is missing (VisOdom: not healthy)",)

    def heading_net(self, found: Mapping[str, float]) -> HeadingFallback:
        fallbacks = found.get("EK3_SRC2_YAW"), found.get("EK3_SRC3_YAW")
        if fallbacks != (_COMPASS, _GYROS) or not found.get("EK3_SRC3_VELXY"):
            return "none"
        return "script" if found.get(_HEADING_SCRIPT) == 1.0 else "command"

    def takes_only_our_heading(self, found: Mapping[str, float]) -> bool:
        return found.get("EK3_SRC1_YAW") == _EXTNAV

    async def yaw_is_its_own(self, parameters: Parameters) -> bool:
        """Check that EKF3's yaw comes from its compass. While EKF3 waits for our heading, it reports 0 deg as good."""
        return await parameters.read_optional("EK3_SRC1_YAW") in (None, _COMPASS)

    # --- arming

    gate_parameters = (_GATE_SCRIPT,)
    heater_parameters = {"target": "BRD_HEAT_TARG", "margin": "BRD_HEAT_LOWMGN"}
    gate_is_script = True

    async def find_gate_problem(
        self, parameters: Parameters, system_id: int | None, script_starts_s: float
    ) -> str | None:
        enabled = await parameters.read_optional(_GATE_SCRIPT)
        if enabled is None and script_starts_s:
            await asyncio.sleep(script_starts_s)
            enabled = await parameters.read_optional(_GATE_SCRIPT)
        if enabled is None:
            return message("arming_script_missing")
        return "set CMPG_ENABLE 1" if enabled == 0 else None

    # --- ports

    def port_needs(self, baud: int) -> str | None:
        return f"SERIALn_PROTOCOL = 2, SERIALn_BAUD = {baud // 1000}"

    def forwarding_words(self, closed: Sequence[str]) -> tuple[bool, str]:
        why = "none connected? or a link set not to forward: MAVn_OPTIONS bit 1"
        return True, message("no_ground_station_heard", why=why)


async def _read_thermal(parameters: Parameters, instance: int) -> Thermal:
    """Read one IMU's temperature calibration; if switched off or not built in, the correction is zero."""
    names = ArduPilotParameters(instance)
    enable = await parameters.read_integer(names.tcal_enable)
    if enable is None:
        return Thermal()
    if enable == _TCAL_LEARNING:
        wanted = f"0 or 1 (2: IMU {instance} is learning its temperature calibration; let it finish)"
        raise implausible(names.tcal_enable, f"{enable}", wanted)
    if enable != _TCAL_ON:
        return Thermal(values={names.tcal_enable: float(enable)})
    found = await parameters.read_many((*names.tcal, names.gyro_caltemp, names.accel_caltemp))

    def polynomial(coefficients: list[Names]) -> Polynomial:
        one, two, three = (vector(np.array([found[name] for name in each]) * _TCAL_UNIT) for each in coefficients)
        return Polynomial(
            coefficients=(ZERO, one, two, three),
            reference_degc=REFERENCE_DEGC,
            low_degc=found[names.tcal_low],
            high_degc=found[names.tcal_high],
        )

    return Thermal(
        enabled_by=names.tcal_enable,
        values={name: found[name] for name in names.tcal},
        gyro=polynomial(names.tcal_gyro).zero_at(found[names.gyro_caltemp]),
        accel=polynomial(names.tcal_accel).zero_at(found[names.accel_caltemp]),
    )


async def _read_board_rotation(parameters: Parameters) -> Matrix:
    """Read the rotation matrix, (3, 3), from the board's axes to the vehicle's FRD axes.

    Raises:
        AutopilotError: an unknown orientation, a custom one that is not active, or an error of `Parameters.read`.
    """
    name, value = "AHRS_ORIENTATION", await parameters.read_optional("AHRS_ORIENTATION")
    if value is None:
        name, value = "BRD_ORIENTATION", await parameters.read("BRD_ORIENTATION")
    number = round(value) if math.isfinite(value) else -1
    if 0 <= number < len(ROTATION_NAMES):
        return rotation_matrix(ROTATION_NAMES[number])
    if number in _ARDUPILOT_ONLY_DEG:
        return rotation_matrix(_ARDUPILOT_ONLY_DEG[number])
    if number not in _CUSTOM_NAMES:
        raise implausible(name, f"{value:g}", "a known orientation")
    # A custom rotation that is selected but switched off is an internal error of ArduPilot: its effect is unknown.
    if number > 100 and not await parameters.read_optional("CUST_ROT_ENABLE"):
        raise implausible(name, f"{number}", "CUST_ROT_ENABLE = 1 with it")
    return rotation_matrix(await parameters.read_vector(_CUSTOM_NAMES[number]))
