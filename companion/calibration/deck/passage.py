"""One second of a moving IMU, integrated: how far it has turned, and what it has felt, as functions of its bias.

Rates are integrated sample by sample as rotations, so that coning (roll and pitch out of step turn the heading) and
sculling are in the result and not in its error. Forster, Carlone, Dellaert, Scaramuzza, IEEE Trans. Robotics 33(1),
2017, section VI, in matrices.
"""

from __future__ import annotations

import msgspec
import numpy as np

from companion.physics.frames import Floats, Matrix, rotations, running_products, skews


class Passage(msgspec.Struct, frozen=True):
    """From one knot to the next; "start" is the body's frame (FRD) at its beginning."""

    span_s: float
    turn: Matrix
    """(3, 3) from the body's axes at the end to those at the start, as the gyros have it."""
    turned: Matrix
    """(3, 3) integral of that over the time, in s: a bias b turns the start by -turned @ b."""
    velocity_m_s: Floats
    """(3,) integral of the specific force in the axes of the start."""
    velocity_by_bias: Matrix
    """(3, 3) d velocity / d (gyro bias): m/s per rad/s."""


def passage(times_s: Floats, rates_rad_s: Floats, forces_m_s2: Floats) -> Passage:
    """Integrate n + 1 samples, of which the first was the last one of the passage before (trapezoids).

    Times (n + 1,) ascend, n is at least 1; rates and forces are (n + 1, 3) in the body's axes.
    """
    steps = np.diff(times_s)
    rates = (rates_rad_s[1:] + rates_rad_s[:-1]) / 2.0
    turns = running_products(rotations(rates * steps[:, None]))
    whole = np.concatenate([np.eye(3)[None], turns])
    half = (whole[1:] + whole[:-1]) / 2.0 * steps[:, None, None]
    turned = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(half, axis=0)])
    felt = np.einsum("nij,nj->ni", whole, forces_m_s2)
    by_bias = skews(felt) @ turned
    return Passage(
        span_s=float(times_s[-1] - times_s[0]),
        turn=turns[-1],
        turned=turned[-1],
        velocity_m_s=((felt[1:] + felt[:-1]) / 2.0 * steps[:, None]).sum(axis=0),
        velocity_by_bias=((by_bias[1:] + by_bias[:-1]) / 2.0 * steps[:, None, None]).sum(axis=0),
    )
