"""All supported firmwares, and functions that select one by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.autopilot.firmware.base import Firmware, OtherFirmware, SlotMemory
from companion.autopilot.firmware.imu_calibration import (
    ACCEL_OFFSET,
    ACCEL_SCALE_RANGE,
    GYRO_OFFSET,
    HOVER_BIAS,
    ImuCalibration,
    Range,
)
from companion.autopilot.firmware.px4 import PX4
from companion.autopilot.parameters.change import FirmwareName, Parameters
from companion.config.sections import Profile
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.messages import message
from companion.samples import Triad

FIRMWARES: Final[tuple[Firmware, ...]] = (ArduPilot(), PX4())
NO_FIRMWARE_YET: Final = Firmware()
OTHER: Final = OtherFirmware()

CALIBRATION: Final[Mapping[str, Mapping[str, Range]]] = {str(one.name): one.ranges for one in FIRMWARES}
"""Range of every parameter that a calibration or its undo may write, by firmware and name. No other parameter is saved,
or accepted from a file."""
LEARNED: Final = frozenset(name for each in CALIBRATION.values() for name, one in each.items() if one is HOVER_BIAS)
"""Parameters that the firmware learns in flight, from what our values left: an undo restores the difference only."""


def firmware_named(name: FirmwareName | None) -> Firmware:
    """Return the firmware named: `NO_FIRMWARE_YET` for None (no heartbeat yet), `OTHER` for an unknown name."""
    return NO_FIRMWARE_YET if name is None else next((one for one in FIRMWARES if one.name == name), OTHER)


def firmware_with(mav_autopilot: int) -> Firmware:
    return next((one for one in FIRMWARES if one.mav_autopilot == mav_autopilot), OTHER)


async def read_calibration(parameters: Parameters, instance: int, memory: SlotMemory | None = None) -> ImuCalibration:
    """Read offsets, scales and other corrections that the autopilot applies to IMU `instance` (1 to 3).

    Raises:
        AutopilotError: no such IMU, an implausible value, no answer, or the autopilot restarted meanwhile.
    """
    boots, firmware, memory = parameters.boots, firmware_named(parameters.firmware), memory or SlotMemory()
    found = await firmware.read_calibration(parameters, instance, memory)
    rivals = await firmware.read_rivals(parameters, memory.rivals)
    await parameters.ensure_same_boot(boots, "its parameters were read")
    warnings, (low, high) = [*(rival.words for rival in rivals), *found.warnings], ACCEL_SCALE_RANGE
    for name, scale in zip(found.parameters.accel_scale, found.accel_scale, strict=True):
        if not low <= scale <= high:
            value, wanted = f"{scale:.3g}", f"{low} to {high}"
            warnings.append(message("parameter_not_plausible", parameter=name, value=value, wanted=wanted))
    return dataclasses.replace(found, rivals=rivals, warnings=tuple(warnings))


def port_needs(firmware: FirmwareName | None, baud: int) -> str:
    needs = firmware_named(firmware).port_needs(baud) or ", or ".join(
        f"{one.port_needs(baud)} ({one.words})" for one in FIRMWARES
    )
    return f"its port needs {needs}, and a restart"


def outcomes_of(triad: Triad, written: Mapping[str, WrittenParameter]) -> set[Outcome]:
    offset = GYRO_OFFSET if triad == "gyro" else ACCEL_OFFSET
    offsets = {name for each in CALIBRATION.values() for name, one in each.items() if one is offset}
    return {one.outcome for name, one in written.items() if name in offsets}


def part_of(firmware: FirmwareName | None, gyro_id: int | None, accel_id: int | None) -> Profile | None:
    """Return our catalogue's name of the IMU with these device ids of gyro and accelerometer; None: unknown."""
    if gyro_id is None or accel_id is None:
        return None
    return firmware_named(firmware).parts.get((_type_in(gyro_id), _type_in(accel_id)))


def model_of(firmware: FirmwareName | None, gyro_id: int | None, accel_id: int | None) -> str | None:
    """Return an IMU's model: its name in our catalogue, otherwise firmware and device types in hex; None: unknown."""
    if not gyro_id or not accel_id or firmware is None:
        return None
    types = f"{_type_in(gyro_id):#04x}-{_type_in(accel_id):#04x}"
    return part_of(firmware, gyro_id, accel_id) or f"{firmware}-{types}"


def _type_in(device_id: int) -> int:
    return device_id >> 16 & 0xFF  # in both firmwares the third byte is the type; bus and address are below
