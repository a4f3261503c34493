"""PX4's slots: the offsets of a sensor stand in the slot that holds its device id, CAL_GYROn_ID and CAL_ACCn_ID.

SCALED_IMU, 2 and 3 show the first, second and third pair of a gyro and an accelerometer, in the order in which their
drivers started, and no message says which device id that is (autopilots 4.1, 4.5). PX4 itself prefers the slot of the
same number, so the order of the slots is a good guess; whether it was right shows only in the telemetry after a write.
`SlotMemory` keeps what was learned that way, by device id.
"""

from __future__ import annotations

import dataclasses
from typing import Final

from companion.autopilot.parameters.change import Parameters
from companion.errors import AutopilotError
from companion.samples import Triad, Vector

SLOTS: Final = 4
NO_IMU: Final = 0
PREFIX: Final[dict[Triad, str]] = {"gyro": "CAL_GYRO", "accel": "CAL_ACC"}
WORDS: Final[dict[Triad, str]] = {"gyro": "gyro", "accel": "accelerometer"}


@dataclasses.dataclass(frozen=True, slots=True)
class Slot:
    """One slot that holds a device id."""

    number: int
    device_id: int
    enabled: bool

    @property
    def bus(self) -> int:
        """Type of the bus that the device id names."""
        return self.device_id & 0b111


async def read_slots(parameters: Parameters, sensor: Triad) -> tuple[Slot, ...]:
    """Read all slots that hold a device id, in order.

    Raises:
        AutopilotError: as `Parameters.read_optional`.
    """
    found: list[Slot] = []
    for number in range(SLOTS):
        device_id = await parameters.read_integer(f"{PREFIX[sensor]}{number}_ID")
        if device_id:
            priority = await parameters.read_integer(f"{PREFIX[sensor]}{number}_PRIO")
            found.append(Slot(number, device_id, enabled=priority != 0))
    return tuple(found)


class SlotMemory:
    """Device of each IMU as learned; since the last restart, offsets in use and rivals that act."""

    def __init__(self) -> None:
        self._instance_of: dict[tuple[Triad, int], int] = {}
        self._enabled: dict[Triad, int] = {}
        self._in_use: dict[tuple[str, str, str], tuple[int, Vector]] = {}
        self.rivals: dict[str, int] = {}

    def learn(self, sensor: Triad, device_id: int, instance: int) -> None:
        """Note that the offsets in the slot of this device act on this IMU's telemetry (NO_IMU: on none)."""
        for other in [key for key, known in self._instance_of.items() if key[0] == sensor and known == instance]:
            if instance != NO_IMU:
                del self._instance_of[other]
        self._instance_of[sensor, device_id] = instance

    def known(self, sensor: Triad, device_id: int) -> int | None:
        """Return the IMU that a device was seen to be; NO_IMU: none in the telemetry."""
        return self._instance_of.get((sensor, device_id))

    def holds_strangers(self, sensor: Triad, imus: int) -> bool:
        """Check for more slots in use than IMUs: one of them may be of a sensor that is not there."""
        return self._enabled.get(sensor, 0) > imus

    def forget(self) -> None:
        """Forget what was learned: it cannot be true."""
        self._instance_of.clear()

    def brought_into_use(self, names: tuple[str, str, str], vector: Vector, boots: int) -> None:
        """Note that a vector of offsets was written by a far step, so that the firmware uses it until a restart."""
        self._in_use[names] = (boots, vector)

    def in_use(self, names: tuple[str, str, str], vector: Vector, boots: int) -> bool:
        """Check that the firmware is known to use this vector."""
        return self._in_use.get(names) == (boots, vector)

    def choose(self, sensor: Triad, instance: int, slots: tuple[Slot, ...], like: int | None = None) -> Slot:
        """Choose the slot of an IMU (1 to 3) of all that hold a device id: the known one, else the best guess.

        `like`: the device id of the IMU's other half; of a chip that is both, it is the same.

        Raises:
            AutopilotError: there is none.
        """
        prefix, word = PREFIX[sensor], WORDS[sensor]
        self._enabled[sensor] = sum(slot.enabled for slot in slots)
        if not slots:
            raise AutopilotError(
                f"PX4 has no {word} in {prefix}0_ID to {prefix}{SLOTS - 1}_ID: calibrate its {word}s once with the"
                " ground station, so that it knows them"
            )
        own = next((slot for slot in slots if self.known(sensor, slot.device_id) == instance), None)
        if own is None:
            free = [slot for slot in slots if self.known(sensor, slot.device_id) is None] or [
                slot for slot in slots if self.known(sensor, slot.device_id) == NO_IMU
            ]
            own = next((slot for slot in free if slot.device_id == like), None)
            if own is None and instance <= len(slots) and slots[instance - 1] in free:
                own = slots[instance - 1]
            if own is None and instance <= len(slots):
                own = next((slot for slot in free if slot.enabled), None)
        if own is None:
            raise AutopilotError(
                f"the autopilot has no IMU {instance}: only {len(slots)} of {prefix}0_ID to {prefix}{SLOTS - 1}_ID"
                f" hold a {word}"
            )
        if not own.enabled:
            raise AutopilotError(f"IMU {instance}: {prefix}{own.number}_PRIO = 0, so PX4 has this {word} switched off")
        return own
