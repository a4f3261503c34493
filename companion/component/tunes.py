"""Tunes on the autopilot's buzzer, for an operator who looks at no screen.

Both firmwares take PLAY_TUNE (258) in QBasic's notes (ArduPilot `AP_Notify/ToneAlarm.cpp` and `MMLPlayer.cpp`, PX4
`mavlink_receiver.cpp` and `lib/tunes`). Neither acknowledges a tune, and both play it in flight too: no tune is sent
then. PX4 garbles a tune that comes before the last one has ended.
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
"""Time between the beginnings of two tunes: the longest takes 1.1 s."""
STALE_S: Final = 3.0
"""Age at which a tune that could not be played is dropped."""


class Tune(enum.Enum):
    """Tunes by meaning; their notes are at most 29 characters, the first field of PLAY_TUNE."""

    HOLD_STILL = "MFT200O4A2"
    """One long note."""
    NEXT = "MFT200O4E8A8"
    """Two short notes, upwards: this stand is done."""
    WRONG = "MFT200O4E8C8E8C8E8C8"
    """To and fro: not the requested pose."""
    DONE = "MFT200O4C8E8G8>C4"
    """Upwards: all is done."""
    FAILED = "MFT200O5C8<G8E8C2"
    """Downwards."""


class Tunes:
    """Plays while disarmed and `wanted`; `step` sends what is due, and `woken` is set when there is something."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, wanted: Callable[[], bool], woken: asyncio.Event) -> None:
        self._link, self._vehicle, self._wanted, self._woken = link, vehicle, wanted, woken
        self._waiting: tuple[Tune, float] | None = None
        """The latest tune, and the time of its request."""
        self._free_s = -math.inf

    def play(self, tune: Tune) -> None:
        """Play a tune as soon as the one before is over; only the latest waits."""
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
