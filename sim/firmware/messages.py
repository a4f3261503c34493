"""Messages that both firmwares fill in the same way."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.firmware.numbers import truncated_16

if TYPE_CHECKING:
    from sim.firmware.double import AutopilotDouble

Message = mavlink.MAVLink_message
Builder = Callable[[Any, float], Message | None]
"""Makes a message of a double at a time of the loop; None: there is none."""
SCALED_IMU = (
    mavlink.MAVLink_scaled_imu_message,
    mavlink.MAVLink_scaled_imu2_message,
    mavlink.MAVLink_scaled_imu3_message,
)
"""Message classes, by number of the IMU."""


def in_integers(output: Array) -> list[int]:
    """Return the fields xacc to zgyro for rates and specific forces (6): mG and mrad/s, cut toward zero."""
    milli_g = output[3:] * (1000.0 / STANDARD_GRAVITY_M_S2)
    return [truncated_16(float(value)) for value in (*milli_g, *output[:3] * 1000.0)]


def pressure_hpa(height_m: float) -> float:
    """Return the static pressure of the standard atmosphere."""
    return float(1013.25 * (1.0 - height_m / 44330.8) ** 5.25588)


def system_time(double: AutopilotDouble, loop_s: float) -> Message:
    """Build SYSTEM_TIME; GNSS supplies the date."""
    return mavlink.MAVLink_system_time_message(int(double.unix_s(loop_s) * 1e6), double.boot_ms(loop_s))


def global_position_int(double: AutopilotDouble, loop_s: float) -> Message:
    site = double.aircraft.site
    _, _, yaw = double.estimated_angles_rad(loop_s)
    heading = int(math.degrees(yaw) % 360.0 * 100.0) % 36000
    return mavlink.MAVLink_global_position_int_message(
        double.boot_ms(loop_s), round(site.latitude_deg * 1e7), round(site.longitude_deg * 1e7),
        round(site.height_m * 1000.0), 0, 0, 0, 0, heading,
    )  # fmt: skip


def gps_raw_int(double: AutopilotDouble, loop_s: float) -> Message:
    """Build GPS_RAW_INT with a 3D fix."""
    site = double.aircraft.site
    return mavlink.MAVLink_gps_raw_int_message(
        double.boot_us(loop_s), 3, round(site.latitude_deg * 1e7), round(site.longitude_deg * 1e7),
        round(site.height_m * 1000.0), 80, 120, 0, 0, 14, round(site.height_m * 1000.0), 1200, 1800,
    )  # fmt: skip


def sys_status(double: AutopilotDouble, loop_s: float) -> Message:
    """Build SYS_STATUS, with the health bit of the checks before arming."""
    sensors = (
        mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
        | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
        | mavlink.MAV_SYS_STATUS_PREARM_CHECK
        | (mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG if double.has_compass else 0)
    )
    health = sensors if not double.prearm_failures(loop_s) else sensors & ~mavlink.MAV_SYS_STATUS_PREARM_CHECK
    return mavlink.MAVLink_sys_status_message(sensors, sensors, health, 180, 12600, -1, -1, 0, 0, 0, 0, 0, 0)


def autopilot_version(
    uid2: bytes, version: str, kind: int, board: tuple[int, int], capabilities: int = 0, *, middleware: bool = False
) -> Message:
    """Build AUTOPILOT_VERSION; `kind`: FIRMWARE_VERSION_TYPE, `board`: vendor and product, `capabilities`: own ones."""
    major, minor = (int(part) for part in version.split("."))
    software = major << 24 | minor << 16 | kind
    capabilities |= mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    capabilities |= mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    nothing = [0] * 8
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, software, software * middleware, 0, 0, nothing, nothing, nothing, *board, 0, list(uid2)
    )


def common_builders(scaled_imu: Callable[[Any, float, int], Message | None]) -> dict[int, Builder]:
    """Return the builders of both firmwares; `scaled_imu` makes SCALED_IMU, 2 or 3 by its index."""
    return {
        mavlink.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: gps_raw_int,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: global_position_int,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU: lambda double, loop_s: scaled_imu(double, loop_s, 0),
        mavlink.MAVLINK_MSG_ID_SCALED_IMU2: lambda double, loop_s: scaled_imu(double, loop_s, 1),
        mavlink.MAVLINK_MSG_ID_SCALED_IMU3: lambda double, loop_s: scaled_imu(double, loop_s, 2),
    }
