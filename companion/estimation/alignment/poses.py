"""Poses that an alignment asks for, as text and picture, and the check of a pose against the requested one.

A *pose* is one way to put down or hold the aircraft. A *stand* in the code is the time without motion in a pose.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from companion.physics.frames import Array, wrap_deg
from companion.physics.units import DEG
from companion.samples import Vector

TURN_TOLERANCE_DEG: Final = 30.0
QUARTER_DEG: Final = 90.0
LEAST_TILT_DEG: Final = 15.0
"""Smallest tilt that separates scale and misalignment from bias: their effects differ by the cosine of the tilt."""
APART_DEG: Final = 45.0  # The least angle between two tilts to different sides
MOST_ASKEW_DEG: Final = 30.0
"""Largest tilt of an aircraft on its base: slope, plus a taildragger's attitude, plus a board mounted by eye."""
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
"""Sigma of a turn that somebody judged by eye, because no sensor measured it."""


class AlignmentRequest(NamedTuple):
    action: Literal["zero", "tilts", "turn", "faces", "compass"]
    headings: int = 2
    """Headings to measure. 2: half a turn, then another in the same direction to the start. 4: every quarter turn. For
    a compass: any number, each after an equal part of a turn."""
    write: bool = False  # Write offsets (and scales, if six positions determine them) to the autopilot
    level: bool = False  # Write the tilt of the board as the autopilot's level
    heading_deg: float | None = None  # True heading of the first pose, if somebody knows it
    sides: bool = False  # Of a compass: six sides at any heading

    @property
    def on_spot(self) -> int:
        """Number of poses at the marked place. A "turn", or two headings without tilts, ends with the first again."""
        if self.action == "compass":
            return self.headings
        if self.headings == 2 and self.action != "tilts":
            return 3
        return HEADINGS + (self.action == "turn")

    @property
    def total(self) -> int:
        return self.on_spot + (TILTS if self.action == "tilts" else 0)


class PoseRequest(NamedTuple):
    """Pose to request next. `up`: unit vector pointing up, in the aircraft's axes (forward, right, down).

    `words`: text; spoken up to its first colon. `lacks`: what the poses so far do not show well enough.
    """

    words: str
    up: Vector = LEVEL
    turn_deg: float = 0.0  # Turn at one place, clockwise from above
    lacks: str = ""


class HeldPose(NamedTuple):
    """Attitude of the aircraft in one pose. `up` (3,): unit vector pointing up, in the aircraft's axes.

    `counted`: the gyros measured the turn since the previous pose; `heading_sigma_deg` is then the turn's sigma.
    """

    up: Array
    heading_deg: float = 0.0
    """Heading from the compass' own north, or, without a compass, from the first pose; not wrapped if `counted`."""
    heading_sigma_deg: float = 0.0
    counted: bool = False


def wanted_pose(request: AlignmentRequest, poses: Sequence[HeldPose]) -> PoseRequest:
    if not poses:
        return PoseRequest("stand the aircraft on a firm, marked spot")
    if len(poses) >= request.on_spot:
        done = [_side(poses[0].up, pose.up) for pose in poses[request.on_spot :]]
        up = next((up for side, up in _TILTED.items() if side not in done), LEVEL)
        if done:
            return PoseRequest(f"tilt it to another side, prop it up: not {' or '.join(done)} again", up)
        return PoseRequest("tilt it 20 to 28 degrees, prop it up: nose up, nose down, left or right side down", up)
    turn_deg = asked_turn_deg(request, poses)
    words = "turn it by 180 degrees, onto its marks" if len(poses) == 1 else "turn it the same way to its first marks"
    if request.on_spot >= HEADINGS or request.action == "compass":
        words = f"turn it by {turn_deg:.0f} degrees on its spot"
    return PoseRequest(words, turn_deg=turn_deg)


def asked_turn_deg(request: AlignmentRequest, poses: Sequence[HeldPose]) -> float:
    if len(poses) >= request.on_spot:
        return 0.0
    if request.action == "compass":
        return 360.0 / request.headings
    return _to_next_deg(poses, poses[-1]) if request.on_spot >= HEADINGS else 180.0


