"""ArduPilot's parameters: names by release, float32 values, and the values in use.

Releases differ for a companion (autopilots 1.1, 1.3, 2, 5.3): 4.4 brought the parameters of IMU 4 and 5; 4.6
HIGHRES_IMU, the DENIED for a rate above the loop's and the second number that forces arming; 4.7 PARAM_ERROR, MAV_SYSID
for SYSID_THISMAV, MAVn_ for SRn_ and ARMING_SKIPCHK for ARMING_CHECK.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, get_args

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.numbers import float32

Version = Literal["4.3", "4.4", "4.5", "4.6", "4.7", "4.8"]

VERSIONS: Final[tuple[Version, ...]] = get_args(Version)
NEWEST: Final[Version] = "4.8"
"""Development version, equal to the real firmware that was run for comparison."""


def since(version: Version, first: Version) -> bool:
    """Return True if `version` is `first` or later."""
    return VERSIONS.index(version) >= VERSIONS.index(first)


REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
INT8 = mavlink.MAV_PARAM_TYPE_INT8
INT16 = mavlink.MAV_PARAM_TYPE_INT16
INT32 = mavlink.MAV_PARAM_TYPE_INT32
_LIMITS = {INT8: (-128, 127), INT16: (-32768, 32767), INT32: (-(2**31), 2**31 - 1)}

AXES = ("X", "Y", "Z")

EKF_SOURCES = {"POSXY": 3, "VELXY": 3, "POSZ": 1, "VELZ": 3, "YAW": 1}
"""Heading, position and velocity sources (EK3_SRC1_*): GNSS, barometric height, compass; other sets are empty."""


def offset_names(instance: int, kind: Literal["gyro", "accel", "scale"]) -> tuple[str, str, str]:
    """Return the offset names of IMU 1 to 5; those of IMU 1 (no INS_ACC1OFFS_X), 4 and 5 are irregular."""
    first = {"gyro": "INS_GYROFFS", "accel": "INS_ACCOFFS", "scale": "INS_ACCSCAL"}
    later = {"gyro": "INS_GYR{}OFFS", "accel": "INS_ACC{}OFFS", "scale": "INS_ACC{}SCAL"}
    base = first[kind] if instance == 1 else later[kind].format(instance)
    if instance > 3:
        base = first[kind].replace("INS_", f"INS{instance}_")
    return f"{base}_X", f"{base}_Y", f"{base}_Z"


def gyro_id_name(instance: int) -> str:
    if instance > 3:
        return f"INS{instance}_GYR_ID"
    return f"INS_GYR{'' if instance == 1 else instance}_ID"


def caltemp_name(instance: int, kind: Literal["GYR", "ACC"]) -> str:
    """Return the name of the calibration temperature; unlike other names, that of the first IMU has a number."""
    return f"INS{instance}_{kind}_CALTEMP" if instance > 3 else f"INS_{kind}{instance}_CALTEMP"


def tcal_name(instance: int, what: str) -> str:
    return f"INS{instance}_TCAL_{what}" if instance > 3 else f"INS_TCAL{instance}_{what}"


def tcal_names(instance: int, kind: Literal["GYR", "ACC"]) -> list[tuple[str, str, str]]:
    """Return the names of the temperature coefficients, from first to third order."""
    x, y, z = AXES
    return [(base + x, base + y, base + z) for base in (f"{tcal_name(instance, kind)}{order}_" for order in (1, 2, 3))]


COMPASS_SLOTS: Final = ("", "2", "3")
"""Numbers in the names of the parameters of a compass."""
COMPASS_IDS: Final = (97539, 131874, 263178)
"""Device ids of the compasses in ArduPilot's own simulation."""


def compass_names(slot: str, what: str) -> tuple[str, str, str]:
    x, y, z = (f"COMPASS_{what}{slot}_{axis}" for axis in AXES)
    return x, y, z


def compass_external_name(slot: str) -> str:
    return f"COMPASS_EXTERN{slot}" if slot else "COMPASS_EXTERNAL"


