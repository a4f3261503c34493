"""What in the autopilot itself overwrites biases that we have written: found, and said with what it does."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final, Literal

from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.client import ParameterClient, read_integer
from companion.autopilot.vehicle.vehicle import Firmware

Acts = Literal["at a start", "while still", "after a flight"]


@dataclasses.dataclass(frozen=True, slots=True)
class Rival:
    """A parameter that is switched on, and what that means for offsets of ours."""

    parameter: str
    value: int
    acts: Acts
    accelerometers: bool
    """Whether it overwrites accelerometer offsets too; gyro offsets it always does."""
    words: str

    @property
    def name(self) -> str:
        """For people: IMU_GYRO_CAL_EN=1."""
        return f"{self.parameter}={self.value}" if self.value else f"{self.parameter} (on until reboot)"

    @property
    def until_boot(self) -> bool:
        """Switched off, and acting all the same until the next boot."""
        return self.value == 0


@dataclasses.dataclass(frozen=True, slots=True)
class _Kind:
    acts: Acts
    what: str
    accelerometers: bool = False
    from_boot: bool = False
    """Whether only a boot looks at the parameter, so that switching it off stops nothing before that."""


_RIVALS: Final[dict[Firmware, dict[str, _Kind]]] = {
    "ardupilot": {
        "INS_GYR_CAL": _Kind("at a start", "the next boot measures the gyros itself and overwrites these gyro offsets"),
    },
    "px4": {
        "IMU_GYRO_CAL_EN": _Kind(
            "while still",
            "while disarmed and still PX4 overwrites gyro offsets that seem more than 0.57 deg/s (0.01 rad/s) off",
            from_boot=True,
        ),
        "SENS_IMU_AUTOCAL": _Kind(
            "after a flight",
            "after a flight PX4 overwrites gyro offsets that seem more than 0.57 deg/s (0.01 rad/s) off, and"
            " accelerometer offsets more than 5 mg (0.05 m/s^2)",
            accelerometers=True,
        ),
    },
}
"""By parameter: what any value but 0 means (autopilots 1.5, 4.3)."""


def rivals_of(firmware: Firmware | None) -> tuple[str, ...]:
    """The parameters that may be rivals on a firmware."""
    return tuple(_RIVALS.get(firmware or "other", {}))


class RivalMemory:
    """Which rivals were seen switched on since the autopilot's last boot."""

    def __init__(self) -> None:
        self._seen: dict[str, int] = {}

    def saw(self, parameter: str, boots: int) -> None:
        """It is on."""
        self._seen[parameter] = boots

    def was_on(self, parameter: str, boots: int) -> bool:
        """Whether it was on since this boot."""
        return self._seen.get(parameter) == boots


async def read_rivals(parameters: ParameterClient, memory: RivalMemory | None = None) -> tuple[Rival, ...]:
    """Those that are switched on, and those that were and act until the next boot."""
    found: list[Rival] = []
    for name, kind in _RIVALS.get(parameters.vehicle.firmware or "other", {}).items():
        value = await read_integer(parameters, name)
        if value:
            words = f"{name} = {value}: {kind.what}; set it to 0 to keep them (push.stop_rivals = true does)"
            found.append(Rival(name, value, kind.acts, kind.accelerometers, words))
            if memory is not None:
                memory.saw(name, parameters.vehicle.boots)
        elif kind.from_boot and memory is not None and memory.was_on(name, parameters.vehicle.boots):
            words = f"{name} is off from the next boot on: until then {kind.what}; reboot the autopilot"
            found.append(Rival(name, 0, kind.acts, kind.accelerometers, words))
    return tuple(found)


def stop(rivals: Sequence[Rival]) -> list[Change]:
    """What to write to switch them off."""
    return [Change(rival.parameter, rival.value, 0.0) for rival in rivals if not rival.until_boot]
