"""Which stands an alignment asks for, and whether the way the aircraft stands is the one asked for.

Pure: what the next stand should be, in words, from the stands so far.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.estimation.records.align_record import Kind
from companion.physics.frames import Array
from companion.physics.units import DEG

TURN_TOLERANCE_DEG: Final = 30.0
QUARTER_DEG: Final = 90.0
LEAST_TILT_DEG: Final = 15.0
"""A tilt tells scale and misalignment from bias by what a cosine loses: little, below this."""
APART_DEG: Final = 45.0
"""The least angle between two tilts to different sides."""
MOST_ASKEW_DEG: Final = 30.0
"""On its base: a slope, an aircraft that sits on its tail, and a board put in by eye."""
TILTS: Final = 4
LEVEL: Final = (0.0, 0.0, -1.0)
_SIN, _COS = math.sin(24.0 * DEG), math.cos(24.0 * DEG)
_TILTED: Final = {
    "nose up": (_SIN, 0.0, -_COS),
    "nose down": (-_SIN, 0.0, -_COS),
    "left side down": (0.0, _SIN, -_COS),
    "right side down": (0.0, -_SIN, -_COS),
}
HEADINGS: Final = 4
LEAST_SECONDS: Final = 6
LEANED_SIGMAS: Final = 5.0
BY_EYE_SIGMA_DEG: Final = 10.0
"""Of a turn that nobody counted and that was made as asked."""


@dataclasses.dataclass(frozen=True, slots=True)
class Plan:
    """What was asked for."""

    kind: Kind
    headings: int = 2
    """2: there, turned by 180 degrees, and on to the first; 4: every quarter turn."""
    back: bool = False
    """Of quarter turns: on to the first heading again, as a check."""

    @property
    def on_spot(self) -> int:
        """How many stands share the spot."""
        return HEADINGS + self.back if self.kind == "tilts" or self.headings == HEADINGS else 3

    @property
    def total(self) -> int:
        """How many stands there are."""
        return self.on_spot + (TILTS if self.kind == "tilts" else 0)


@dataclasses.dataclass(frozen=True, slots=True)
class Hold:
    """How the aircraft is to be held, for a picture."""

    up: tuple[float, float, float]
    """Up in its axes, forward, right, down; of length 1."""
    turn_deg: float = 0.0
    """By how much it is to be turned on its spot, clockwise from above."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """How the aircraft stood: up in its axes, shape (3,), and its heading, in degrees from the first stand's north."""

    up: Array
    heading_deg: float


def request(plan: Plan, taken: Sequence[Seen]) -> tuple[str, Hold]:
    """What the person at the aircraft should do now, and as a picture; up to a colon it is spoken aloud too."""
    number = len(taken)
    if number == 0:
        return "stand it on a firm, marked spot", Hold(LEVEL)
    if number >= plan.on_spot:
        done = [_side(taken[0].up, seen.up) for seen in taken[plan.on_spot :]]
        hold = Hold(next((up for side, up in _TILTED.items() if side not in done), LEVEL))
        if done:
            return f"tilt it to another side, prop it up: not {' or '.join(done)} again", hold
        return "tilt it 20 to 28 degrees, prop it up: nose up, nose down, left or right side down", hold
    hold = Hold(LEVEL, asked_turn_deg(plan, taken))
    if plan.on_spot >= HEADINGS:
        return f"turn it by {hold.turn_deg:.0f} degrees on its spot", hold
    if number == 1:
        return "turn it by 180 degrees, onto its marks", hold
    return "turn it the same way to its first marks", hold


def asked_turn_deg(plan: Plan, taken: Sequence[Seen]) -> float:
    """By how much it is to be turned after these stands."""
    if len(taken) >= plan.on_spot:  # a tilt
        return 0.0
    return _to_next_deg(taken, taken[-1]) if plan.on_spot >= HEADINGS else 180.0


