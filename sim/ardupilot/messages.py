"""Messages of the double, with ArduPilot's units, rounding and traps."""

from __future__ import annotations

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.ardupilot.board import ArduPilotBoard
from sim.ardupilot.parameters import COMPASS_SLOTS, NEWEST
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


def heartbeat(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build HEARTBEAT, which shows no calibration, neither on Copter nor on Plane."""
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    if double.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    kind = mavlink.MAV_TYPE_QUADROTOR if double.vehicle == "copter" else mavlink.MAV_TYPE_FIXED_WING
    state = mavlink.MAV_STATE_ACTIVE if double.armed else mavlink.MAV_STATE_STANDBY
    return mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, base, 0, state, 3)


def highres_imu(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build HIGHRES_IMU: first IMU, first compass in use, barometer's temperature; before 4.8, 10^6 times the gauss."""
    t_s = double.aircraft.time_at(loop_s)
    gx, gy, gz, ax, ay, az = double.imu_output(0, loop_s).tolist()
    uses = [double.parameters.effective[f"COMPASS_USE{slot}"] for slot in COMPASS_SLOTS]
    unit = 0.001 if double.version == NEWEST else 1000.0
    mx, my, mz = (double.compass_field(next((n for n, use in enumerate(uses) if use), 0), t_s) * unit).tolist()
    baro_degc = double.aircraft.temperature_degc(t_s) + 7.63
    return mavlink.MAVLink_highres_imu_message(
        double.boot_us(loop_s), ax, ay, az, gx, gy, gz, mx, my, mz,
        pressure_hpa(double.aircraft.site.height_m), 0.0, double.aircraft.site.height_m, baro_degc, 8191, 0,
    )  # fmt: skip


def _integers(double: ArduPilotBoard, index: int, loop_s: float) -> tuple[int, ...]:
    """Return xacc to zgyro of RAW and SCALED messages (mG, mrad/s), field in milligauss, temperature in 0.01 degC."""
    t_s = double.aircraft.time_at(loop_s)
    mx, my, mz = (truncated_16(float(value)) for value in double.compass_field(index, t_s))
    if index >= len(double.imus):
        return (0, 0, 0, 0, 0, 0, mx, my, mz, 0)  # the trap of SCALED_IMU3: sent, with a compass and no IMU
    temperature = truncated_16(double.imus[index].temperature_degc(t_s) * 100.0)
    return (*in_integers(double.imu_output(index, loop_s)), mx, my, mz, temperature)


def raw_imu(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build RAW_IMU, which is not raw but equals SCALED_IMU."""
    ax, ay, az, gx, gy, gz, mx, my, mz, temperature = _integers(double, 0, loop_s)
    return mavlink.MAVLink_raw_imu_message(
        double.boot_us(loop_s), ax, ay, az, gx, gy, gz, mx, my, mz, id=0, temperature=temperature
    )


def scaled_imu(double: ArduPilotBoard, loop_s: float, index: int) -> Message | None:
    """Build SCALED_IMU, SCALED_IMU2 or 3; a missing IMU or compass reads zero; None: neither exists."""
    if index >= max(len(double.imus), len(double.compass_slots)):
        return None
    return SCALED_IMU[index](double.boot_ms(loop_s), *_integers(double, index, loop_s))


def attitude(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build ATTITUDE from the estimator, less AHRS_TRIM: in the vehicle frame."""
    roll, pitch, yaw = double.estimated_angles_rad(loop_s)
    rates = double.imu_output(0, loop_s)[:3] + double.estimator.omega_i
    return mavlink.MAVLink_attitude_message(double.boot_ms(loop_s), roll, pitch, yaw, *map(float, rates))


def ahrs(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build AHRS; its omegaI is minus the estimator's gyro bias."""
    double.update_estimator(loop_s)
    x, y, z = map(float, double.estimator.omega_i)
    return mavlink.MAVLink_ahrs_message(x, y, z, 0.0, 0.0, 0.001, 0.002)


def ekf_status_report(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build EKF_STATUS_REPORT; without a heading, EKF3 does not use GNSS.

    Its compass ratio is for any yaw: a compass', ours, or the yaw held at rest (seen in the real firmware).
    """
    flags = mavlink.EKF_ATTITUDE | mavlink.EKF_VELOCITY_VERT | mavlink.EKF_POS_VERT_ABS
    external = double.external_nav
    if external.selected and not external.aligned:
        flags |= mavlink.EKF_CONST_POS_MODE
    else:
        flags |= mavlink.EKF_VELOCITY_HORIZ | mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_PRED_POS_HORIZ_ABS
        flags |= mavlink.EKF_POS_HORIZ_REL | mavlink.EKF_PRED_POS_HORIZ_REL
    return mavlink.MAVLink_ekf_status_report_message(flags, 0.05, 0.05, 0.05, 0.02, 0.0, 0.0)


def vfr_hud(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build VFR_HUD; on a copter without an airspeed sensor, its airspeed is the ground speed."""
    _, _, yaw = double.estimated_angles_rad(loop_s)
    heading = round(np.degrees(yaw)) % 360
    return mavlink.MAVLink_vfr_hud_message(double.airspeed_m_s, 0.0, heading, 0, double.aircraft.site.height_m, 0.0)


def version_message(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build AUTOPILOT_VERSION with the capability PARAM_FLOAT, and neither C_CAST nor BYTEWISE."""
    kind = 0 if double.version == NEWEST else mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL
    return autopilot_version(double.uid2, double.version, kind, (0x1209, 0x5740))


def script_floats(double: ArduPilotBoard, loop_s: float) -> Message:
    """Build DEBUG_FLOAT_ARRAY of companion_arming.lua, from one reading; the real script averages four."""
    values = [0.0] * 58
    for index, imu in enumerate(double.imus):
        degc = imu.temperature_degc(double.aircraft.time_at(loop_s))
        output = double.imu_output(index, loop_s).tolist()
        values[7 * index : 7 * index + 7] = [*output, degc]
    return mavlink.MAVLink_debug_float_array_message(double.boot_us(loop_s), b"CMP_IMU", 1, values)


def mag_cal_progress(double: ArduPilotBoard, _loop_s: float) -> Message | None:
    """Build MAG_CAL_PROGRESS, sent only while the onboard calibration of compass 1 runs."""
    running = mavlink.MAG_CAL_RUNNING_STEP_ONE
    shown = mavlink.MAVLink_mag_cal_progress_message(0, 1, running, 1, 20, [0] * 10, 0.0, 0.0, 0.0)
    return shown if double.calibrates_compass else None


BUILDERS: dict[int, Builder] = {
    **common_builders(scaled_imu),
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: raw_imu,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: attitude,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: version_message,
    mavlink.MAVLINK_MSG_ID_AHRS: ahrs,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: ekf_status_report,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: vfr_hud,
    mavlink.MAVLINK_MSG_ID_MAG_CAL_PROGRESS: mag_cal_progress,
}
