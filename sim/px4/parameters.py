"""PX4's parameters: defaults, the store, and the delays after which a change reaches its users.

Facts: PX4 `src/lib/parameters/parameters.cpp`, `autosave.cpp`, `SubscriptionInterval.cpp` and its metadata (2026-08),
autopilots 4, 5.2, 7.5 and 9.2.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.double import AutopilotDouble
from sim.firmware.numbers import float32

SLOTS = 4
SIMULATED_IDS = (1310988, 1310996, 1311004, 1311012)
"""Device ids in PX4's own simulation: internal sensors."""
EXTERNAL_IDS = (1311243, 1311499, 1311755, 1312011)
"""Device ids on a CAN bus: external sensors."""
SIMULATED_COMPASS_IDS = (197388, 197644, 197900, 198156)
EXTERNAL_COMPASS_IDS = (197131, 197387, 197643, 197899)
LENGTH = 764
"""Number of parameters in the list; the real firmware has 920."""

_FIXED: dict[str, float] = {
    "SENS_BOARD_X_OFF": 0.0, "SENS_BOARD_Y_OFF": 0.0, "SENS_BOARD_Z_OFF": 0.0, "SENS_BOARD_ROT": 0,
    "SENS_IMU_AUTOCAL": 1, "IMU_GYRO_CAL_EN": 1, "IMU_INTEG_RATE": 200, "SYS_HAS_MAG": 1, "SDLOG_MODE": 0,
    "COM_ARMABLE": 1, "COM_ARM_AUTH_ID": 10, "COM_ARM_AUTH_MET": 0, "COM_ARM_AUTH_REQ": 0, "COM_ARM_AUTH_TO": 1.0,
    "SENS_MAG_AUTOCAL": 1, "COM_ARM_IMU_ACC": 0.7, "COM_ARM_IMU_GYR": 0.25, "CBRK_BUZZER": 0, "MIS_TAKEOFF_ALT": 2.5,
    "MAV_SYS_ID": 1, "MAV_TYPE": 2, "MAV_HASH_CHK_EN": 1, "MAV_HB_FORW_EN": 1, "SER_TEL2_BAUD": 921600,
    "EKF2_EV_CTRL": 0, "EKF2_EV_NOISE_MD": 0, "EKF2_MAG_TYPE": 0, "EKF2_SENS_EN": 8191, "EKF2_ABL_LIM": 0.4,
    "EKF2_GYR_B_LIM": 0.15, "EKF2_EV_DELAY": 0.0, "EKF2_EVA_NOISE": 0.1,
}  # fmt: skip


def default_parameters() -> dict[str, float]:
    """Return the defaults by name: an int is an INT32, a float a REAL32."""
    table = dict(_FIXED)
    for slot in range(SLOTS):
        for kind in ("GYRO", "ACC", "MAG"):
            table |= {f"CAL_{kind}{slot}_ID": 0, f"CAL_{kind}{slot}_PRIO": -1, f"CAL_{kind}{slot}_ROT": -1}
            table |= {f"CAL_{kind}{slot}_{axis}OFF": 0.0 for axis in "XYZ"}
        table |= {f"CAL_MAG{slot}_{axis}SCALE": 1.0 for axis in "XYZ"}
        table |= {f"CAL_MAG{slot}_{axis}ODIAG": 0.0 for axis in "XYZ"}
        table |= {f"CAL_MAG{slot}_{angle}": 0.0 for angle in ("ROLL", "PITCH", "YAW")}
        table |= {f"CAL_ACC{slot}_{axis}SCALE": 1.0 for axis in "XYZ"}
    # Port 0 is TELEM1 with a ground station, port 1 TELEM2 with a companion: streams, and no forwarding there.
    for port, config, mode, rate, forward in ((0, 101, 0, 1200, 1), (1, 102, 2, 0, 0), (2, 0, 0, 0, 0)):
        table |= {f"MAV_{port}_CONFIG": config, f"MAV_{port}_MODE": mode, f"MAV_{port}_RATE": rate}
        table[f"MAV_{port}_FORWARD"] = forward
    return table | {f"SIM_FILLER_{n:04d}": 0.0 for n in range(len(table), LENGTH)}