def objection(plan: Plan, taken: Sequence[Seen], now: Seen) -> str | None:
    """Why this is not the stand that was asked for, and what to do; None when it is."""
    number = len(taken)
    if number == 0:
        askew_deg = _apart_deg(now.up, np.array(LEVEL))
        return f"tilted by {askew_deg:.0f} degrees: stand it on its base" if askew_deg > MOST_ASKEW_DEG else None
    first = taken[0]
    if number < plan.on_spot:
        turned = _wrapped(now.heading_deg - first.heading_deg)
        if plan.on_spot >= HEADINGS and number < HEADINGS:
            return _quarter(taken, now)
        wanted = 180.0 if number == 1 else 0.0
        off = _wrapped(turned - wanted)
        if abs(off) > TURN_TOLERANCE_DEG:
            return f"{abs(turned):.0f} degrees, not {wanted:.0f}: turn it by {abs(off):.0f} degrees more"
        return None
    tilt_deg = _apart_deg(now.up, first.up)
    if tilt_deg < LEAST_TILT_DEG:
        return f"tilted by {tilt_deg:.0f} degrees only: make it 20 to 28"
    for seen in taken[plan.on_spot :]:
        apart = abs(_wrapped(_azimuth(first.up, seen.up) - _azimuth(first.up, now.up)))
        if apart < APART_DEG:
            return f"{_side(first.up, now.up)} again: tilt it to another side"
    return None


def _quarter(taken: Sequence[Seen], now: Seen) -> str | None:
    turned_deg = now.heading_deg - taken[0].heading_deg
    near = _quarters(taken[0], now) * QUARTER_DEG
    if abs(_wrapped(turned_deg - near)) > TURN_TOLERANCE_DEG:
        return f"{turned_deg % 360.0:.0f} degrees: make it 90, 180 or 270"
    if any(_quarters(taken[0], seen) * QUARTER_DEG == near for seen in taken):
        return f"{near:.0f} degrees again: turn it on by {_to_next_deg(taken, now):.0f} degrees"
    return None


def _quarters(first: Seen, now: Seen) -> int:
    return round((now.heading_deg - first.heading_deg) / QUARTER_DEG) % HEADINGS


def _to_next_deg(taken: Sequence[Seen], now: Seen) -> float:
    """How far it is to be turned on, clockwise, to the next heading that is still open: the first, after all others."""
    done = {_quarters(taken[0], seen) for seen in taken}
    open_ones = {0} if len(done) == HEADINGS else set(range(HEADINGS)) - done
    at = _quarters(taken[0], now)
    return next(turn for turn in range(1, HEADINGS + 1) if (at + turn) % HEADINGS in open_ones) * QUARTER_DEG


def _apart_deg(one: Array, other: Array) -> float:
    return math.degrees(math.acos(float(np.clip(one @ other, -1.0, 1.0))))


def _azimuth(level: Array, up: Array) -> float:
    """Towards which side it leans, degrees from the nose, right positive; `level` is up while it stood level."""
    lean = up - level
    return math.degrees(math.atan2(-lean[1], -lean[0]))


def _side(level: Array, up: Array) -> str:
    """The side that is down."""
    sides = ("nose down", "right side down", "nose up", "left side down")
    return sides[round(_azimuth(level, up) / QUARTER_DEG) % 4]


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def leaned(forces_m_s2: Array) -> float:
    """By how much up moved in the aircraft from one third of a stand to another, in degrees; 0 where it may be noise.

    Args:
        forces_m_s2: (seconds, 3), means of an accelerometer.
    """
    if len(forces_m_s2) < LEAST_SECONDS:
        return 0.0
    # Second differences know nothing of a steady lean; of white noise they have six times the variance.
    noise = math.sqrt(np.square(np.diff(forces_m_s2, 2, axis=0)).mean() / 6.0)
    thirds = np.array([third.mean(axis=0) for third in np.array_split(forces_m_s2, 3)])
    ups = thirds / np.linalg.norm(thirds, axis=1)[:, None]
    apart = max(_apart_deg(one, other) for one, other in itertools.combinations(ups, 2))
    chance = LEANED_SIGMAS * noise * math.sqrt(6.0 / len(forces_m_s2)) / float(np.linalg.norm(forces_m_s2[0])) / DEG
    return apart if apart > chance else 0.0
