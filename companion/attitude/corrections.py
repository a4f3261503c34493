"""The two slow corrections of the attitude: the tilt by specific force, the heading by a compass.

Levelling has the form of VQF (Laidig and Seel, Information Fusion 91:187-204, 2023; method 3.7): specific force
is low-passed in a frame that only gyro errors turn. There manoeuvre accelerations average out over the time constant
while gravity stays, so the time constant may be as long as the gyro biases are good: a bias b leaves b * tau of tilt.
What does not average out, a turn or a climb that lasts, shows itself by the length of the force: where it is not g,
less is believed.

The compass corrects a scalar, gated, and never touches the tilt: a device's own heading leans on its own pendulum and
is worth nothing while the aircraft accelerates or stands steep (method 3.5).
"""

from __future__ import annotations

import math
from typing import Final

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    from_rotation_vector,
    multiply,
    normalised,
    rotate,
    shortest_arc,
)

FORCE_SMOOTHED_S: Final = 1.0
"""The time over which the length of specific force is judged: vibration and gusts are shorter."""
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
        self.ned_from_e = normalised(multiply(from_rotation_vector((0.0, 0.0, angle_rad)), self.ned_from_e))


TAU_S: Final = 9.0
"""Time constant of the correction; the first readings after an alignment without heading count more."""
GATE_SIGMAS: Final = 4.0
GATE_LEAST_RAD: Final = math.radians(10.0)
STEEP_RAD: Final = math.radians(60.0)
FIRST_S: Final = 0.1
"""What the first reading stands for."""
BADLY: Final = 1.5
"""A heading is known badly from so many sigmas of the compass on."""
REFUSED_S: Final = 20.0
"""A compass that has been outside the gate for so long is worth a word to the pilot."""


class HeadingAid:
    """Decides what of an innovation is believed."""

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._refused_since_s: float | None = None

    def gain(self, t_s: float, innovation_rad: float, sigma_rad: float, compass_sigma_rad: float) -> float:
        """The share of the innovation to turn by, `sigma_rad` being that of our heading; 0: it is refused."""
        gate = max(GATE_LEAST_RAD, GATE_SIGMAS * math.hypot(sigma_rad, compass_sigma_rad))
        if not abs(innovation_rad) <= gate:
            if self._refused_since_s is None:
                self._refused_since_s = t_s
            return 0.0
        since_s = FIRST_S if self._last_s is None else max(0.0, t_s - self._last_s)
        self._last_s, self._refused_since_s = t_s, None
        # What is known badly is told by the first reading at once; after that the time constant rules. A heading that
        # the compass holds is as uncertain as it is, and what the gyros add in that time: that is not known badly.
        badly_rad = BADLY * compass_sigma_rad
        trust = 1.0 - (badly_rad / sigma_rad) ** 2 if sigma_rad > badly_rad else 0.0
        return max(trust, min(1.0, since_s / TAU_S))

    def refused_for_s(self, t_s: float) -> float:
        """How long it has been refused without a break."""
        return 0.0 if self._refused_since_s is None else t_s - self._refused_since_s
