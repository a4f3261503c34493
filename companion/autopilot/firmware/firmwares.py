"""Which firmware's ways of correcting an IMU apply, and every parameter that the companion ever writes.

Nothing but what stands in `CALIBRATION` is kept, or believed of a file. Its ranges are wide enough for whatever an
autopilot may have had before, which an undo puts back; far too narrow for nonsense.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Final

from companion.autopilot.firmware import ardupilot, px4
from companion.autopilot.firmware.imu_calibration import (
    MAX_ACCEL_OFFSET_M_S2,
    MAX_ACCEL_RESIDUAL_M_S2,
    MAX_GYRO_OFFSET_RAD_S,
    MAX_GYRO_RESIDUAL_RAD_S,
    ImuCalibration,
    ImuParameters,
    rivals_of,
)
from companion.autopilot.firmware.px4 import SLOTS, SlotMemory
from companion.autopilot.parameters.reading import SCALES, Parameters
from companion.autopilot.vehicle.vehicle import Firmware
from companion.config.sections import Profile
from companion.errors import AutopilotError, AutopilotRebootedError
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.samples import Triad

_SETTLE_S: Final[dict[Firmware, float]] = {
    # The telemetry shows a new offset within 60 ms (its 20 Hz filter); a second covers slower links.
    "ardupilot": 1.0,
    # It looks at its parameters at most once a second (autopilots 9.2).
    "px4": 2.0,
}


async def read_calibration(parameters: Parameters, instance: int, memory: SlotMemory | None = None) -> ImuCalibration:
    """Read afresh what the autopilot corrects one of its IMUs (1 to 3) with.

    `memory`: what earlier writes have shown about PX4's slots.

    Raises:
        AutopilotError: a firmware that is not known, or as the firmware's own `read_calibration`; or it has restarted
            meanwhile (AutopilotRebootedError).
    """
    vehicle = parameters.vehicle
    boots = vehicle.boots
    if vehicle.firmware == "ardupilot":
        found = await ardupilot.read_calibration(parameters, instance)
    elif vehicle.firmware == "px4":
        # Not before the autopilot is heard.
        from companion.autopilot.firmware.px4_thermal import read_thermal

        found = await px4.read_calibration(parameters, instance, memory or SlotMemory())
        found = dataclasses.replace(found, thermal=await read_thermal(parameters, found.gyro_id))
    else:
        raise AutopilotError("this autopilot is neither ArduPilot nor PX4; it is not supported")
    await vehicle.hear_boot_time()
    if vehicle.boots != boots:
        raise AutopilotRebootedError(f"{vehicle.name} restarted while the parameters of IMU {instance} were read")
    return found


def why_no_thermal_write(firmware: Firmware | None) -> str | None:
    """Give the reason why no curve is written into this firmware's temperature calibration, or None."""
    if firmware != "px4":
        return None
    return "PX4's thermal compensation (TC_*) is not written: the firmware of common boards is built without it"


def settle_s(firmware: Firmware | None) -> float:
    """How long after a write the telemetry may still show the old offsets."""
    return _SETTLE_S.get(firmware or "other", 2.0)


@dataclasses.dataclass(frozen=True, slots=True)
class Range:
    """The values of one parameter; both ends are in it."""

    low: float
    high: float
    whole: bool = False
    unit: str = ""

    def holds(self, value: float) -> bool:
        """Whether a value is one of them; NaN is not."""
        return self.low <= value <= self.high and not (self.whole and value != int(value))

    def __str__(self) -> str:
        kind = "whole numbers " if self.whole else ""
        return f"{kind}{self.low:.3g} to {self.high:.3g}{self.unit and f' {self.unit}'}"


Ranges = Mapping[str, Range]
"""By parameter."""

_GYRO_RAD_S: Final = MAX_GYRO_OFFSET_RAD_S + MAX_GYRO_RESIDUAL_RAD_S + 0.05
"""An offset from which a calibration still comes to a plausible one, or a step beyond it on the way: the far one, or a
dither's 36 steps of 1 mrad/s."""
_ACCEL_M_S2: Final = MAX_ACCEL_OFFSET_M_S2 + MAX_ACCEL_RESIDUAL_M_S2 + 0.4
"""Likewise; a dither's 36 steps are of 1 mg."""

