"""The messages that carry the attitude, at their rates."""

from __future__ import annotations

import math
from typing import Final

from companion.attitude.estimator import Attitude
from companion.autopilot.telemetry.attitude_messages import attitude_messages, microseconds, vision_position_estimate
from companion.autopilot.vehicle.vehicle import Firmware
from companion.links.mavlink.link import MavlinkLink

SHORTEST_S: Final = 0.02
"""ArduPilot drops what comes sooner after the one before (autopilots section 6)."""
SHOWN_EVERY_S: Final = 0.2
"""For people: autopilots forward these to radios that carry little."""
RATE_SPAN_S: Final = 2.0
_ROUNDING_S: Final = 1e-6


class Sender:
    """Sends the autopilot what is due; ground stations too, if `full`."""

    def __init__(self, link: MavlinkLink, rate_hz: float, *, full: bool) -> None:
        self.sent = 0
        self.rate_hz = 0.0
        """Of late."""
        self._link, self._full = link, full
        self._period_s = max(1.0 / rate_hz, SHORTEST_S)
        self._next_s = self._last_s = self._left_s = self._shown_s = -math.inf
        self._counted = (-math.inf, 0)

    def is_due(self, t_s: float, now_s: float) -> bool:
        """Whether the attitude at `t_s` is to be sent; neither stamps nor packets may come closer than allowed."""
        return (
            t_s >= self._next_s - _ROUNDING_S
            and t_s - self._last_s >= SHORTEST_S - _ROUNDING_S
            and now_s - self._left_s >= SHORTEST_S - _ROUNDING_S
            and microseconds(t_s) > microseconds(max(self._last_s, 0.0))
        )

    def send(self, firmware: Firmware, attitude: Attitude, reset_counter: int, now_s: float) -> None:
        """Send it, and what goes with it."""
        t_s = attitude.t_s
        # The rhythm is kept on the average, but what a gap has missed is not made up for.
        self._next_s = self._next_s + self._period_s if self._next_s > t_s - self._period_s else t_s + self._period_s
        self._last_s, self._left_s = t_s, now_s
        if self._link.send(vision_position_estimate(firmware, attitude, reset_counter)):
            self.sent += 1
        if self._full and now_s - self._shown_s >= SHOWN_EVERY_S:
            self._shown_s = now_s
            for message in attitude_messages(attitude):
                self._link.send(message)

    def count(self, now_s: float) -> None:
        """Work out the rate now and then."""
        since_s, before = self._counted
        if now_s - since_s >= RATE_SPAN_S:
            self.rate_hz = (self.sent - before) / (now_s - since_s) if since_s > -math.inf else 0.0
            self._counted = (now_s, self.sent)


def is_sane(attitude: Attitude) -> bool:
    """Whether everything in it is a number."""
    return all(map(math.isfinite, (*attitude.quaternion, *attitude.sigma_rad, *attitude.rate_rad_s, attitude.t_s)))