INT32 = mavlink.MAV_PARAM_TYPE_INT32
REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
SMALLEST_CHANGE = 1.1920929e-07
"""Largest change of a float that has no consequence: the value is stored, but neither announced nor saved.

A value that differs from its default by at most this change is not saved at all.
"""


class PX4Parameters:
    """Values by name. A default that is an `int` makes an INT32, one that is a `float` a REAL32."""

    def __init__(self, defaults: Mapping[str, float]) -> None:
        self._defaults = {name: v if isinstance(v, int) else float32(v) for name, v in sorted(defaults.items())}
        self.values: dict[str, float] = dict(self._defaults)
        """Values in use, which are also read back."""
        self.saved: dict[str, float] = dict(self._defaults)
        """Values that a boot loads from the storage."""
        self.unsaved: set[str] = set()
        """Names changed since the last save: announced on every port."""
        self.names = tuple(self.values)
        """Names in the order of their indices, alphabetical."""
        self.index = {name: number for number, name in enumerate(self.names)}

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    def is_int(self, name: str) -> bool:
        """Return True for an INT32, False for a REAL32."""
        return isinstance(self._defaults[name], int)

    def type_of(self, name: str) -> int:
        return INT32 if self.is_int(name) else REAL32

    def set(self, name: str, value: float) -> bool:
        """Store a value without checking limits; return True if the change must be announced."""
        new = int(value) if self.is_int(name) else float32(value)
        old = self.values[name]
        changed = new != old if self.is_int(name) else abs(new - old) > SMALLEST_CHANGE
        self.values[name] = new
        # The same value once more takes the mark away: the others are then not told of the first change.
        if changed:
            self.unsaved.add(name)
        else:
            self.unsaved.discard(name)
        return changed

    def save(self) -> None:
        """Save every value that differs enough from its default."""
        self.saved = {name: self._stored(name, value) for name, value in self.values.items()}
        self.unsaved.clear()

    def _stored(self, name: str, value: float) -> float:
        default = self._defaults[name]
        return default if abs(value - default) <= SMALLEST_CHANGE and not self.is_int(name) else value

    def load(self) -> None:
        """Load the saved values, as at a boot."""
        self.values = dict(self.saved)
        self.unsaved.clear()

    def preset(self, name: str, value: float) -> None:
        """Set and save a value without an announcement, as if it had always been so."""
        self.values[name] = self.saved[name] = int(value) if self.is_int(name) else float32(value)

    def on_the_wire(self, name: str) -> float:
        """Return a value as PARAM_VALUE carries it: the bytes of an int32 in the place of a float."""
        value = self.values[name]
        return bytes_as_float(int(value)) if self.is_int(name) else value

    def vector(self, slot: int, kind: str, suffix: str) -> tuple[float, float, float]:
        x, y, z = (self.values[f"CAL_{kind}{slot}_{axis}{suffix}"] for axis in "XYZ")
        return x, y, z


def bytes_as_float(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def float_as_int(value: float) -> int:
    return int(struct.unpack("<i", struct.pack("<f", value))[0])


INTERVAL_S = 1.0


class Consumer:
    """A reader of parameters, with an opportunity every `period_s`; on average it reads at most once a second.

    After a quiet time, two changes have an effect at the next opportunity, later ones within 1 s (autopilots 9.2).
    """

    def __init__(self, double: AutopilotDouble, period_s: float, action: Callable[[float], None]) -> None:
        self._double, self._period_s, self._action = double, period_s, action
        self._last_s = -math.inf
        self._pending = False

    def restart(self) -> None:
        self._last_s, self._pending = -math.inf, False

    def notify(self) -> None:
        if self._pending:
            return
        self._pending = True
        now_s = self._double.now_s()
        looks_s = (math.floor(now_s / self._period_s) + 1) * self._period_s
        self._double.later(max(looks_s, self._last_s + INTERVAL_S) - now_s, self._look)

    def _look(self) -> None:
        self._pending = False
        now_s = self._double.now_s()
        self._last_s = min(max(self._last_s + INTERVAL_S, now_s - INTERVAL_S), now_s)
        self._action(now_s)