def objection(request: AlignmentRequest, poses: Sequence[HeldPose], now: HeldPose) -> str | None:
    """Explain why pose `now` is not the requested one, and what to do; None if it is the requested one."""
    if not poses:
        askew_deg = _apart_deg(now.up, np.array(LEVEL))
        return f"tilted by {askew_deg:.0f} degrees: stand it on its base" if askew_deg > MOST_ASKEW_DEG else None
    first, number = poses[0], len(poses)
    if number < request.on_spot:
        if request.action == "compass":
            return _part_of_turn(360.0 / request.headings, now.heading_deg - poses[-1].heading_deg)
        turned_deg = now.heading_deg - first.heading_deg
        if request.on_spot >= HEADINGS and number < HEADINGS:
            return _quarter(poses, now)
        wanted_deg = 180.0 if number == 1 else 0.0
        off_deg = abs(wrap_deg(turned_deg - wanted_deg))
        if off_deg > TURN_TOLERANCE_DEG:
            turned_deg = abs(wrap_deg(turned_deg))
            return f"{turned_deg:.0f} degrees, not {wanted_deg:.0f}: turn it by {off_deg:.0f} degrees more"
        return None
    tilt_deg = _apart_deg(now.up, first.up)
    if tilt_deg < LEAST_TILT_DEG:
        return f"tilted by {tilt_deg:.0f} degrees only: make it 20 to 28"
    azimuth_deg = _azimuth(first.up, now.up)
    if any(abs(wrap_deg(_azimuth(first.up, one.up) - azimuth_deg)) < APART_DEG for one in poses[request.on_spot :]):
        return f"{_side(first.up, now.up)} again: tilt it to another side"
    return None


def _quarter(poses: Sequence[HeldPose], now: HeldPose) -> str | None:
    turned_deg = now.heading_deg - poses[0].heading_deg
    quarters = _quarters(poses[0], now)
    if abs(wrap_deg(turned_deg - quarters * QUARTER_DEG)) > TURN_TOLERANCE_DEG:
        return f"{turned_deg % 360.0:.0f} degrees: make it 90, 180 or 270"
    if any(_quarters(poses[0], pose) == quarters for pose in poses):
        on_deg = _to_next_deg(poses, now)
        return f"{quarters * QUARTER_DEG:.0f} degrees again: turn it on by {on_deg:.0f} degrees"
    return None


def _quarters(first: HeldPose, now: HeldPose) -> int:
    return round((now.heading_deg - first.heading_deg) / QUARTER_DEG) % HEADINGS


def _to_next_deg(poses: Sequence[HeldPose], now: HeldPose) -> float:
    done = {_quarters(poses[0], pose) for pose in poses}
    open_ones = {0} if len(done) == HEADINGS else set(range(HEADINGS)) - done
    at = _quarters(poses[0], now)
    return next(turn for turn in range(1, HEADINGS + 1) if (at + turn) % HEADINGS in open_ones) * QUARTER_DEG


def _apart_deg(one: Array, other: Array) -> float:
    return math.degrees(math.acos(float(np.clip(one @ other, -1.0, 1.0))))


def _part_of_turn(wanted_deg: float, turned_deg: float) -> str | None:
    """Object to a turn of less than half of what a compass needs: any other is as good, as its angle is counted."""
    left_deg = wanted_deg - abs(turned_deg)
    if left_deg < wanted_deg / 2.0:
        return None
    return f"{abs(turned_deg):.0f} degrees, not {wanted_deg:.0f}: turn it on by {left_deg:.0f}"


def _azimuth(level: Array, up: Array) -> float:
    """Return the direction of the aircraft's lean, degrees from the nose, right positive; `level`: up on the base."""
    lean = up - level
    return math.degrees(math.atan2(-lean[1], -lean[0]))


def _side(level: Array, up: Array) -> str:
    sides = ("nose down", "right side down", "nose up", "left side down")
    return sides[round(_azimuth(level, up) / QUARTER_DEG) % 4]


def leaned_deg(forces_m_s2: Array) -> float:
    """Return the largest angle between the mean directions of up in three thirds of a pose's time; 0 if within noise.

    Args:
        forces_m_s2: (seconds, 3), mean specific force of each second.
    """
    if len(forces_m_s2) < LEAST_SECONDS:
        return 0.0
    # Second differences cancel a steady lean; for white noise they have six times its variance.
    noise = math.sqrt(np.square(np.diff(forces_m_s2, 2, axis=0)).mean() / 6.0)
    thirds = np.array([third.mean(axis=0) for third in np.array_split(forces_m_s2, 3)])
    ups = thirds / np.linalg.norm(thirds, axis=1)[:, None]
    apart = max(_apart_deg(one, other) for one, other in itertools.combinations(ups, 2))
    chance = LEANED_SIGMAS * noise * math.sqrt(6.0 / len(forces_m_s2)) / float(np.linalg.norm(forces_m_s2[0])) / DEG
    return apart if apart > chance else 0.0
