"""The autopilot's own estimate of the gyro biases, as ArduPilot tells it: AHRS (#163), omegaI = minus that estimate.

After a step in the offsets EKF3 goes on with its old estimate, is wrong by minus the step, and turns the heading by
that times 17 to 25 s before it has learned (autopilots 1.7, 9.3.1). With right offsets nothing is left to estimate, so
what omegaI still shows is how far it is from settled.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.links.system.waiting import comes
from companion.physics.units import DEG

ADJUSTING: Final = "EKF adjusting"
SETTLED_RAD_S: Final = 0.02 * DEG
"""Per axis: 72 deg/h. An EKF whose bias has just been reset wanders up to 52 deg/h on the ground (autopilots
9.3.1); and 72 deg/h times 25 s turn the heading by 0.5 deg, less than a compass knows."""

_AHRS: Final[int] = mavlink.MAVLINK_MSG_ID_AHRS
_RATE_HZ: Final = 4.0
_MEAN_S: Final = 2.0
_OLDEST_S: Final = 10.0
_FIRST_WITHIN_S: Final = 1.5
_ASKS: Final = 3
_LOOK_S: Final = 0.25


class EkfWatch:
    """Asks for AHRS while somebody wants to know, and averages what comes over 2 s."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._seen: deque[tuple[float, float, float, float]] = deque(maxlen=2048)
        self._arrived = asyncio.Event()
        self._asked = False
        vehicle.hear(mavlink.MAVLink_ahrs_message, self._on_ahrs)

    async def bias_rad_s(self) -> float | None:
        """The largest axis of the estimate, mean of the last 2 s (or less, where less has come).

        None: this autopilot does not tell.
        """
        for _ in range(_ASKS):
            if (found := self._mean(0.0)) is not None:
                return found
            self._ask()
            self._arrived.clear()
            await comes(self._arrived, _FIRST_WITHIN_S)
        return self._mean(0.0)

    async def settle(self, within_s: float, go_on: Callable[[str], None]) -> str | None:
        """Wait until the estimate has settled (None), armed or restarted: what a pilot should know.

        `go_on` is told every look how far it is; what it raises ends the waiting too.
        """
        loop = asyncio.get_running_loop()
        self._seen.clear()  # what came before the write says nothing
        boots, give_up_s = self._vehicle.boots, loop.time() + within_s
        if await self.bias_rad_s() is None and self._vehicle.boots == boots:
            return (
                "wait 2 min before take-off, or restart the autopilot: it does not tell whether its EKF has settled"
                " (no AHRS message)"
            )
        asked_s = loop.time()
        while True:
            if self._vehicle.boots != boots:
                return "the autopilot restarted while its EKF settled"
            bias = self._mean(_MEAN_S)
            if bias is not None and bias <= SETTLED_RAD_S:
                return None
            if self._vehicle.arm_state is ArmState.ARMED:
                return f"the heading may turn for a minute: armed before the EKF had settled ({_words(bias)})"
            if loop.time() >= give_up_s:
                return (
                    f"the EKF has not settled within {within_s:.0f} s ({_words(bias)}): wait, or restart the autopilot"
                )
            go_on(f"{ADJUSTING}: {give_up_s - loop.time():.0f} s at most")
            silent_s = loop.time() - (self._seen[-1][0] if self._seen else asked_s)
            if min(silent_s, loop.time() - asked_s) > _FIRST_WITHIN_S:
                asked_s = loop.time()
                self._ask()
            await asyncio.sleep(_LOOK_S)

    def stop(self) -> None:
        """No more AHRS on our account: back to the autopilot's own rate."""
        if self._asked and self._vehicle.alive:
            self._asked = False
            self._vehicle.commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, _AHRS, 0.0)

    def _ask(self) -> None:
        self._asked = True
        self._vehicle.commands.request_message_interval(_AHRS, _RATE_HZ)

    def _mean(self, at_least_s: float) -> float | None:
        """Of the last 2 s, or of as much more as it takes on a busy line to see so long; None when it was not."""
        now_s = asyncio.get_running_loop().time()
        taken: list[tuple[float, float, float, float]] = []
        for each in reversed(self._seen):
            if taken and (now_s - each[0] > _OLDEST_S or taken[0][0] - taken[-1][0] >= _MEAN_S):
                break
            taken.append(each)
        if not taken or now_s - taken[0][0] > _OLDEST_S or taken[0][0] - taken[-1][0] < at_least_s:
            return None
        return float(np.max(np.abs(np.mean([each[1:] for each in taken], axis=0))))

    def _on_ahrs(self, message: mavlink.MAVLink_ahrs_message, t_s: float) -> None:
        rates = (message.omegaIx, message.omegaIy, message.omegaIz)
        if all(map(math.isfinite, rates)):
            self._seen.append((t_s, *rates))
            self._arrived.set()


def _words(bias_rad_s: float | None) -> str:
    return "bias unknown" if bias_rad_s is None else f"{bias_rad_s / DEG:.2f} deg/s"
