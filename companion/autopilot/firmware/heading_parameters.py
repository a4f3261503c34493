"""What an autopilot needs set to take in our heading, and what that does to it (autopilots 6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final, Literal

from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.vehicle.vehicle import Firmware
from companion.errors import AutopilotError

EV_YAW: Final = 8
"""Bit 3 of EKF2_EV_CTRL."""
EXTNAV: Final = 6
COMPASS: Final = 1
GYROS: Final = 0
"""EK3_SRCn_YAW: external navigation, the autopilot's compass, and none: gyros carry it on, GNSS holds it."""
MAGNETOMETER: Final = 1 << 10
"""Bit 10 of EKF2_SENS_EN."""
Net = Literal["script", "command", "autopilot", "none"]
"""Who sees to another heading when ours ends; "autopilot": it does so by itself."""


@dataclasses.dataclass(frozen=True, slots=True)
class Wanted:
    """One parameter, and what for."""

    parameter: str
    value: float
    why: str
    bits: bool = False
    """The value's bits are to be set, others stay as they are."""
    optional: bool = False
    like: str = ""
    """Another parameter, whose value it is to have; `value` where that is not there."""

    def after(self, found: Mapping[str, float]) -> float:
        """What it is to become, of parameters as they were read."""
        value = found.get(self.like, self.value)
        return float(int(found[self.parameter]) | int(value)) if self.bits else value


_ARDUPILOT: Final = (
    Wanted("VISO_TYPE", 1.0, "listens to VISION_POSITION_ESTIMATE"),
    Wanted("EK3_SRC1_YAW", float(EXTNAV), "EKF3 takes its heading from it (source set 1)"),
    Wanted("EK3_SRC2_YAW", float(COMPASS), "where that ends on the ground, from its compass (source set 2)"),
    Wanted("EK3_SRC3_YAW", float(GYROS), "where that ends in flight, from gyros and GNSS (source set 3)"),
    *(
        Wanted(f"EK3_SRC{number}_{what}", value, "and the rest as in set 1", like=f"EK3_SRC1_{what}")
        for number in (2, 3)
        for what, value in (("POSXY", 3.0), ("VELXY", 3.0), ("POSZ", 1.0), ("VELZ", 3.0))
    ),
)
_MAGNETOMETERS: Final = ("EKF2_MAG_TYPE", "SYS_HAS_MAG", "EKF2_SENS_EN")
SCRIPT: Final = "CMPG_HEADING"
"""Of the script (companion/lua): it is there, and 1 where it sees to the heading."""
_PX4: Final = (
    Wanted("EKF2_EV_CTRL", float(EV_YAW), "EKF2 takes its heading from external vision", bits=True),
    Wanted("EKF2_EV_NOISE_MD", 0.0, "with the sigma that we send"),
    Wanted("EKF2_EVA_NOISE", 0.05, "as long as that is above 3 deg"),
    Wanted("EKF2_EV_DELAY", 0.0, "our stamps are those of the samples", optional=True),
)
WANTED: Final[dict[Firmware, tuple[Wanted, ...]]] = {"ardupilot": _ARDUPILOT, "px4": _PX4}

NETS: Final[dict[Net, str]] = {
    "script": "if our heading ends in flight, the script goes on by gyros and GNSS within a second",
    "command": "if our heading ends, the companion asks for gyros and GNSS, but not if its board dies (companion lua)",
    "autopilot": "if our heading ends, the autopilot goes back to its magnetometer",
    "none": "if our heading ends there is none: fly only where you can land by hand",
}
RISKS: Final[dict[Firmware, tuple[str, ...]]] = {
    "ardupilot": ("it will not arm while the stream is away (VisOdom: not healthy)",),
    "px4": ("EKF2 believes the companion's heading beside its magnetometer, and resets to it where the two disagree",),
}


def read_for(firmware: Firmware | None) -> list[str]:
    """What `changes_for` and `net_of` look at.

    Raises:
        AutopilotError: as `wanted_for`.
    """
    wanted = [name for one in wanted_for(firmware) for name in (one.parameter, one.like) if name]
    return [*wanted, *((SCRIPT,) if firmware == "ardupilot" else _MAGNETOMETERS)]


def net_of(firmware: Firmware, found: Mapping[str, float]) -> Net:
    """What is there when our heading ends, of parameters as they were read."""
    if firmware == "px4":
        return "none" if without_compass(firmware, found) else "autopilot"
    if (found.get("EK3_SRC2_YAW"), found.get("EK3_SRC3_YAW")) != (COMPASS, GYROS) or not found.get("EK3_SRC3_VELXY"):
        return "none"
    return "script" if found.get(SCRIPT) == 1.0 else "command"


def without_compass(firmware: Firmware, found: Mapping[str, float]) -> str | None:
    """The parameter that leaves PX4 without a compass in flight; None if it has one, or does not need it."""
    if firmware != "px4":
        return None
    if found.get("SYS_HAS_MAG") == 0.0:
        return "SYS_HAS_MAG = 0"
    if (kind := found.get("EKF2_MAG_TYPE", 0.0)) not in (0.0, 1.0):
        return f"EKF2_MAG_TYPE = {kind:g}"
    return None if int(found.get("EKF2_SENS_EN", MAGNETOMETER)) & MAGNETOMETER else "bit 10 of EKF2_SENS_EN"


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
        after = wanted.after(found)
        if not same_float32(before, after):
            changes.append(Change(wanted.parameter, before, after))
    return changes
