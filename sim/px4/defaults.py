"""The parameters of a PX4 quadcopter: the ones a companion meets with their defaults, and others that fill a list.

Names and defaults: autopilots 4, 5.2, 9.2 and PX4's own metadata (2026-08). The list of the real one has 920 names.
"""

from __future__ import annotations

SLOTS = 4
SIMULATED_IDS = (1310988, 1310996, 1311004, 1311012)
"""Device ids as PX4's own simulation has them: internal sensors."""
EXTERNAL_IDS = (1311243, 1311499, 1311755, 1312011)
"""Device ids on a CAN bus: external sensors."""


def default_parameters(*, thermal: bool = True) -> dict[str, float]:
    """Name to default: an int is an INT32, a float a REAL32. `thermal`: the module of TC_* is built."""
    table: dict[str, float] = {}
    for slot in range(SLOTS):
        for kind in ("GYRO", "ACC"):
            table |= {f"CAL_{kind}{slot}_ID": 0, f"CAL_{kind}{slot}_PRIO": -1, f"CAL_{kind}{slot}_ROT": -1}
            table |= {f"CAL_{kind}{slot}_{axis}OFF": 0.0 for axis in "XYZ"}
        table |= {f"CAL_ACC{slot}_{axis}SCALE": 1.0 for axis in "XYZ"}
        table |= {f"CAL_MAG{slot}_{word}": 0 for word in ("ID", "PRIO", "ROT")}
        table |= {f"CAL_MAG{slot}_{angle}": 0.0 for angle in ("ROLL", "PITCH", "YAW")}
        for axis in "XYZ":
            table |= {f"CAL_MAG{slot}_{axis}{word}": 0.0 for word in ("OFF", "ODIAG", "COMP")}
            table[f"CAL_MAG{slot}_{axis}SCALE"] = 1.0
        table |= {f"CAL_BARO{slot}_ID": 0, f"CAL_BARO{slot}_PRIO": -1, f"CAL_BARO{slot}_OFF": 0.0}
        if thermal:
            table |= _thermal(slot)
    table |= _sensors() | _commander() | _mavlink() | _estimator() | _actuators()
    return table


def _sensors() -> dict[str, float]:
    table: dict[str, float] = {f"SENS_BOARD_{axis}_OFF": 0.0 for axis in "XYZ"}
    return table | {
        "SENS_BOARD_ROT": 0,
        "SENS_IMU_AUTOCAL": 1,
        "SENS_IMU_CLPNOTI": 1,
        "SENS_IMU_MODE": 1,
        "SENS_MAG_AUTOCAL": 1,
        "SENS_MAG_AUTOROT": 1,
        "SENS_MAG_MODE": 1,
        "SENS_MAG_RATE": 15.0,
        "SENS_BARO_QNH": 1013.25,
        "SENS_BARO_RATE": 20.0,
        "SENS_DPRES_OFF": 0.0,
        "SENS_GPS_MASK": 7,
        "SENS_EXT_I2C_PRB": 1,
        "SENS_EN_BATT": 0,
        "SENS_EN_INA226": 0,
        "SENS_EN_THERMAL": -1,
        "IMU_GYRO_CAL_EN": 1,
        "IMU_INTEG_RATE": 200,
        "IMU_GYRO_RATEMAX": 400,
        "IMU_GYRO_CUTOFF": 40.0,
        "IMU_ACCEL_CUTOFF": 30.0,
        "IMU_DGYRO_CUTOFF": 30.0,
        "IMU_GYRO_NF0_FRQ": 0.0,
        "IMU_GYRO_NF0_BW": 20.0,
        "IMU_GYRO_DNF_EN": 0,
        "SYS_AUTOSTART": 4001,
        "SYS_AUTOCONFIG": 0,
        "SYS_CAL_GYRO": 0,
        "SYS_CAL_ACCEL": 0,
        "SYS_CAL_TDEL": 24,
        "SYS_FAC_CAL_MODE": 0,
        "SYS_HAS_BARO": 1,
        "SYS_HAS_GPS": 1,
        "SYS_HAS_MAG": 1,
        "SYS_HITL": 0,
        "SYS_PARAM_VER": 1,
        "SDLOG_MODE": 0,
        "SDLOG_PROFILE": 1,
    }


def _commander() -> dict[str, float]:
    return {
        "COM_ARMABLE": 1,
        "COM_ARM_AUTH_ID": 10,
        "COM_ARM_AUTH_MET": 0,
        "COM_ARM_AUTH_REQ": 0,
        "COM_ARM_AUTH_TO": 1.0,
        "COM_ARM_IMU_ACC": 0.7,
        "COM_ARM_IMU_GYR": 0.25,
        "COM_ARM_MAG_ANG": 60,
        "COM_ARM_WO_GPS": 1,
        "COM_CPU_MAX": 95.0,
        "COM_DISARM_LAND": 2.0,
        "COM_DISARM_PRFLT": 10.0,
        "COM_FLTMODE_BOOT": 4,
        "COM_HOME_EN": 1,
        "COM_LOW_BAT_ACT": 0,
        "COM_OBL_RC_ACT": 0,
        "COM_RC_IN_MODE": 3,
        "COM_RC_LOSS_T": 0.5,
        "CBRK_BUZZER": 0,
        "CBRK_SUPPLY_CHK": 0,
        "NAV_DLL_ACT": 0,
        "NAV_RCL_ACT": 2,
        "RTL_RETURN_ALT": 60.0,
        "MIS_TAKEOFF_ALT": 2.5,
        "MPC_XY_VEL_MAX": 12.0,
        "MPC_Z_VEL_MAX_UP": 3.0,
        "GF_ACTION": 2,
        "BAT_LOW_THR": 0.15,
        "BAT_CRIT_THR": 0.07,
        "BAT_EMERGEN_THR": 0.05,
        "TRIG_MODE": 0,
        "UAVCAN_ENABLE": 0,
    }


