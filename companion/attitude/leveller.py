"""Levelling by specific force, low-passed in a frame that does not turn with the aircraft.

The form is that of VQF (Laidig and Seel, Information Fusion 91:187-204, 2023; method section 3): in a frame that only
gyro errors turn, manoeuvre accelerations average out over the time constant while gravity stays, so the time constant
may be as long as the gyro biases are good: a bias b leaves b * tau of tilt. What does not average out, a turn or a
climb that lasts, shows itself by the length of the force: where it is not g, less is believed.
"""

from __future__ import annotations

import math
from typing import Final

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    about_down,
    multiply,
    normalised,
    rotate,
    shortest_arc,
)

FORCE_SMOOTHED_S: Final = 1.0
"""Over so long the force's length is looked at: vibration and gusts are shorter."""
DOUBTED_SHARE: Final = 0.03
"""At so much of g off, half is believed: three times what an uncalibrated accelerometer's scale may be off by, and
the 15 degrees of bank from which on a turn tilts more than a calibrated gyro drifts in its time."""
_UP: Final = (0.0, 0.0, -1.0)


class Leveller:
    """Keeps the turn from E to NED that puts the mean specific force upright."""

    def __init__(self, gravity_m_s2: float) -> None:
        self.gravity_m_s2 = gravity_m_s2
        self.ned_from_e: Quaternion = IDENTITY
        """Of tilt and heading together; the heading aid turns it about the vertical."""
        self.doubt = 0.0
        """How far the force's length has been from gravity, over `FORCE_SMOOTHED_S`, as a share of g."""
        self._force: Triple = (0.0, 0.0, -gravity_m_s2)
        self._slope: Triple = (0.0, 0.0, 0.0)
        self._length = gravity_m_s2

    def restart(self) -> None:
        """E is NED now, and upright is as it says."""
        self.ned_from_e = IDENTITY
        self._force, self._slope = (0.0, 0.0, -self.gravity_m_s2), (0.0, 0.0, 0.0)
        self._length, self.doubt = self.gravity_m_s2, 0.0

    def update(self, force_m_s2: Triple, span_s: float, tau_s: float) -> float:
        """Take the mean specific force (3,) in E over `span_s`; return the share of it that was believed.

        The low-pass is of the second order, Butterworth's, with natural frequency sqrt(2) / tau, as its own states, so
        that tau may change at any time.
        """
        x, y, z = force_m_s2
        length = math.sqrt(x * x + y * y + z * z)
        self._length += (length - self._length) * min(1.0, span_s / FORCE_SMOOTHED_S)
        self.doubt = abs(self._length - self.gravity_m_s2) / self.gravity_m_s2
        believed = 1.0 / (1.0 + (self.doubt / DOUBTED_SHARE) ** 2)
        omega = math.sqrt(2.0) / tau_s
        # To believe less is to let less time pass: the low-pass stands still with all its states. Semi-implicit, hence
        # stable up to omega * step = 1; the longest span is far shorter than the shortest tau.
        step = min(believed * span_s, 0.5 / omega)
        damped, pulled = 1.0 / (1.0 + math.sqrt(2.0) * omega * step), omega * omega * step
        fx, fy, fz = self._force
        sx, sy, sz = self._slope
        sx, sy, sz = (
            (sx + pulled * (x - fx)) * damped,
            (sy + pulled * (y - fy)) * damped,
            (sz + pulled * (z - fz)) * damped,
        )
        self._slope = (sx, sy, sz)
        self._force = (fx + sx * step, fy + sy * step, fz + sz * step)
        found = rotate(self.ned_from_e, self._force)
        self.ned_from_e = normalised(multiply(shortest_arc(found, _UP), self.ned_from_e))
        return believed

    def turn_heading(self, angle_rad: float) -> None:
        """Turn everything clockwise by so much about the vertical."""
        self.ned_from_e = normalised(multiply(about_down(angle_rad), self.ned_from_e))
