"""Messages of the PX4 double (autopilots 4.5, 9.2; PX4 `src/modules/mavlink/streams`)."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.messages import (
    SCALED_IMU,
    Builder,
    Message,
    autopilot_version,
    common_builders,
    in_integers,
    pressure_hpa,
)
from sim.firmware.numbers import truncated_16
from sim.px4.board import PX4Board

_PUBLISHED_AFTER_S = 0.0008
"""Delay from sampling to publishing: SCALED_IMU carries the time of publishing, HIGHRES_IMU that of sampling."""
_HOLD_MODE = 4 << 16 | 3 << 24


def heartbeat(double: PX4Board, loop_s: float) -> Message:
    """Build HEARTBEAT; the state is UNINIT while a pre-flight check fails."""
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    base |= mavlink.MAV_MODE_FLAG_AUTO_ENABLED | mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
    state = mavlink.MAV_STATE_UNINIT
    if double.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        state = mavlink.MAV_STATE_ACTIVE
    elif double.calibrating:
        state = mavlink.MAV_STATE_CALIBRATING
    elif not double.prearm_failures(loop_s):
        state = mavlink.MAV_STATE_STANDBY
    kind = mavlink.MAV_TYPE_QUADROTOR if double.vehicle == "copter" else mavlink.MAV_TYPE_FIXED_WING
    return mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_PX4, base, _HOLD_MODE, state, 3)


_SENSORS = {"Gyro": 1, "Accel": 2, "Compass": 4}
"""Bits of SYS_STATUS that a failed check clears, by a word of its text."""


def px4_sys_status(double: PX4Board, loop_s: float) -> Message:
    """Build SYS_STATUS: each failed check also clears its sensor's bit; the checks' bit is in the health alone."""
    failures, checks = double.prearm_failures(loop_s), mavlink.MAV_SYS_STATUS_PREARM_CHECK
    sensors = 3 | (mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG if double.has_compass else 0)
    bad = sum(bit for word, bit in _SENSORS.items() if any(word in failure for failure in failures))
    health = sensors & ~bad | (0 if failures else checks)
    return mavlink.MAVLink_sys_status_message(sensors, sensors, health, 180, 12600, -1, -1, 0, 0, 0, 0, 0, 0)


def highres_imu(double: PX4Board, loop_s: float) -> Message:
    """Build HIGHRES_IMU: the primary IMU less the published estimate of its bias, and the air's temperature."""
    t_s, height_m = double.aircraft.time_at(loop_s), double.aircraft.site.height_m
    sample_s, output = double.imu_output(double.primary_imu, loop_s)
    double.update_estimators(loop_s)
    gx, gy, gz, ax, ay, az = (output - double.vehicle_imus[double.primary_imu].estimator.published).tolist()
    mx, my, mz = double.compass_output(t_s).tolist()
    return mavlink.MAVLink_highres_imu_message(
        double.boot_us(double.aircraft.loop_time_of(sample_s)), ax, ay, az, gx, gy, gz, mx, my, mz,
        pressure_hpa(height_m), 0.0, height_m, double.aircraft.temperature_degc(t_s) + 7.63, 4095, 0,
    )  # fmt: skip


def scaled_imu(double: PX4Board, loop_s: float, index: int) -> Message | None:
    """Build SCALED_IMU, 2 or 3: IMU corrected, without estimator, truncated to mG and mrad/s; field raw, sensor's axes.

    None: neither such an IMU nor such a compass exists.
    """
    t_s = double.aircraft.time_at(loop_s)
    magnetic = [truncated_16(float(value)) for value in double.compass_reading(index, t_s)]
    if index >= len(double.imus):
        fields = double.boot_ms(loop_s), *[0] * 6, *magnetic, 0
        return SCALED_IMU[index](*fields) if index < len(double.compasses) else None
    sample_s, output = double.imu_output(index, loop_s)
    temperature = round(double.imus[index].temperature_degc(t_s) * 100.0) or 1  # 0 means "not known"
    boot_ms = double.boot_ms(double.aircraft.loop_time_of(sample_s) + _PUBLISHED_AFTER_S)
    fields = (*in_integers(output), *magnetic, temperature)
    return SCALED_IMU[index](boot_ms, *fields)


def attitude(double: PX4Board, loop_s: float) -> Message:
    roll, pitch, yaw = double.estimated_angles_rad(loop_s)
    rates = double.imu_output(0, loop_s).output[:3] - double.vehicle_imus[0].estimator.gyro_bias_rad_s
    return mavlink.MAVLink_attitude_message(double.boot_ms(loop_s), roll, pitch, yaw, *map(float, rates))


def timesync(double: PX4Board, loop_s: float) -> Message:
    """Build TIMESYNC: a request of the autopilot."""
    return mavlink.MAVLink_timesync_message(0, double.boot_us(loop_s) * 1000)


def home_position(double: PX4Board, loop_s: float) -> Message:
    """Build HOME_POSITION: the aircraft's place."""
    site = double.aircraft.site
    return mavlink.MAVLink_home_position_message(
        round(site.latitude_deg * 1e7), round(site.longitude_deg * 1e7), round(site.height_m * 1000.0),
        0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, double.boot_us(loop_s),
    )  # fmt: skip


def extended_sys_state(double: PX4Board, loop_s: float) -> Message:
    """Build EXTENDED_SYS_STATE, which always reports an aircraft on the ground."""
    return mavlink.MAVLink_extended_sys_state_message(
        mavlink.MAV_VTOL_STATE_UNDEFINED, mavlink.MAV_LANDED_STATE_ON_GROUND
    )


def estimator_status(double: PX4Board, loop_s: float) -> Message:
    """Build ESTIMATOR_STATUS, which does not contain the source of the heading."""
    flags = mavlink.ESTIMATOR_ATTITUDE | mavlink.ESTIMATOR_VELOCITY_VERT | mavlink.ESTIMATOR_POS_VERT_ABS
    flags |= mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_POS_HORIZ_REL
    return mavlink.MAVLink_estimator_status_message(
        double.boot_us(loop_s), flags, 0.05, 0.05, 0.05, 0.02, 0.0, 0.0, 0.5, 0.5
    )


def version_message(double: PX4Board, loop_s: float) -> Message:
    """Build AUTOPILOT_VERSION with the capabilities PARAM_FLOAT and PARAM_ENCODE_BYTEWISE."""
    kind = mavlink.FIRMWARE_VERSION_TYPE_BETA if double.version == "1.18" else mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
    bytewise = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    return autopilot_version(double.uid2, double.version, kind, (0x26AC, 0x0032), bytewise, middleware=True)


BUILDERS: dict[int, Builder] = {
    **common_builders(scaled_imu),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: px4_sys_status,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: attitude,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: timesync,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: home_position,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: extended_sys_state,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: version_message,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: estimator_status,
}
