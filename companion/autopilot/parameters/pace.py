"""Waiting on the autopilot's own clock, which a simulated one on a busy machine lets run slower than ours.

What an autopilot does "at most once a second" (autopilots 9.2) it does by that clock. To conclude after so many of our
seconds that it has ignored a value would blame a slow simulator for something that it had no time to do.
"""

from __future__ import annotations

import asyncio
import dataclasses
from typing import Final

from companion.autopilot.vehicle.vehicle import Vehicle

SLOWEST: Final = 5.0
"""The most of our seconds that are given for one of the autopilot's."""
POLL_S: Final = 0.05


@dataclasses.dataclass(frozen=True, slots=True)
class Moment:
    """An instant on both clocks."""

    t_s: float
    boot_s: float | None
    """The autopilot's time since its boot, as it was heard last."""
    boots: int


def moment(vehicle: Vehicle) -> Moment:
    """Now."""
    return Moment(asyncio.get_running_loop().time(), vehicle.boot.latest_s, vehicle.boots)


def has_passed(vehicle: Vehicle, since: Moment, seconds: float) -> bool:
    """Whether so much time has gone by on both clocks; or on ours alone, where the other tells nothing."""
    gone_s = asyncio.get_running_loop().time() - since.t_s
    if gone_s < seconds:
        return False
    boot_s = vehicle.boot.latest_s
    if since.boot_s is None or boot_s is None or vehicle.boots != since.boots or not vehicle.alive:
        return True
    return boot_s - since.boot_s >= seconds or gone_s >= SLOWEST * seconds


async def let_pass(vehicle: Vehicle, since: Moment, seconds: float) -> None:
    """Wait until `has_passed`."""
    await asyncio.sleep(since.t_s + seconds - asyncio.get_running_loop().time())
    while not has_passed(vehicle, since, seconds):
        await asyncio.sleep(POLL_S)
