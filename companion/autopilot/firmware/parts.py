"""Which part an IMU is: its device type, the third byte of the device ids that the autopilot keeps beside the offsets.

Sources: ArduPilot's AP_InertialSensor_Backend.h (DevTypes), PX4's drv_sensor.h; both make an id of bus, address and
type (8 bits from bit 16 on). The numbers are each firmware's own: 0x2B is a BMI088 to one and an IIM42652 to the other.
"""

from __future__ import annotations

from typing import Final

from companion.autopilot.vehicle.vehicle import Firmware
from companion.config.sections import Profile

_TYPE_SHIFT: Final = 16
_BYTE: Final = 0xFF

_PARTS: Final[dict[Firmware, dict[tuple[int, int], Profile]]] = {
    "ardupilot": {
        (0x2B, 0x2B): "bmi088",
        # ADIS16470, or the better ADIS16477 with the same driver.
        (0x31, 0x31): "adis16470",
        (0x34, 0x34): "icm42688p",
    },
    "px4": {
        (0x26, 0x26): "icm42688p",
        (0x58, 0x58): "adis16470",
        (0x66, 0x6A): "bmi088",
    },
}
"""By the types of gyro and accelerometer: those that are in the catalogue."""


def part_of(firmware: Firmware | None, gyro_id: int | None, accel_id: int | None) -> Profile | None:
    """The catalogue's name of the part whose two halves have these device ids; None: it is not known."""
    if gyro_id is None or accel_id is None:
        return None
    types = (gyro_id >> _TYPE_SHIFT & _BYTE, accel_id >> _TYPE_SHIFT & _BYTE)
    return _PARTS.get(firmware or "other", {}).get(types)
