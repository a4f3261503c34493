"""PX4's MAV_CMD_EXTERNAL_ATTITUDE_ESTIMATE: the heading once, at an alignment, for an EKF that has none yet.

Only firmware from about 1.17 on knows it (autopilots section 6), and an acknowledgement says little: whether it was
taken is told by the heading that the autopilot has afterwards.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.daemon.heading.difference import Difference
from companion.physics.units import DEG

logger = logging.getLogger(__name__)

EXTERNAL_ATTITUDE_ESTIMATE: Final = 620
"""Of MAVLink's development dialect."""
SEEN_WITHIN_S: Final = 8.0
SEEN_DEG: Final = 5.0


class ExternalEstimate:
    """Tells PX4 the heading at each alignment on the ground; `ask` and leave it alone."""

    def __init__(self, vehicle: Vehicle, difference: Difference) -> None:
        self.outcome: str | None = None
        """What became of the last one, for people; None: none was needed."""
        self._vehicle, self._difference = vehicle, difference
        self._unsupported_at_boot: int | None = None

    async def tell(self, attitude: Attitude) -> None:
        """Send it and see what comes of it."""
        vehicle = self._vehicle
        if vehicle.firmware != "px4" or vehicle.arm_state is not ArmState.DISARMED:
            return
        if self._unsupported_at_boot == vehicle.boots:
            return
        roll, pitch = attitude.roll_rad / DEG % 360.0, attitude.pitch_rad / DEG % 360.0
        sigma_roll, sigma_pitch, sigma_yaw = (sigma / DEG for sigma in attitude.sigma_rad)
        yaw = attitude.yaw_rad / DEG % 360.0
        tilt_sigma = max(sigma_roll, sigma_pitch)
        result = await vehicle.commands.send(
            EXTERNAL_ATTITUDE_ESTIMATE, roll, pitch, yaw, tilt_sigma, 0.0, 0.0, sigma_yaw, timeout_s=1.5
        )
        if result == mavlink.MAV_RESULT_UNSUPPORTED:
            self._unsupported_at_boot = vehicle.boots
            self._note("this PX4 does not take a heading by command; the stream alone gives it")
        elif result != mavlink.MAV_RESULT_ACCEPTED:
            self._note("PX4 did not answer to the heading by command" if result is None else "PX4 refused the heading")
        else:
            self._note(
                "heading given to PX4" if await self._seen() else "PX4 acknowledged the heading and kept its own"
            )

    async def _seen(self) -> bool:
        loop = asyncio.get_running_loop()
        end_s = loop.time() + SEEN_WITHIN_S
        while loop.time() < end_s:
            await asyncio.sleep(0.5)
            if self._difference.is_known(loop.time()) and abs(self._difference.heading_rad) < SEEN_DEG * DEG:
                return True
        return False

    def _note(self, words: str) -> None:
        if words != self.outcome:
            self.outcome = words
            logger.info("attitude: %s", words)
