"""Accuracy of a compass alignment: boards with iron, turned on sloping ground that is quiet or bent by iron."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.estimation.alignment.compass import CompassFigures, CompassPose, compass
from companion.physics.earth import magnetic_field
from sim.accuracy.figures import Claim, Figure, Section, covered, rms, stack
from sim.earth import Array, axis_rotation, body_from_ned

PLACE: Final = (47.4, 8.5, 400.0)
HARD_GAUSS, SOFT = 0.15, 0.05
"""Length of the hard iron, in a random direction; largest deviation of each element of the soft iron from none."""
LEVER_M: Final = 0.3
"""Distance of the compass from the axis on which the aircraft is turned."""
QUIET, BENT = 0.01, 0.1
"""Gradient of the field over ordinary ground, and over ground with iron, gauss per metre."""
NOISE_GAUSS, TILT_RAD, TURN_DEG, TURN_SCALE, MARKS_DEG = 0.0005, 0.002, 0.15, 0.01, 2.0
"""Sigmas: of a mean of one pose; of the tilt, in vehicle axes; of a counted turn, and its scale; of the marks."""
CASES: Final = (
    (2, 0.0, QUIET), (3, 0.0, QUIET), (4, 0.0, QUIET), (8, 0.0, QUIET), (4, 5.0, QUIET), (4, 10.0, QUIET),
    (4, 0.0, BENT), (8, 0.0, BENT),
)  # fmt: skip
"""Headings, slope of the ground in degrees, and gradient."""
LEANED_DEG: Final = 10.0
_ROUND: Final = np.arange(0.0, 360.0, 10.0)
_DEGREE: Final = math.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class CompassRun:
    """Heading errors of one board after each case (cases, headings), level and leaned, their sigmas, the warnings."""

    level: Array
    leaned: Array
    level_sigma: Array
    leaned_sigma: Array
    named: Array


def board(seed: int, number: int) -> CompassRun:
    """Align one board in every case."""
    random = np.random.default_rng([seed, number, 37])
    hard = random.standard_normal(3)
    hard *= HARD_GAUSS / np.linalg.norm(hard)
    soft = np.eye(3) + np.diag(random.uniform(-SOFT, SOFT, 3))
    soft[np.triu_indices(3, 1)] = soft.T[np.triu_indices(3, 1)] = random.uniform(-SOFT, SOFT, 3)
    found = [_case(random, hard, soft, *case) for case in CASES]
    level, leaned, sigma, leaned_sigma, named = (np.array(part) for part in zip(*found, strict=True))
    return CompassRun(level, leaned, sigma, leaned_sigma, named)


def _case(
    random: np.random.Generator, hard: Array, soft: Array, headings: int, slope_deg: float, gradient: float
) -> tuple[Array, Array, float, float, bool]:
    earth = magnetic_field(*PLACE, datetime.date(2026, 6, 1))
    field = np.array([earth.horizontal_gauss, 0.0, earth.down_gauss])
    here = field + random.normal(0.0, 0.002, 3) * (1.0, 0.0, 1.0)
    bend = random.standard_normal((3, 3))
    bend = bend + bend.T
    bend -= np.eye(3) * np.trace(bend) / 3.0  # no sources, no currents
    bend *= gradient / np.linalg.norm(bend)
    first_deg, downhill, tilt_error = (
        random.uniform(0.0, 360.0),
        random.uniform(0.0, math.tau),
        random.normal(0.0, TILT_RAD, 3),
    )
    scale, poses, before = 1.0 + random.normal(0.0, TURN_SCALE), [], first_deg
    for number in range(headings):
        heading_deg = first_deg + number * 360.0 / headings + random.normal(0.0, MARKS_DEG)
        body = axis_rotation(2, -heading_deg * _DEGREE) @ _on_slope(slope_deg, downhill)
        lever = body.T @ (LEVER_M, 0.0, 0.0)
        raw = np.linalg.solve(soft, body @ (here + bend @ lever)) - hard + random.normal(0.0, NOISE_GAUSS, 3)
        up = body @ (0.0, 0.0, -1.0) + tilt_error
        turned = (heading_deg - before) * scale + random.normal(0.0, TURN_DEG) if number else 0.0
        poses.append(
            CompassPose(up / np.linalg.norm(up), raw, np.full(3, NOISE_GAUSS), turned * _DEGREE, TURN_DEG * _DEGREE)
        )
        before = heading_deg
    found = compass(poses, earth, CompassFigures(np.zeros(3), np.eye(3)), TILT_RAD)
    leans = [(0.0, LEANED_DEG), (0.0, -LEANED_DEG), (LEANED_DEG, 0.0), (-LEANED_DEG, 0.0)]
    errors = [_errors(found.figures, hard, soft, field, *lean) for lean in ((0.0, 0.0), *leans)]
    leaned_sigma = np.full(4 * len(_ROUND), found.sigma_rad(LEANED_DEG))
    return (
        errors[0],
        np.concatenate(errors[1:]),
        np.full(len(_ROUND), found.sigma_rad()),
        leaned_sigma,
        found.bent is not None,
    )  # type: ignore[return-value]


def _on_slope(slope_deg: float, downhill: float) -> Array:
    """Return the attitude (body from NED) of an aircraft on a slope, its nose somewhere."""
    slope, turn = body_from_ned(0.0, slope_deg * _DEGREE, 0.0), body_from_ned(0.0, 0.0, downhill)
    return np.asarray(turn.T @ slope @ turn)


def _errors(
    figures: CompassFigures, hard: Array, soft: Array, field: Array, roll_deg: float, pitch_deg: float
) -> Array:
    """Return the heading errors in rad, all round, of an aircraft that leans."""
    errors = []
    lean = body_from_ned(roll_deg * _DEGREE, pitch_deg * _DEGREE, 0.0)
    for heading in np.radians(_ROUND):
        raw = np.linalg.solve(soft, body_from_ned(roll_deg * _DEGREE, pitch_deg * _DEGREE, heading) @ field) - hard
        ahead, right, _ = lean.T @ figures.soft @ (raw + figures.offset_gauss)
        errors.append(math.remainder(math.atan2(-right, ahead) - heading, math.tau))
    return np.array(errors)


def section(runs: list[CompassRun]) -> Section:
    iron = f"{1e3 * HARD_GAUSS:.0f} mG of hard and {100.0 * SOFT:.0f} % of soft iron"
    lines = [
        f"{len(runs)} boards with {iron}: heading error all round, rms and sigma",
        "in deg, share within 2 sigma; the same leaned by 10 deg; iron of the spot named",
        "",
    ]
    claims = []
    for row, (headings, slope, gradient) in enumerate(CASES):
        level, leaned = stack(runs, "level")[:, row], stack(runs, "leaned")[:, row]
        sigma, leaned_sigma = stack(runs, "level_sigma")[:, row], stack(runs, "leaned_sigma")[:, row]
        words = f"{headings} headings, {slope:2.0f} deg, {1e3 * gradient:.0f} mG/m"
        found, aside = rms(level).times(1.0 / _DEGREE), rms(leaned).times(1.0 / _DEGREE)
        share, share_aside = covered(level, sigma, 2.0).times(100.0), covered(leaned, leaned_sigma, 2.0).times(100.0)
        named = stack(runs, "named")[:, row]
        share_named = Figure(float(named.mean()), float(named.std() + 1.0 / len(runs)) / math.sqrt(len(runs))).times(
            100.0
        )
        lines.append(
            f"{words:28}{found.value:6.2f}{sigma.mean() / _DEGREE:6.2f}{share.value:6.1f} %{aside.value:8.2f}"
            f"{leaned_sigma.mean() / _DEGREE:6.2f}{share_aside.value:6.1f} %{share_named.value:6.0f} %"
        )
        if gradient == QUIET:
            claims.append(Claim(f"compass, {words}: level", "deg", found, 1.0 if headings > 2 else 2.0))
            claims.append(Claim(f"compass, {words}: leaned", "deg", aside, 1.5 if headings > 2 else 2.0))
            claims.append(Claim(f"compass, {words}: wrongly named", "%", share_named, 1.0))
        else:
            claims.append(Claim(f"compass, {words}: named", "%", share_named, 100.0, 95.0))
        claims.append(Claim(f"compass, {words}: 2 sigma cover", "%", share, 99.5, 93.0))
    return Section("Compasses", lines, claims)
