"""TIMESYNC: the autopilot asks what time it is with us, and gets an answer at once.

PX4 uses our time stamps only after 500 such exchanges (50 s at its 10 Hz) of less than 10 ms each; until then it takes
what arrives for new (autopilots 4.5). ArduPilot asks every 10 s, for its log.
"""

from __future__ import annotations

import asyncio

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink


class TimesyncResponder:
    """Answers the latched autopilot, with the clock that stamps what we send; ask for it with `close` to stop."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.answered = 0
        self._link, self._vehicle = link, vehicle
        self.close = link.subscribe(mavlink.MAVLink_timesync_message, self._on_timesync)

    def _on_timesync(self, message: mavlink.MAVLink_timesync_message, _t_s: float) -> None:
        if message.tc1 == 0 and self._vehicle.sent(message):
            now_ns = round(asyncio.get_running_loop().time() * 1e9)
            self._link.send(mavlink.MAVLink_timesync_message(now_ns, message.ts1))
            self.answered += 1
