"""What an autopilot needs set to take in our heading, and what that does to it (autopilots section 6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.vehicle.vehicle import Firmware
from companion.errors import AutopilotError

EV_YAW: Final = 8
"""Bit 3 of EKF2_EV_CTRL."""
EXTNAV: Final = 6
"""EK3_SRCn_YAW: external navigation."""


@dataclasses.dataclass(frozen=True, slots=True)
class Wanted:
    """One parameter, and what for."""

    parameter: str
    value: float
    why: str
    bits: bool = False
    """The value's bits are to be set, others stay as they are."""
    optional: bool = False

    def after(self, before: float) -> float:
        """What it is to become."""
        return float(int(before) | int(self.value)) if self.bits else self.value


_ARDUPILOT: Final = (
    Wanted("VISO_TYPE", 1.0, "listens to VISION_POSITION_ESTIMATE"),
    Wanted("EK3_SRC1_YAW", float(EXTNAV), "EKF3 takes its heading from it, and from nothing else"),
)
_PX4: Final = (
    Wanted("EKF2_EV_CTRL", float(EV_YAW), "EKF2 takes its heading from external vision", bits=True),
    Wanted("EKF2_EV_NOISE_MD", 0.0, "with the sigma that we send"),
    Wanted("EKF2_EVA_NOISE", 0.05, "as long as that is above 3 deg"),
    Wanted("EKF2_EV_DELAY", 0.0, "our stamps are those of the samples", optional=True),
)
WANTED: Final[dict[Firmware, tuple[Wanted, ...]]] = {"ardupilot": _ARDUPILOT, "px4": _PX4}

RISKS: Final[dict[Firmware, tuple[str, ...]]] = {
    "ardupilot": (
        "EK3_SRC1_YAW = 6 without the companion's stream is no heading at all: the compass is no fallback",
        "it will not arm while the stream is away (VisOdom: not healthy)",
        "if the stream stops in flight, modes that need a position go wrong within a minute: land by hand",
    ),
    "px4": (
        "EKF2 believes the companion's heading beside its magnetometer, and resets to it where the two disagree",
        "if the stream stops, the magnetometer goes on alone (not with EKF2_MAG_TYPE 5)",
    ),
}


def wanted_for(firmware: Firmware | None) -> tuple[Wanted, ...]:
    """The set of a firmware.

    Raises:
        AutopilotError: no autopilot yet, or a firmware that is not known.
    """
    if firmware is None:
        raise AutopilotError("no autopilot has been heard yet")
    found = WANTED.get(firmware)
    if found is None:
        raise AutopilotError("this autopilot is neither ArduPilot nor PX4; what takes a heading there is not known")
    return found


def changes_for(firmware: Firmware | None, found: Mapping[str, float]) -> list[Change]:
    """What is to be written, of parameters as they were read; empty where all is set already.

    Raises:
        AutopilotError: a firmware that is not known, or one that cannot take in a heading.
    """
    changes = []
    for wanted in wanted_for(firmware):
        before = found.get(wanted.parameter)
        if before is None:
            if wanted.optional:
                continue
            raise AutopilotError(f"this autopilot has no {wanted.parameter}: it cannot take in a heading")
        after = wanted.after(before)
        if not same_float32(before, after):
            changes.append(Change(wanted.parameter, before, after))
    return changes
