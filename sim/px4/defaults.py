"""The parameters of a PX4 quadcopter that a companion meets, with their defaults, and others that fill the list.

Names and defaults: autopilots 4, 5.2, 9.2 and PX4's own metadata (2026-08).
"""

from __future__ import annotations

SLOTS = 4
SIMULATED_IDS = (1310988, 1310996, 1311004, 1311012)
"""Device ids as PX4's own simulation has them: internal sensors."""
EXTERNAL_IDS = (1311243, 1311499, 1311755, 1312011)
"""Device ids on a CAN bus: external sensors."""
LENGTH = 764
"""Number of parameters in the list; the real firmware has 920."""

_FIXED: dict[str, float] = {
    "SENS_BOARD_X_OFF": 0.0, "SENS_BOARD_Y_OFF": 0.0, "SENS_BOARD_Z_OFF": 0.0, "SENS_BOARD_ROT": 0,
    "SENS_IMU_AUTOCAL": 1, "IMU_GYRO_CAL_EN": 1, "IMU_INTEG_RATE": 200, "SYS_HAS_MAG": 1, "SDLOG_MODE": 0,
    "COM_ARMABLE": 1, "COM_ARM_AUTH_ID": 10, "COM_ARM_AUTH_MET": 0, "COM_ARM_AUTH_REQ": 0, "COM_ARM_AUTH_TO": 1.0,
    "COM_ARM_IMU_ACC": 0.7, "COM_ARM_IMU_GYR": 0.25, "CBRK_BUZZER": 0, "MIS_TAKEOFF_ALT": 2.5,
    "MAV_SYS_ID": 1, "MAV_TYPE": 2, "MAV_HASH_CHK_EN": 1, "MAV_HB_FORW_EN": 1, "SER_TEL2_BAUD": 921600,
    "EKF2_EV_CTRL": 0, "EKF2_EV_NOISE_MD": 0, "EKF2_MAG_TYPE": 0, "EKF2_SENS_EN": 8191, "EKF2_ABL_LIM": 0.4,
    "EKF2_GYR_B_LIM": 0.15, "EKF2_EV_DELAY": 0.0, "EKF2_EVA_NOISE": 0.1,
}  # fmt: skip


def default_parameters() -> dict[str, float]:
    """Name to default: an int is an INT32, a float a REAL32."""
    table = dict(_FIXED)
    for slot in range(SLOTS):
        for kind in ("GYRO", "ACC"):
            table |= {f"CAL_{kind}{slot}_ID": 0, f"CAL_{kind}{slot}_PRIO": -1, f"CAL_{kind}{slot}_ROT": -1}
            table |= {f"CAL_{kind}{slot}_{axis}OFF": 0.0 for axis in "XYZ"}
        table |= {f"CAL_ACC{slot}_{axis}SCALE": 1.0 for axis in "XYZ"}
    # Port 0 is TELEM1 with a ground station, port 1 TELEM2 with a companion: streams, and no forwarding there.
    for port, config, mode, rate, forward in ((0, 101, 0, 1200, 1), (1, 102, 2, 0, 0), (2, 0, 0, 0, 0)):
        table |= {f"MAV_{port}_CONFIG": config, f"MAV_{port}_MODE": mode, f"MAV_{port}_RATE": rate}
        table[f"MAV_{port}_FORWARD"] = forward
    return table | {f"SIM_FILLER_{n:04d}": 0.0 for n in range(len(table), LENGTH)}
