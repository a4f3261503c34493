"""One sensor's correction in PX4's memory: its slot, the offset in use, rejected values.

    corrected = R ((raw - OFF) o SCALE)    R = R(SENS_BOARD_X/Y/Z_OFF) R(SENS_BOARD_ROT), external: R(CAL_x_ROT)

Every reader of the parameters in the firmware has such an object of its own (each IMU, the background gyro calibration,
each commanded calibration), and so has the double. Facts: PX4 `src/lib/sensor_calibration`, autopilots 4.1, 4.2, 9.3.2.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sim.earth import Array, mounting_matrix
from sim.firmware.compass import soft_matrix
from sim.firmware.numbers import rotation_matrix
from sim.px4.parameters import SLOTS, PX4Parameters

Kind = Literal["GYRO", "ACC", "MAG"]
_PRIORITY, _EXTERNAL_PRIORITY = 50, 75
THRESHOLD = 0.01
"""Smallest change of offset (rad/s, m/s^2) or scale: a new vector must be farther than this from the one in use."""
_MAG_THRESHOLD_GAUSS = 0.005
_CUSTOM_ROTATION = 100


class SensorCalibration:
    """Correction of one triad in PX4's memory.

    Args:
        kind: selects the parameters.
        device_id: id of the sensor.
        external: the sensor turns with its own CAL_x_ROT instead of with the board.
        store: the parameters.
    """

    def __init__(self, kind: Kind, device_id: int, store: PX4Parameters, *, external: bool = False) -> None:
        self.kind, self.device_id, self.external = kind, device_id, external
        self._store = store
        self.slot: int | None = None
        """Number of the slot with this device id; None: uncalibrated."""
        self.offset = np.zeros(3)
        """Offset in use: rad/s or m/s^2, in sensor axes."""
        self.scale = np.ones(3)
        self.rotation = np.eye(3)
        """Rotation from sensor to vehicle."""
        self.count = 0
        """Number of changes of offset or scale since the last reset."""
        self.reset()
        self.parameters_update()

    @property
    def calibrated(self) -> bool:
        return self.slot is not None

    @property
    def priority(self) -> float:
        """Return CAL_x_PRIO, 0 to 100, or its default."""
        stored = -1 if self.slot is None else self._store[f"CAL_{self.kind}{self.slot}_PRIO"]
        return stored if 0 <= stored <= 100 else _EXTERNAL_PRIORITY if self.external else _PRIORITY

    @property
    def enabled(self) -> bool:
        """True if the sensor is enabled; CAL_x_PRIO 0 disables it."""
        return self.priority > 0

    def correct(self, raw: Array) -> Array:
        """Correct a reading (3) in sensor axes, and rotate it into vehicle axes."""
        result: Array = self.rotation @ ((raw - self.offset) * self.scale)
        return result

    def reset(self) -> None:
        """Reset to no slot, no offset, and the board's rotation."""
        self.slot = None
        self.offset, self.scale, self.count = np.zeros(3), np.ones(3), 0
        self._set_rotation(0 if self.external else int(self._store["SENS_BOARD_ROT"]))

    def parameters_update(self) -> None:
        """Find the slot, and use its values if they differ enough from the values in use."""
        store = self._store
        self.slot = find_slot(store, self.kind, self.device_id)
        if self.slot is None:
            self.reset()
            return
        number = int(store[f"CAL_{self.kind}{self.slot}_ROT"]) if self.external else int(store["SENS_BOARD_ROT"])
        self._set_rotation(max(number, 0))
        self.set_offset(np.array(store.vector(self.slot, self.kind, "OFF")))
        if self.kind != "GYRO":
            scale = np.array(store.vector(self.slot, self.kind, "SCALE"))
            if _far(self.scale, scale) and np.isfinite(scale).all() and (scale > 0.0).all():
                self.scale = scale
                self.count += 1

    def set_offset(self, offset: Array) -> bool:
        """Use an offset if its difference to the one in use is longer than 0.01; of a magnetometer, 5 mG.

        A gyro without an offset uses any offset; an accelerometer never uses one below 0.01.
        """
        first = self.kind == "GYRO" and self.count == 0
        threshold = _MAG_THRESHOLD_GAUSS if self.kind == "MAG" else THRESHOLD
        if (first or _far(self.offset, offset, threshold)) and np.isfinite(offset).all():
            self.offset = offset.astype(np.float32).astype(np.float64)
            self.count += 1
            return True
        return False

    def save(self, preferred_slot: int) -> bool:
        """Save the values in use to the sensor's slot, the preferred or the first free slot; False: none is free."""
        store = self._store
        slot = find_slot(store, self.kind, self.device_id)
        if slot is None:
            free = [number for number in range(SLOTS) if store[f"CAL_{self.kind}{number}_ID"] == 0]
            if not free:
                return False
            slot = preferred_slot if preferred_slot in free else free[0]
        self.slot = slot
        prefix = f"CAL_{self.kind}{slot}_"
        store.set(f"{prefix}ID", self.device_id)
        if not 0 <= store[f"{prefix}PRIO"] <= 100:
            store.set(f"{prefix}PRIO", _EXTERNAL_PRIORITY if self.external else _PRIORITY)
        if not self.external:
            store.set(f"{prefix}ROT", -1)
        for axis, offset, scale in zip("XYZ", self.offset, self.scale, strict=True):
            store.set(f"{prefix}{axis}OFF", float(offset))
            if self.kind != "GYRO":
                store.set(f"{prefix}{axis}SCALE", float(scale))
        return True

    def _set_rotation(self, number: int) -> None:
        level = mounting_matrix(*(self._store[f"SENS_BOARD_{axis}_OFF"] for axis in "XYZ"))
        self.rotation = level @ rotation_matrix(number)


class MagCalibration(SensorCalibration):
    """Correction of a magnetometer in gauss: R S (raw - OFF), S with SCALE on the diagonal, ODIAG (xy, xz, yz) beside.

    Facts: PX4 `Magnetometer.cpp`. Not modelled: the currents' share (CAL_MAGn_COMP).
    """

    def __init__(self, device_id: int, store: PX4Parameters, *, external: bool) -> None:
        self.beside = np.zeros(3)
        super().__init__("MAG", device_id, store, external=external)

    @property
    def soft(self) -> Array:
        return soft_matrix(self.scale, self.beside)

    def correct(self, raw: Array) -> Array:
        return np.asarray(self.rotation @ self.soft @ (raw - self.offset))

    def reset(self) -> None:
        super().reset()
        self.beside = np.zeros(3)

    def parameters_update(self) -> None:
        super().parameters_update()
        if self.slot is None:
            return
        beside = np.array(self._store.vector(self.slot, "MAG", "ODIAG"))
        if _far(self.beside, beside) and np.isfinite(beside).all():
            self.beside = beside
            self.count += 1
        if self.external and self._store[f"CAL_MAG{self.slot}_ROT"] == _CUSTOM_ROTATION:
            angles = (self._store[f"CAL_MAG{self.slot}_{angle}"] for angle in ("ROLL", "PITCH", "YAW"))
            self.rotation = self.rotation @ mounting_matrix(*angles)


def find_slot(store: PX4Parameters, kind: Kind, device_id: int) -> int | None:
    """Return the first slot whose CAL_x_ID is this device's id."""
    return next((slot for slot in range(SLOTS) if store[f"CAL_{kind}{slot}_ID"] == device_id), None)


def _far(used: Array, wanted: Array, threshold: float = THRESHOLD) -> bool:
    return bool(np.linalg.norm(used - wanted) > threshold)
