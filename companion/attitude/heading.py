"""The heading's slow correction by a compass: a scalar, gated, that never touches the tilt.

A device's own heading leans on its own pendulum and is worth nothing while the aircraft accelerates or stands steep.
Method section 3, "tilt-compensated heading".
"""

from __future__ import annotations

import math
from typing import Final

TAU_S: Final = 9.0
"""Time constant of the correction; the first readings after an alignment without heading count more."""
GATE_SIGMAS: Final = 4.0
GATE_LEAST_RAD: Final = math.radians(10.0)
STEEP_RAD: Final = math.radians(60.0)
REFUSED_S: Final = 20.0
"""A compass that has been outside the gate for so long is worth a word to the pilot."""


def innovation_of_heading(heading_true_rad: float, yaw_rad: float) -> float:
    """How much the attitude's heading should turn, in [-pi, pi]."""
    return math.remainder(heading_true_rad - yaw_rad, 2.0 * math.pi)


class HeadingAid:
    """Decides what of an innovation is believed."""

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._refused_since_s: float | None = None

    def restart(self) -> None:
        """After an alignment."""
        self._last_s = self._refused_since_s = None

    def gain(self, t_s: float, innovation_rad: float, sigma_rad: float, compass_sigma_rad: float) -> float:
        """The share of the innovation to turn by; 0 when it is refused.

        Args:
            t_s: of the reading.
            innovation_rad: as the functions above give it.
            sigma_rad: of the heading that we have.
            compass_sigma_rad: of the reading.
        """
        gate = max(GATE_LEAST_RAD, GATE_SIGMAS * math.hypot(sigma_rad, compass_sigma_rad))
        if not abs(innovation_rad) <= gate:
            if self._refused_since_s is None:
                self._refused_since_s = t_s
            return 0.0
        since_s = 0.0 if self._last_s is None else max(0.0, t_s - self._last_s)
        self._last_s, self._refused_since_s = t_s, None
        # What is known badly is told by the first reading at once; after that the time constant rules.
        trust = sigma_rad**2 / (sigma_rad**2 + compass_sigma_rad**2) if sigma_rad > compass_sigma_rad else 0.0
        return max(trust, min(1.0, since_s / TAU_S))

    def refused_for_s(self, t_s: float) -> float:
        """How long it has been refused without a break."""
        return 0.0 if self._refused_since_s is None else t_s - self._refused_since_s
