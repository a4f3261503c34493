"""The autopilot's buzzer, for whoever looks at the aircraft and at no screen.

PLAY_TUNE (258) is what both firmwares take, in QBasic's notes (ArduPilot `AP_Notify/ToneAlarm.cpp` and `MMLPlayer.cpp`,
PX4 `mavlink_receiver.cpp` and `lib/tunes`). Neither says SUPPORTED_TUNES, which PLAY_TUNE_V2 would need; neither
acknowledges a tune, and both play it in flight too, so that it is for us to be silent then. ArduPilot breaks off
what it plays for a new tune; PX4 goes on in the middle of the new one, so that one is let end before the next.
"""

from __future__ import annotations

import asyncio
import enum
import math
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.heartbeats import ArmState
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink

APART_S: Final = 1.5
"""From the begin of one to the begin of the next: the longest takes 1.1 s."""
STALE_S: Final = 3.0
"""What could not be played for so long is no news any more."""


class Tune(enum.Enum):
    """What a tune means, and its notes: at most 29 characters, which PLAY_TUNE holds in its first field."""

    HOLD_STILL = "MFT200O4A2"
    """One long note."""
    NEXT = "MFT200O4E8A8"
    """Two short ones, upwards: this stand is done."""
    WRONG = "MFT200O4E8C8E8C8E8C8"
    """To and fro: not as it was asked for."""
    DONE = "MFT200O4C8E8G8>C4"
    """Upwards: all of it."""
    FAILED = "MFT200O5C8<G8E8C2"
    """Downwards."""


class Tunes:
    """Plays on the autopilot's buzzer while it is disarmed; `step` sends what may be sent now.

    `wanted`: whether people want to hear any; `woken` is set when there is something new to send.
    """

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, wanted: Callable[[], bool], woken: asyncio.Event) -> None:
        self._link, self._vehicle, self._wanted, self._woken = link, vehicle, wanted, woken
        self._waiting: tuple[Tune, float] | None = None
        """The latest, and when it was asked for."""
        self._free_s = -math.inf

    def play(self, tune: Tune) -> None:
        """Play it as soon as the one before is over; only the latest waits."""
        self._waiting = tune, asyncio.get_running_loop().time()
        self._woken.set()

    def step(self, now_s: float) -> float:
        """Send what is due; return when there is more to do (infinity: nothing waits)."""
        if self._waiting is None:
            return math.inf
        if now_s < self._free_s:
            return self._free_s
        tune, asked_s = self._waiting
        self._waiting = None
        if now_s - asked_s < STALE_S and self._wanted() and self._vehicle.arm_state is ArmState.DISARMED:
            assert self._vehicle.system_id is not None
            notes = tune.value.encode("ascii")
            target = self._vehicle.system_id, self._vehicle.component_id
            self._link.send(mavlink.MAVLink_play_tune_message(*target, notes, b""))
            self._free_s = now_s + APART_S
        return math.inf
