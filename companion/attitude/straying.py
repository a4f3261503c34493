"""Detect a heading that turns while other gyros do not, by the rule of the script on the flight controller."""

from __future__ import annotations

import math
from typing import Final

STRAYS_RAD: Final = math.radians(5.0)
WITHIN_S: Final = 4.0
"""Time in which the sum fades: a drift of 1.25 deg/s goes unnoticed, and the compass corrects it."""
SIGMAS: Final = 3.0
"""Allowed turn in sigmas of the heading: the compass may correct a poorly known one."""
SCALES: Final = 0.01
"""Share of a turn by which two gyros may differ."""
LATE_S: Final = 0.03
"""Usual difference of the two times."""
LONGEST_STEP_S: Final = 0.25
"""Longest step that is compared: it hides a turn to and fro."""


class HeadingDriftMonitor:
    """Sums the turn of the heading less that of the gyros; `add` at every instant with both."""

    def __init__(self) -> None:
        self.strayed_rad = 0.0
        """Recent turn of the heading less that of the gyros."""
        self.is_too_far = False
        self._last: tuple[float, float, float] | None = None
        self._turned_rad = self._sigma_rad = self._apart_rad = 0.0

    def skip(self) -> None:
        """Skip the step to the next instant, as the delays of its ends differ."""
        self._last = None

    def add(self, t_s: float, heading_rad: float, sigma_rad: float, rate_rad_s: float, late_s: float = 0.0) -> None:
        """Add a heading with its sigma, and the rate of the other gyros about the vertical; `late_s`: extra delay."""
        before, self._last = self._last, (t_s, heading_rad, rate_rad_s)
        if before is None:
            self._sigma_rad = max(self._sigma_rad, sigma_rad)
            return
        passed_s = t_s - before[0]
        kept = 1.0 - passed_s / WITHIN_S if 0.0 < passed_s < WITHIN_S else 0.0
        self.strayed_rad *= kept
        self._turned_rad *= kept
        self._apart_rad *= kept
        self._sigma_rad = max(self._sigma_rad * kept, sigma_rad)
        if 0.0 < passed_s <= LONGEST_STEP_S:
            by_gyros = 0.5 * (rate_rad_s + before[2]) * passed_s
            heading = math.remainder(heading_rad - before[1], 2.0 * math.pi)
            self.strayed_rad += heading - by_gyros
            self._turned_rad += abs(by_gyros)
            self._apart_rad = max(self._apart_rad, late_s * max(abs(rate_rad_s), abs(heading / passed_s)))
        apart = LATE_S * abs(rate_rad_s) + self._apart_rad
        allowed = max(STRAYS_RAD, SIGMAS * self._sigma_rad) + SCALES * self._turned_rad + apart
        self.is_too_far = abs(self.strayed_rad) > allowed
