"""PX4: names, ranges and peculiarities of the parameters that the companion uses (docs/reference/autopilots 4).

    R = R(SENS_BOARD_X/Y/Z_OFF) R(SENS_BOARD_ROT)    of an internal sensor
    R = R(SENS_BOARD_X/Y/Z_OFF) R(CAL_*_ROT)         of an external one

R rotates the sensor's axes to the vehicle's, so the level adjustment, unlike ArduPilot's trim, rotates IMU data.
Thermal compensation, TC_* (docs/reference/autopilots 10.2), is neither read nor written: common boards are built
without it. If active, it counts as a part of the sensor.

A sensor's offsets are in the slot with its device id, CAL_GYROn_ID and CAL_ACCn_ID. SCALED_IMU, SCALED_IMU2 and
SCALED_IMU3 show the pairs of gyro and accelerometer in the order in which their drivers started. No message has a
device id (docs/reference/autopilots 4.1, 4.5). PX4 prefers the slot of the same number, so the order of the slots is a
good guess. The telemetry after a write shows whether this guess is right, and `SlotMemory` stores this by device id.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import NO_IMU, Firmware, HeadingFallback, HeadingSetting, SlotMemory
from companion.autopilot.firmware.compass_calibration import (
    CompassCalibration,
    compass_ranges,
    no_compass,
    read_vectors,
)
from companion.autopilot.firmware.imu_calibration import (
    DEGC_RANGE,
    DEVICE_ID_RANGE,
    SWITCH_RANGE,
    ImuCalibration,
    ImuParameters,
    Range,
    Rival,
    offset_ranges,
)
from companion.autopilot.firmware.imu_messages import PX4_FLOATS, SCALED, SCALED2, SCALED3
from companion.autopilot.parameters.change import SCALES, Change, FirmwareName, Names, Parameters, implausible
from companion.errors import AutopilotError
from companion.messages import message
from companion.physics.frames import Matrix, body_from_ned, roll_pitch_from_up, rotation_matrix
from companion.physics.units import MG
from companion.rotations import ROTATION_NAMES
from companion.samples import Triad, Vector

SLOTS: Final = 4
PREFIX: Final[dict[Triad, str]] = {"gyro": "CAL_GYRO", "accel": "CAL_ACC"}
WORDS: Final[dict[Triad, str]] = {"gyro": "gyro", "accel": "accelerometer"}

LEVEL: Final = ("SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF")
_LEVEL_RANGE: Final = Range(-45.0, 45.0, unit="deg")
_TC_RANGE: Final = Range(-10.0, 10.0)  # rad/s, and rad/s per K, K^2 or K^3

IGNORED_STEP: Final = 0.01
"""Largest change of an offset vector (rad/s, m/s^2) that PX4 ignores (docs/reference/autopilots 4.2), also of a scale
vector: `set_scale` of src/lib/sensor_calibration/Accelerometer.cpp. At a start PX4 begins with scales of 1."""
MARGIN: Final = 1.05  # factor on `IGNORED_STEP`, as both sides round to 32 bits
GATED_TILT_DEG: Final = 0.3
"""Least tilt error that requires a restart if EKF2 keeps it after a write. Biases of an uncalibrated sensor cause
smaller errors (docs/reference/autopilots 9.3)."""

_INTERNAL: Final = -1
_SIMULATION_BUS: Final = 4
_MAYBE_INTERNAL_BUSES: Final = (1, 2)  # I2C and SPI: CAL_*_ROT shows whether the sensor is internal
_PX4_ONLY_DEG: Final = {38: (90.0, 68.0, 293.0)}
"""Roll, pitch and yaw of rotation 38 as PX4 applies it to calibrated data, deg; its drivers use more exact angles."""

_EV_YAW: Final = 1 << 3  # bit of EKF2_EV_CTRL
_MAGNETOMETER: Final = 1 << 10  # bit of EKF2_SENS_EN
SHORTEST_TIMEOUT_S: Final = 0.5  # least COM_ARM_AUTH_TO that leaves time for our answer
_LINKS: Final = 3


def parameters_of(gyro_slot: int, accel_slot: int) -> ImuParameters:
    gyro, accel = f"{PREFIX['gyro']}{gyro_slot}", f"{PREFIX['accel']}{accel_slot}"
    return ImuParameters(
        gyro_offset=(f"{gyro}_XOFF", f"{gyro}_YOFF", f"{gyro}_ZOFF"),
        accel_offset=(f"{accel}_XOFF", f"{accel}_YOFF", f"{accel}_ZOFF"),
        accel_scale=(f"{accel}_XSCALE", f"{accel}_YSCALE", f"{accel}_ZSCALE"),
        gyro_id=f"{gyro}_ID",
        accel_id=f"{accel}_ID",
    )


_RIVALS: Final = (
    Rival(
        "IMU_GYRO_CAL_EN",
        "while disarmed and still PX4 overwrites gyro offsets that seem more than 0.57 deg/s (0.01 rad/s) off",
        from_boot=True,
    ),
    Rival(
        "SENS_IMU_AUTOCAL",
        "after a flight PX4 overwrites gyro offsets that seem more than 0.57 deg/s (0.01 rad/s) off, and"
        " accelerometer offsets more than 5 mg (0.05 m/s^2)",
        accelerometers=True,
    ),
)


_MAG: Final = "CAL_MAG"
_CUSTOM: Final = 100  # CAL_MAGn_ROT: by the angles CAL_MAGn_ROLL, PITCH and YAW
_MAG_AUTOCAL: Final = "SENS_MAG_AUTOCAL"
_MAG_OFFSET: Final = Range(-2.0, 2.0, unit="gauss")


def _mag_names(slot: int) -> tuple[Names, Names, Names]:
    stem = f"{_MAG}{slot}_"
    offset, diagonal, beside = (
        (f"{stem}X{what}", f"{stem}Y{what}", f"{stem}Z{what}") for what in ("OFF", "SCALE", "ODIAG")
    )
    return offset, diagonal, beside


def _ranges() -> dict[str, Range]:
    found = dict.fromkeys((*(rival.parameter for rival in _RIVALS), "TC_G_ENABLE"), SWITCH_RANGE) | dict.fromkeys(
        LEVEL[:2], _LEVEL_RANGE
    )
    for slot in range(SLOTS):
        # Former versions wrote TC_G*, and their undo must still be able to restore the old values.
        own = f"TC_G{slot}_"
        found |= compass_ranges(_mag_names(slot), _MAG_OFFSET)
        found |= {**offset_ranges(parameters_of(slot, slot)), f"{own}ID": DEVICE_ID_RANGE}
        found |= {f"{own}{name}": DEGC_RANGE for name in ("TREF", "TMIN", "TMAX")}
        found |= {f"{own}X{power}_{axis}": _TC_RANGE for power in range(4) for axis in range(3)}
    return found


class PX4(Firmware):
    name: FirmwareName = "px4"
    words = "PX4"
    mav_autopilot = mavlink.MAV_AUTOPILOT_PX4
    late_heartbeat_on_request = True  # heartbeats come once a second: a lost one leaves the arm state unknown
    integers_bytewise = True
    takes_nan_position = True
    settle_s = 2.0  # PX4 reads its parameters at most once a second (docs/reference/autopilots 9.2)
    write_s = 8.0  # vectors are written one after another: 7 s for one IMU
    imu_messages = {1: (PX4_FLOATS, SCALED), 2: (PX4_FLOATS, SCALED2), 3: (PX4_FLOATS, SCALED3)}
    tells_ekf_bias = True
    estimator_message = mavlink.MAVLink_estimator_status_message
    ranges = _ranges()
    rivals = _RIVALS
    parts = {(0x26, 0x26): "icm42688p", (0x58, 0x58): "adis16470", (0x66, 0x6A): "bmi088"}  # drv_sensor.h
    why_no_thermal_write = "temperature curves are not written: PX4 for common boards is built without TC_*"

    def compass_ratio(self, message: Any) -> float:
        return float(message.mag_ratio) if message.flags & mavlink.ESTIMATOR_ATTITUDE else 0.0

    # --- IMUs

    async def read_calibration(self, parameters: Parameters, instance: int, memory: SlotMemory) -> ImuCalibration:
        boots = parameters.boots
        accel = choose_slot(memory, "accel", instance, await read_slots(parameters, PREFIX["accel"]))
        gyro = choose_slot(memory, "gyro", instance, await read_slots(parameters, PREFIX["gyro"]), like=accel.device_id)
        names = parameters_of(gyro.number, accel.number)
        offset = await parameters.read_vector(names.accel_offset)
        orientation = await _read_rotation(parameters, gyro, accel)
        return ImuCalibration(
            instance=instance,
            parameters=names,
            gyro_offset_rad_s=await parameters.read_vector(names.gyro_offset),
            accel_offset_m_s2=offset,
            accel_scale=await parameters.read_vector(names.accel_scale, *SCALES),
            gyro_id=gyro.device_id,
            accel_id=accel.device_id,
            orientation=orientation,
            far_axis=int(np.abs(orientation[2]).argmax()),
            scale_unused_within=MARGIN * IGNORED_STEP,
            accel_offset_may_be_unused=_too_small_to_apply_at_boot(offset)
            and not memory.in_use(names.accel_offset, offset, boots),
        )

    def stale_tilt_deg(self, changes: Sequence[Change]) -> float:
        """Return the tilt error left in EKF2, because EKF2 learns a new level or accelerometer bias very slowly."""
        turned_deg = math.hypot(*(change.after - change.before for change in changes if change.parameter in LEVEL))
        step: dict[str, float] = {}
        for change in changes:
            if change.parameter.startswith(PREFIX["accel"]):
                slot = change.parameter.partition("_")[2].partition("_")[0]
                step[slot] = math.hypot(step.get(slot, 0.0), change.after - change.before)
        stale_deg = math.degrees(max(step.values(), default=0.0) / (1e3 * MG))
        return max(turned_deg, stale_deg) if turned_deg or stale_deg >= GATED_TILT_DEG else 0.0

    level_turns_imus = True

    async def plan_level(
        self, parameters: Parameters, roll_rad: float, pitch_rad: float
    ) -> tuple[list[Change], Matrix]:
        x, y, z = await parameters.read_vector(LEVEL)
        level = rotation_matrix((x, y, z))
        seen = body_from_ned(roll_rad, pitch_rad, 0.0) @ (0.0, 0.0, -1.0)
        roll, pitch = np.degrees(roll_pitch_from_up(level.T @ seen)).tolist()
        turn: Matrix = rotation_matrix((roll, pitch, z)) @ level.T
        return [Change(LEVEL[0], x, roll), Change(LEVEL[1], y, pitch)], turn

    # --- compasses

    sensor_switches = {"gyro": "CAL_GYRO{1}_PRIO", "accel": "CAL_ACC{1}_PRIO", "compass": "CAL_MAG{1}_PRIO"}
    checks_in_health_alone = True
    compass_messages = {
        1: mavlink.MAVLink_scaled_imu_message,
        2: mavlink.MAVLink_scaled_imu2_message,
        3: mavlink.MAVLink_scaled_imu3_message,
    }
    raw_fields = True

    async def read_compass(self, parameters: Parameters, number: int) -> CompassCalibration:
        slots = await read_slots(parameters, _MAG)
        # PX4 prefers the slot of the driver's number; no message tells another one.
        own = [slot for slot in slots if slot.number == number - 1] or list(slots[number - 1 : number])
        if not own or not own[0].enabled:
            raise no_compass(number, f"{_MAG}{number - 1}_ID = 0" if not own else f"{_MAG}{own[0].number}_PRIO = 0")
        names, warnings = _mag_names(own[0].number), []
        if await parameters.read_integer(_MAG_AUTOCAL):
            warnings.append(message("rival_may_rewrite", what="compass", parameter=_MAG_AUTOCAL))
        level = rotation_matrix(await parameters.read_vector(LEVEL))
        turn = level @ await _read_mounting(parameters, _MAG, own[0])
        offset, diagonal, beside = await read_vectors(parameters, names)
        return CompassCalibration(
            number=number,
            device_id=own[0].device_id,
            names=names,
            offset=offset,
            diagonal=diagonal,
            beside=beside,
            unit_gauss=-1.0,
            in_vehicle=turn,
            reads_raw=True,
            offset_range=_MAG_OFFSET,
            far_axis=int(np.abs(turn[2]).argmax()),
            warnings=tuple(warnings),
        )

    # --- heading from outside

    heading_settings = (
        HeadingSetting("EKF2_EV_CTRL", float(_EV_YAW), "EKF2 takes its heading from external vision", bits=True),
        HeadingSetting("EKF2_EV_NOISE_MD", 0.0, "with the sigma that we send"),
        # ev_yaw_control.cpp uses the value, unsquared, as the least variance: sqrt(0.05) rad = 12.8 deg.
        HeadingSetting("EKF2_EVA_NOISE", 0.05, "as long as that is above 12.8 deg"),
        HeadingSetting("EKF2_EV_DELAY", 0.0, "our stamps are those of the samples", optional=True),
    )
    heading_watched = ("EKF2_MAG_TYPE", "SYS_HAS_MAG", "EKF2_SENS_EN")
    heading_risks = (
        "EKF2 believes the companion's heading beside its magnetometer, and resets to it where the two disagree",
    )

    def heading_net(self, found: Mapping[str, float]) -> HeadingFallback:
        return "none" if self.missing_compass(found) else "autopilot"

    def missing_compass(self, found: Mapping[str, float]) -> str | None:
        if found.get("SYS_HAS_MAG") == 0.0:
            return "SYS_HAS_MAG = 0"
        if (kind := found.get("EKF2_MAG_TYPE", 0.0)) not in (0.0, 1.0):
            return f"EKF2_MAG_TYPE = {kind:g}"
        return None if int(found.get("EKF2_SENS_EN", _MAGNETOMETER)) & _MAGNETOMETER else "bit 10 of EKF2_SENS_EN"

    # --- arming

    gate_parameters = ("COM_ARM_AUTH_REQ", "COM_ARM_AUTH_ID", "COM_ARM_AUTH_MET", "COM_ARM_AUTH_TO")

    async def find_gate_problem(
        self, parameters: Parameters, system_id: int | None, script_starts_s: float
    ) -> str | None:
        required, system, method, timeout_s = [await parameters.read_optional(name) for name in self.gate_parameters]
        if required is None:
            return message("no_arm_authorisation")
        wanted = {
            "COM_ARM_AUTH_REQ 1": required == 1,
            f"COM_ARM_AUTH_ID {system_id}": system == system_id,
            "COM_ARM_AUTH_MET 0": method in (None, 0),
            "COM_ARM_AUTH_TO 1": timeout_s is None or timeout_s >= SHORTEST_TIMEOUT_S,
        }
        wrong = [setting for setting, holds in wanted.items() if not holds]
        return f"set {', '.join(wrong)}" if wrong else None

    # --- ports

    def port_needs(self, baud: int) -> str | None:
        return f"MAV_1_CONFIG = 102, SER_TEL2_BAUD = {baud}"

    async def read_closed_links(self, parameters: Parameters) -> list[str]:
        closed: list[str] = []
        for link in (f"MAV_{number}" for number in range(_LINKS)):
            exists = await parameters.read_integer(f"{link}_CONFIG") != 0
            if exists and await parameters.read_integer(f"{link}_FORWARD") == 0:
                closed.append(link)
        return closed

    def forwarding_words(self, closed: Sequence[str]) -> tuple[bool, str]:
        if not closed:
            return True, message("no_ground_station_heard", why="none connected? PX4 forwards between all its links")
        why = f"PX4 does not forward to or from {', '.join(closed)}: set {closed[0]}_FORWARD=1 and reboot"
        return False, message("no_ground_station_heard", why=why)


def accel_offset_with(calibration: ImuCalibration, changes: Sequence[Change]) -> Vector:
    after = {change.parameter: change.after for change in changes}
    names, before = calibration.parameters.accel_offset, calibration.accel_offset_m_s2
    x, y, z = (after.get(name, old) for name, old in zip(names, before, strict=True))
    return x, y, z


def warnings_about(calibration: ImuCalibration, changes: Sequence[Change]) -> tuple[str, ...]:
    after = accel_offset_with(calibration, changes)
    if calibration.far_axis is None or not _too_small_to_apply_at_boot(after):  # None: not PX4
        return ()
    small, size = f"{calibration.parameters.accel_offset[0]}, Y and Z", f"{math.hypot(*after) / MG:.2f}"
    return (message("px4_ignores_small_offsets", parameters=small, size=size),)


def _too_small_to_apply_at_boot(accel_offset_m_s2: Vector) -> bool:
    """Check that PX4 will not use this vector after a start, because it ignores small differences from zero."""
    return 0.0 < math.hypot(*accel_offset_m_s2) <= MARGIN * IGNORED_STEP


@dataclasses.dataclass(frozen=True, slots=True)
class Slot:
    """Parameter slot (CAL_GYROn or CAL_ACCn) that holds a device id."""

    number: int
    device_id: int
    enabled: bool

    @property
    def bus(self) -> int:
        return self.device_id & 0b111


async def read_slots(parameters: Parameters, prefix: str) -> tuple[Slot, ...]:
    """Read all parameter slots with a device id, in order. Raises the errors of `Parameters.read_optional`."""
    found: list[Slot] = []
    for number in range(SLOTS):
        device_id = await parameters.read_integer(f"{prefix}{number}_ID")
        if device_id:
            priority = await parameters.read_integer(f"{prefix}{number}_PRIO")
            found.append(Slot(number, device_id, enabled=priority != 0))
    return tuple(found)


def choose_slot(
    memory: SlotMemory, sensor: Triad, instance: int, slots: Sequence[Slot], like: int | None = None
) -> Slot:
    """Choose the slot of an IMU (1 to 3) among the slots with a device id: the learned one, otherwise the best guess.

    `like`: device id of the IMU's other sensor, equal if one chip has both. AutopilotError: no slot, or a disabled one.
    """
    prefix = PREFIX[sensor]
    memory.enabled[sensor] = sum(slot.enabled for slot in slots)
    own = next((slot for slot in slots if memory.known(sensor, slot.device_id) == instance), None)
    if own is None:
        free = [slot for slot in slots if memory.known(sensor, slot.device_id) is None] or [
            slot for slot in slots if memory.known(sensor, slot.device_id) == NO_IMU
        ]
        own = next((slot for slot in free if slot.device_id == like), None)
        if own is None and instance <= len(slots) and slots[instance - 1] in free:
            own = slots[instance - 1]
        if own is None and instance <= len(slots):
            own = next((slot for slot in free if slot.enabled), None)
    if own is None:
        reason = f"only {len(slots)} of {prefix}0_ID to {prefix}{SLOTS - 1}_ID hold a device"
        raise AutopilotError(message("autopilot_has_no_imu", imu=instance, reason=reason))
    if not own.enabled:
        priority, sensor_words = f"{prefix}{own.number}_PRIO", f"the {WORDS[sensor]} of IMU {instance}"
        raise AutopilotError(message("imu_switched_off", parameter=priority, sensor=sensor_words))
    return own


async def _read_rotation(parameters: Parameters, gyro: Slot, accel: Slot) -> Matrix:
    level = rotation_matrix(await parameters.read_vector(LEVEL))
    gyro_mounting = await _read_mounting(parameters, PREFIX["gyro"], gyro)
    accel_mounting = await _read_mounting(parameters, PREFIX["accel"], accel)
    if not np.array_equal(gyro_mounting, accel_mounting):
        one, other = f"{PREFIX['gyro']}{gyro.number}_ROT", f"{PREFIX['accel']}{accel.number}_ROT"
        raise implausible(one, f"unlike {other}", "the same mounting")
    matrix: Matrix = level @ accel_mounting
    return matrix


async def _read_mounting(parameters: Parameters, prefix: str, slot: Slot) -> Matrix:
    """Read the rotation, (3, 3), from a sensor's axes to the vehicle's, without the level adjustment."""
    own = await parameters.read_integer(f"{prefix}{slot.number}_ROT")
    internal = slot.bus == _SIMULATION_BUS or (slot.bus in _MAYBE_INTERNAL_BUSES and own in (_INTERNAL, None))
    number = await parameters.read_integer("SENS_BOARD_ROT") if internal else own
    if prefix == _MAG and number == _CUSTOM:
        stem = f"{prefix}{slot.number}"
        return rotation_matrix(await parameters.read_vector((f"{stem}_ROLL", f"{stem}_PITCH", f"{stem}_YAW")))
    # PX4 applies no rotation for a number that it does not know.
    if number is None or not 0 <= number < len(ROTATION_NAMES):
        number = 0
    return rotation_matrix(_PX4_ONLY_DEG.get(number) or ROTATION_NAMES[number])