GYRO_OFFSET: Final = Range(-_GYRO_RAD_S, _GYRO_RAD_S, unit="rad/s")
ACCEL_OFFSET: Final = Range(-_ACCEL_M_S2, _ACCEL_M_S2, unit="m/s^2")
ACCEL_SCALE: Final = Range(*SCALES)
_DEGC: Final = Range(-300.0, 400.0, unit="deg C")
"""-300: not known. Up to what a thermometer in kelvin shows: the autopilot notes what its own says."""
_TCAL: Final = Range(-1e6, 1e6)
"""Millionths of rad/s or m/s^2 a kelvin, square kelvin, cubic kelvin."""
_TC: Final = Range(-10.0, 10.0)
"""rad/s, and that a kelvin, square kelvin, cubic kelvin."""
_DEVICE_ID: Final = Range(0.0, 2.0**24, whole=True)
_TRIM: Final = Range(-math.radians(10.0), math.radians(10.0), unit="rad")
"""ArduPilot cuts it off there."""
_LEVEL: Final = Range(-45.0, 45.0, unit="deg")
"""What is there before may be anything that a user has set."""
_SWITCH: Final = Range(0.0, 255.0, whole=True)


def _offsets(names: ImuParameters) -> dict[str, Range]:
    return {
        **dict.fromkeys(names.gyro_offset, GYRO_OFFSET),
        **dict.fromkeys(names.accel_offset, ACCEL_OFFSET),
        **dict.fromkeys(names.accel_scale, ACCEL_SCALE),
    }


def _ardupilot() -> dict[str, Range]:
    found: dict[str, Range] = {}
    for names in map(ardupilot.parameters_of, ardupilot.INSTANCES):
        # Its own gyro calibration, which we start, sets CALTEMP and id: what it has overwritten is put back.
        tcal = names.tcal
        found |= {**_offsets(names), **dict.fromkeys(tcal.deciding, _TCAL)}
        found |= dict.fromkeys((tcal.gyro_caltemp, tcal.accel_caltemp, tcal.low, tcal.high), _DEGC)
        found |= {tcal.enable: _SWITCH, names.gyro_id: _DEVICE_ID}
    return found | dict.fromkeys(ardupilot.TRIM, _TRIM)


def _px4() -> dict[str, Range]:
    found = {name: one for slot in range(SLOTS) for name, one in _offsets(px4.parameters_of(slot, slot)).items()}
    # Former versions have written TC_G*: an undo or a restore of theirs still puts the old values back.
    for sensor in range(SLOTS):
        device_id, *rest = px4.thermal_names(sensor)
        found |= {device_id: _DEVICE_ID, **dict.fromkeys(rest[:3], _DEGC), **dict.fromkeys(rest[3:], _TC)}
    return found | dict.fromkeys(px4.LEVEL[:2], _LEVEL) | {px4.THERMAL_ENABLE: _SWITCH}


CALIBRATION: Final[Mapping[Firmware, Ranges]] = {
    "ardupilot": {**_ardupilot(), **dict.fromkeys(rivals_of("ardupilot"), _SWITCH)},
    "px4": {**_px4(), **dict.fromkeys(rivals_of("px4"), _SWITCH)},
}
"""By a calibration and its undo."""


def outcomes_of(triad: Triad, written: Mapping[str, WrittenParameter]) -> set[Outcome]:
    """What became of the offsets of one half of an IMU, among everything that was written for it."""
    offset = GYRO_OFFSET if triad == "gyro" else ACCEL_OFFSET
    offsets = {name for each in CALIBRATION.values() for name, one in each.items() if one is offset}
    return {one.outcome for name, one in written.items() if name in offsets}


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
"""By the types of gyro and accelerometer: those that are in the catalogue. The numbers are each firmware's own: 0x2B is
a BMI088 to one and an IIM42652 to the other (ArduPilot's AP_InertialSensor_Backend.h, DevTypes; PX4's drv_sensor.h)."""


def part_of(firmware: Firmware | None, gyro_id: int | None, accel_id: int | None) -> Profile | None:
    """The catalogue's name of the part whose two halves have these device ids; None: it is not known.

    Both firmwares make an id of bus, address and type (8 bits from bit 16 on).
    """
    if gyro_id is None or accel_id is None:
        return None
    types = (gyro_id >> _TYPE_SHIFT & _BYTE, accel_id >> _TYPE_SHIFT & _BYTE)
    return _PARTS.get(firmware or "other", {}).get(types)


def model_of(firmware: Firmware | None, gyro_id: int | None, accel_id: int | None) -> str | None:
    """The model of an IMU: the catalogue's name, else firmware and types in hex; None: it is not known."""
    if not gyro_id or not accel_id or firmware is None:
        return None
    types = "-".join(f"{each >> _TYPE_SHIFT & _BYTE:#04x}" for each in (gyro_id, accel_id))
    return part_of(firmware, gyro_id, accel_id) or f"{firmware}-{types}"