def _mavlink() -> dict[str, float]:
    """Port 0 is TELEM1 with a ground station, port 1 TELEM2 with a companion: streams, and no forwarding there."""
    table: dict[str, float] = {
        "MAV_SYS_ID": 1,
        "MAV_COMP_ID": 1,
        "MAV_TYPE": 2,
        "MAV_HASH_CHK_EN": 1,
        "MAV_HB_FORW_EN": 1,
        "MAV_RADIO_TOUT": 5,
        "MAV_FWDEXTSP": 1,
        "SER_TEL2_BAUD": 921600,
    }
    for port, config, mode, rate, forward in ((0, 101, 0, 1200, 1), (1, 102, 2, 0, 0), (2, 0, 0, 0, 0)):
        table |= {f"MAV_{port}_CONFIG": config, f"MAV_{port}_MODE": mode, f"MAV_{port}_RATE": rate}
        table |= {f"MAV_{port}_FORWARD": forward, f"MAV_{port}_RADIO_CTL": 1, f"MAV_{port}_FLOW_CTRL": 2}
    return table


def _estimator() -> dict[str, float]:
    ints = {
        "EKF2_IMU_CTRL": 7,
        "EKF2_MULTI_IMU": 0,
        "EKF2_EV_CTRL": 0,
        "EKF2_EV_NOISE_MD": 0,
        "EKF2_GPS_CTRL": 7,
        "EKF2_MAG_TYPE": 0,
        "EKF2_SENS_EN": 8191,
    }
    floats = {
        "EKF2_ABL_LIM": 0.4, "EKF2_ABL_TAU": 0.5, "EKF2_ABL_ACCLIM": 25.0, "EKF2_ABL_GYRLIM": 3.0,
        "EKF2_GYR_B_LIM": 0.15, "EKF2_GYR_B_NOISE": 0.001, "EKF2_ACC_B_NOISE": 0.003, "EKF2_GYR_NOISE": 0.015,
        "EKF2_ACC_NOISE": 0.35, "EKF2_ANGERR_INIT": 0.1, "EKF2_ABIAS_INIT": 0.2, "EKF2_GBIAS_INIT": 0.1,
        "EKF2_EV_DELAY": 0.0, "EKF2_EVA_NOISE": 0.1, "EKF2_HEAD_NOISE": 0.3, "EKF2_MAG_NOISE": 0.05,
    }  # fmt: skip
    sensors = ("ARSP_THR", "BARO_GATE", "BARO_NOISE", "GPS_P_NOISE", "GPS_V_NOISE", "HDG_GATE", "MAG_GATE", "TAS_GATE")
    return ints | floats | {f"EKF2_{name}": 1.0 for name in sensors}


def _thermal(sensor: int) -> dict[str, float]:
    """Thermal compensation, off: the bulk of a real list together with outputs and radio channels."""
    table: dict[str, float] = {}
    for kind in "AGM":
        prefix = f"TC_{kind}{sensor}_"
        table |= {f"{prefix}ID": 0, f"{prefix}TMAX": 100.0, f"{prefix}TMIN": 0.0, f"{prefix}TREF": 25.0}
        table |= {f"{prefix}X{power}_{axis}": 0.0 for power in range(4) for axis in range(3)}
    return table | {"TC_A_ENABLE": 0, "TC_G_ENABLE": 0, "TC_M_ENABLE": 0}


def _actuators() -> dict[str, float]:
    table: dict[str, float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4}
    for rotor in range(12):
        table |= {f"CA_ROTOR{rotor}_{word}": 0.0 for word in ("AX", "AY", "AZ", "PX", "PY", "PZ", "CT", "KM")}
    for bank in ("MAIN", "AUX"):
        for output in range(1, 9):
            for word, value in (("FUNC", 0), ("MIN", 1000), ("MAX", 2000), ("DIS", 900), ("FAIL", -1)):
                table[f"PWM_{bank}_{word}{output}"] = value
    for channel in range(1, 19):
        for word, number in (("MIN", 1000.0), ("TRIM", 1500.0), ("MAX", 2000.0), ("REV", 1.0), ("DZ", 10.0)):
            table[f"RC{channel}_{word}"] = number
    for battery in (1, 2, 3):
        for word in ("V_CHARGED", "V_EMPTY", "CAPACITY", "R_INTERNAL", "V_DIV", "A_PER_V", "V_LOAD_DROP"):
            table[f"BAT{battery}_{word}"[:16]] = -1.0
        table |= {f"BAT{battery}_N_CELLS": 4, f"BAT{battery}_SOURCE": 0}
    return table