class ArduPilotParameters:
    """Parameter values by name: `values` are stored, `effective` are in use."""

    def __init__(self, defaults: dict[str, tuple[float, int]]) -> None:
        self._types = {name: kind for name, (_, kind) in defaults.items()}
        self.values = {name: float32(value) for name, (value, _) in defaults.items()}
        self.effective = dict(self.values)
        self.revision = 0
        """Counter that grows with every change of `effective`."""
        self.names = tuple(self.values)
        """Names in the order of their indices."""

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def type_of(self, name: str) -> int:
        return self._types[name]

    def set(self, name: str, value: float, *, takes_effect: bool = True) -> float:
        """Store a value as the firmware would (float32; integers rounded and limited); return the stored value."""
        kind = self._types[name]
        if kind == REAL32:
            value = float32(value)
        else:
            low, high = _LIMITS[kind]
            value = float(min(max(round(value), low), high))
        self.values[name] = value
        if takes_effect:
            self.effective[name] = value
            self.revision += 1
        return value

    def reload(self) -> None:
        """Handle a boot: put the stored values into use."""
        self.effective = dict(self.values)
        self.revision += 1

    def vector(self, names: tuple[str, str, str]) -> tuple[float, float, float]:
        x, y, z = (self.effective[name] for name in names)
        return x, y, z

    def family(self, name: str) -> tuple[str, ...]:
        """Return the names whose values are sent after a write: after X of a vector, Y and Z too."""
        if name.endswith("_X"):
            family = tuple(name[:-1] + axis for axis in AXES)
            if all(member in self.values for member in family):
                return family
        return (name,)


def default_parameters(
    version: Version, imus: int, external: Sequence[bool], *, auxiliary: bool
) -> dict[str, tuple[float, int]]:
    """Return the parameters that a companion needs, in a fixed order, for a calibrated board with `imus` IMUs.

    With `auxiliary`, from 4.4 on, there are names of IMU 4 and 5 too, and a gyro as IMU 4. Offsets of
    0.001 m/s^2 mean "has been accelerometer-calibrated", as in ArduPilot's own simulator. `external`: one per compass.
    """
    table: dict[str, tuple[float, int]] = {"FORMAT_VERSION": (120 if version == NEWEST else 16, INT16)}
    old = not since(version, "4.7")
    table["SYSID_THISMAV" if old else "MAV_SYSID"] = (1, INT16)
    table["SYSID_MYGCS" if old else "MAV_GCS_SYSID"] = (255, INT16)
    table["ARMING_CHECK" if old else "ARMING_SKIPCHK"] = (1 if old else 0, INT32)
    table |= {"ARMING_REQUIRE": (1, INT8), "ARMING_ACCTHRESH": (0.75, REAL32)}
    table |= {f"AHRS_TRIM_{axis}": (0.0, REAL32) for axis in AXES}
    table |= {"AHRS_ORIENTATION": (0, INT8), "AHRS_EKF_TYPE": (3, INT8), "CUST_ROT_ENABLE": (0, INT8)}
    table |= {"BRD_HEAT_TARG": (-1, INT8), "BRD_HEAT_LOWMGN": (0, INT8)}
    for number in (1, 2):
        table |= {f"CUST_ROT{number}_{angle}": (0.0, REAL32) for angle in ("ROLL", "PITCH", "YAW")}
    instances = (1, 2, 3, 4, 5) if auxiliary and since(version, "4.4") else (1, 2, 3)
    for instance in instances:
        table |= _imu_parameters(instance, exists=instance <= imus or instance == 4)
    table |= {
        "INS_GYR_CAL": (1, INT8),
        "INS_GYRO_FILTER": (20, INT16),
        "INS_ACCEL_FILTER": (20, INT16),
        "INS_GYRO_RATE": (0, INT8),
        "INS_ACC_BODYFIX": (2, INT8),
        "INS_TCAL_OPTIONS": (0, INT8),
        "SERIAL1_PROTOCOL": (2, INT8),
        "SERIAL1_BAUD": (57, INT32),
        "SERIAL2_PROTOCOL": (2, INT8),
        "SERIAL2_BAUD": (57, INT32),
        "SERIAL3_PROTOCOL": (5, INT8),
        "EK3_IMU_MASK": (2 ** min(imus, 3) - 1, INT8),
        **{f"EK3_SRC1_{what}": (value, INT8) for what, value in EKF_SOURCES.items()},
        **{f"EK3_SRC{number}_{what}": (0, INT8) for number in (2, 3) for what in EKF_SOURCES},
        "COMPASS_ENABLE": (1, INT8),
        "COMPASS_LEARN": (0, INT8),
        "COMPASS_DEC": (0.0, REAL32),
        "SCHED_LOOP_RATE": (400, INT16),
        "SCR_ENABLE": (0, INT8),
        "VISO_TYPE": (0, INT8),
        "LOG_BITMASK": (176126, INT32),
        "LOG_DISARMED": (0, INT8),
        "STAT_BOOTCNT": (1, INT16),
    }
    for number, slot in enumerate(COMPASS_SLOTS):
        device_id, outside = (COMPASS_IDS[number], external[number]) if number < len(external) else (0, False)
        table |= {compass_external_name(slot): (int(outside), INT8), f"COMPASS_ORIENT{slot}": (0, INT8)}
        table |= {f"COMPASS_DEV_ID{slot}": (device_id, INT32), f"COMPASS_PRIO{slot or 1}_ID": (device_id, INT32)}
        table |= {f"COMPASS_USE{slot}": (1, INT8), f"COMPASS_SCALE{slot}": (0.0, REAL32)}
        table |= dict.fromkeys((*compass_names(slot, "OFS"), *compass_names(slot, "ODI")), (0.0, REAL32))
        table |= dict.fromkeys(compass_names(slot, "DIA"), (1.0, REAL32))
    groups = ("RAW_SENS", "EXT_STAT", "RC_CHAN", "RAW_CTRL", "POSITION", "EXTRA1", "EXTRA2", "EXTRA3", "PARAMS")
    for port in range(2):
        table |= {f"SR{port}_{group}" if old else f"MAV{port + 1}_{group}": (0, INT16) for group in groups}
    return table


