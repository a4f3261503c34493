"""Which firmware's ways of correcting an IMU apply."""

from __future__ import annotations

from typing import Final

from companion.autopilot.firmware import ardupilot, px4
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.px4_slots import SlotMemory
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.vehicle.vehicle import Firmware
from companion.errors import AutopilotError

_SETTLE_S: Final[dict[Firmware, float]] = {
    # The telemetry shows a new offset within 60 ms (its 20 Hz filter); a second covers slower links.
    "ardupilot": 1.0,
    # It looks at its parameters at most once a second (autopilots 9.2).
    "px4": 2.0,
}


async def read_calibration(
    parameters: ParameterClient, instance: int, memory: SlotMemory | None = None
) -> ImuCalibration:
    """Read afresh what the autopilot corrects one of its IMUs with.

    Raises:
        AutopilotError: a firmware that is not known, or as the firmware's own `read_calibration`.
    """
    firmware = parameters.vehicle.firmware
    if firmware == "ardupilot":
        return await ardupilot.read_calibration(parameters, instance)
    if firmware == "px4":
        return await px4.read_calibration(parameters, instance, memory or SlotMemory())
    raise AutopilotError("this autopilot is neither ArduPilot nor PX4; it is not supported")


def settle_s(firmware: Firmware | None) -> float:
    """How long after a write the telemetry may still show the old offsets."""
    return _SETTLE_S.get(firmware or "other", 2.0)