def _imu_parameters(instance: int, *, exists: bool) -> dict[str, tuple[float, int]]:
    if instance > 3:
        gyro_id, accel_id, use = (f"INS{instance}_{what}" for what in ("GYR_ID", "ACC_ID", "USE"))
    else:
        number = "" if instance == 1 else str(instance)
        gyro_id, accel_id, use = f"INS_GYR{number}_ID", f"INS_ACC{number}_ID", f"INS_USE{number}"
    # Nothing corrects what the gyro of an auxiliary IMU reads: it comes with offsets.
    gyro_offset = 2e-4 if exists and instance > 3 else 0.0
    table: dict[str, tuple[float, int]] = dict.fromkeys(offset_names(instance, "gyro"), (gyro_offset, REAL32))
    table |= dict.fromkeys(offset_names(instance, "scale"), (1.0 if exists else 0.0, REAL32))
    table |= dict.fromkeys(offset_names(instance, "accel"), (0.001 if exists else 0.0, REAL32))
    table |= dict.fromkeys((gyro_id, accel_id), (device_id(instance) if exists else 0, INT32))
    table |= {caltemp_name(instance, kind): (-300.0, REAL32) for kind in ("GYR", "ACC")}
    return table | {use: (1, INT8)} | _tcal_parameters(instance)


def _tcal_parameters(instance: int) -> dict[str, tuple[float, int]]:
    table: dict[str, tuple[float, int]] = {tcal_name(instance, "ENABLE"): (0, INT8)}
    table |= {tcal_name(instance, "TMIN"): (0.0, REAL32), tcal_name(instance, "TMAX"): (70.0, REAL32)}
    names = [name for kind in ("ACC", "GYR") for family in tcal_names(instance, kind) for name in family]
    return table | dict.fromkeys(names, (0.0, REAL32))


def device_id(instance: int) -> int:
    """A 24-bit id such as ArduPilot makes: SPI bus, chip select, device type (ICM-42688-P)."""
    return 0x340002 + (instance << 8)
