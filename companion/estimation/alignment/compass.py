"""Hard and soft iron of a compass, from poses on the ground in which nobody has to know a heading.

A firmware corrects the raw field r of a compass to D (r + c), in the vehicle's axes (FRD): the offset c is hard iron,
the symmetric matrix D is soft iron and scale. In pose k the corrected field is the Earth's,

    D (r_k + c) = L(up_k) (h cos psi_k, -h sin psi_k, d)

with the horizontal and the vertical field h and d of WMM2025, the tilt L from gravity, and the magnetic heading psi_k,
which is unknown in the first pose and then counted by the gyros. A symmetric D turns no field by a common angle, so
that four headings on level ground determine the heading, c, and the horizontal part of D. A figure that the poses leave
open keeps the sigma of its prior.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align_model import LeastSquares, fit, response
from companion.physics.earth import MagneticField
from companion.physics.frames import Array, Floats, Matrix, body_from_ned, roll_pitch_from_up
from companion.physics.units import DEG

FIGURES: Final = 9
OFFSET: Final = slice(0, 3)
_DIAGONAL, _BESIDE, _HEADING, _FIELD, _TURN_SCALE, _TURNS = slice(3, 6), slice(6, 9), 9, slice(10, 12), 12, 13

_SOFT_SIGMA: Final = 0.03
"""Prior sigma of each element of D; soft iron is 5 % at most."""
_SPOT_SIGMA_GAUSS: Final = 0.003
"""Sigma by which the field of ordinary ground differs from the model's."""
_SCATTER_GAUSS: Final = 0.001
"""Prior of the scatter of the field between poses: the compass moves on its turn, and each tilt has an error."""
_SCATTER_WEIGHT: Final = 3.0
"""Number of readings that this prior is worth; the readings of the poses show how much the field really scatters."""
TURN_SCALE: Final = 0.01
"""Prior sigma of the scale of the gyro that counts the turns, as in `align_model.Priors`."""
_STEP_LIMIT_GAUSS: Final = 2.0
_GUESSES: Final = np.arange(0.0, 360.0, 10.0) * DEG
_TURNS_WITH_IT: Final = 8.0
"""Variance of a bent field that turns with the aircraft, over that of its scatter beyond the prior's."""
SCATTER_LIMIT_GAUSS: Final = 0.0016
"""Scatter of the field between poses above which iron near the spot must be bending the field."""
STRENGTH_LIMIT: Final = 0.1
"""Largest relative deviation of the horizontal field that soft iron and a scale may explain."""


class CompassFigures(NamedTuple):
    """Correction of a compass: `soft @ (raw + offset)`, in vehicle axes (FRD), gauss."""

    offset_gauss: Array  # (3,)
    soft: Matrix  # (3, 3), symmetric


class CompassPose(NamedTuple):
    """Means of one pose: unit vector up (3,) and raw field (3,) with sigma (3,), in vehicle axes (FRD)."""

    up: Array
    raw_gauss: Array
    sigma_gauss: Array
    turn_rad: float = 0.0  # About the vehicle's z axis, clockwise from above, since the previous pose
    turn_sigma_rad: float = 0.0  # math.inf: nobody knows the turn, so all poses have a heading of their own


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CompassEstimate:
    """Estimate of a compass' figures, with the covariance (9, 9) of offset x y z, gauss, and D xx yy zz xy xz yz.

    `heading_rad`: magnetic heading of the first pose. `off_gauss` (poses, 3): measured minus expected raw field.
    `scatter_gauss`: one sigma of the field from pose to pose. `strength`: horizontal field over the model's.
    """

    figures: CompassFigures
    covariance: Matrix
    earth: MagneticField
    heading_rad: float
    heading_sigma_rad: float
    off_gauss: Matrix
    scatter_gauss: float
    strength: float

    @property
    def offset_sigma_gauss(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.covariance)[OFFSET]))

    @property
    def strength_is_wrong(self) -> bool:
        return abs(self.strength - 1.0) > STRENGTH_LIMIT

    @property
    def bent(self) -> str | None:
        """Return what shows that iron near the spot bends the field, as text; None: nothing does."""
        if self.strength_is_wrong:
            much = "strong" if self.strength > 1.0 else "weak"
            return f"field {100.0 * abs(self.strength - 1.0):.0f} % too {much} here"
        if self.scatter_gauss > SCATTER_LIMIT_GAUSS:
            return f"field differs by {1e3 * self.scatter_gauss:.0f} mG from pose to pose"
        return None

    def errors_rad(self, of: CompassFigures) -> Array:
        """Return the heading errors (36,), every 10 degrees on the level, of a compass that had the figures `of`."""
        level = _level_field(_GUESSES, self.earth.horizontal_gauss, self.earth.down_gauss)
        raw = level @ np.linalg.inv(self.figures.soft) - self.figures.offset_gauss
        ahead, right, _ = ((raw + of.offset_gauss) @ of.soft).T
        return np.asarray(np.angle(np.exp(1j * (np.arctan2(-right, ahead) - _GUESSES))))

    def sigma_rad(self, lean_deg: float = 0.0) -> float:
        """Return one sigma of the heading after the correction, rms over all headings and the sides of a lean."""
        leans = {(lean_deg, 0.0), (-lean_deg, 0.0), (0.0, lean_deg), (0.0, -lean_deg)}
        tilts = np.array([body_from_ned(roll * DEG, pitch * DEG, 0.0) for roll, pitch in sorted(leans)])
        level = _level_field(_GUESSES[:, None], self.earth.horizontal_gauss, self.earth.down_gauss)
        uncorrected = np.einsum("ij,tjk,hnk->hti", np.linalg.inv(self.figures.soft), tilts, level)
        by = np.zeros((*uncorrected.shape, FIGURES))
        by[..., OFFSET] = self.figures.soft
        x, y, z = np.moveaxis(uncorrected, -1, 0)
        by[..., 0, 3], by[..., 1, 4], by[..., 2, 5] = x, y, z
        by[..., 0, 6], by[..., 1, 6], by[..., 0, 7], by[..., 2, 7], by[..., 1, 8], by[..., 2, 8] = y, x, z, x, z, y
        east = np.stack([np.sin(_GUESSES), np.cos(_GUESSES), 0.0 * _GUESSES], axis=-1)  # magnetic east, in level axes
        gradient = np.einsum("hj,tij,htif->htf", east, tilts, by) / self.earth.horizontal_gauss
        variance = np.einsum("htf,fg,htg->ht", gradient, self.covariance, gradient)
        return math.sqrt(float(variance.mean()))


def compass(
    poses: Sequence[CompassPose],
    earth: MagneticField,
    before: CompassFigures,
    tilt_sigma_rad: float,
    heading: tuple[float, float] | None = None,
) -> CompassEstimate:
    """Estimate the correction of one compass.

    Args:
        poses: at least two, or one with a `heading`; on six sides their turns may be unknown.
        earth: Earth's field at the place.
        before: present correction; its D is the mean of the prior.
        tilt_sigma_rad: of the tilt that all poses have in common.
        heading: magnetic heading of the first pose and its sigma, rad; None: unknown.

    Raises:
        CalibrationRefusedError: no compass has these readings.
    """
    model = _Model(poses, before)
    start, prior = model.start(earth, before), _prior(poses, earth)
    if heading is not None:
        start[_HEADING], prior[_HEADING] = heading
    free = [0, 1, 2, *([_HEADING] if heading is None else [])]
    if (unknown := np.flatnonzero(np.isinf(prior))).size:
        prior[unknown] = math.pi
        free += unknown.tolist()
        model.guess_all(start)
    else:
        start = model.guess(start, _GUESSES if heading is None else start[[_HEADING]])
    found, scatter_gauss = model.solve(start, prior, free)
    soft = model.soft(found.values[None])[0]
    kept = np.diag(before.soft @ np.linalg.inv(soft))[:2].mean()
    return CompassEstimate(
        figures=CompassFigures(found.values[OFFSET], soft),
        covariance=_covariance(found, earth, tilt_sigma_rad, scatter_gauss),
        earth=earth,
        heading_rad=float(found.values[_HEADING]),
        heading_sigma_rad=math.sqrt(found.covariance[_HEADING, _HEADING]),
        off_gauss=model.raw - model.expected(found.values[None])[0],
        scatter_gauss=scatter_gauss,
        strength=float(found.values[_FIELD][0] / earth.horizontal_gauss * kept),
    )


class _Model:
    """Raw fields of all poses as a function of the unknowns: offset, D, first heading, field h d, turn scale, turns."""

    def __init__(self, poses: Sequence[CompassPose], before: CompassFigures) -> None:
        self._tilts = np.array([body_from_ned(*roll_pitch_from_up(pose.up), 0.0) for pose in poses])
        self.raw, self._noise = (np.array(each) for each in zip(*(pose[1:3] for pose in poses), strict=True))
        turns = [_azimuth_turned(tilt, pose.turn_rad) for tilt, pose in zip(self._tilts, poses[1:], strict=False)]
        self._turns = np.array(turns)

    def start(self, earth: MagneticField, before: CompassFigures) -> Array:
        """Return the mean of the prior; offset and heading are zero."""
        start = np.zeros(_TURNS + len(self._turns))
        start[_DIAGONAL], start[_BESIDE] = np.diag(before.soft), before.soft[[0, 0, 1], [1, 2, 2]]
        start[_FIELD] = earth.horizontal_gauss, earth.down_gauss
        return start

    def guess(self, start: Array, headings_rad: Array) -> Array:
        """Complete `start` with the heading, of these, at which one offset explains the poses best, and that offset."""
        guesses = np.tile(start, (len(headings_rad), 1))
        guesses[:, _HEADING] = headings_rad
        off = self.expected(guesses) - self.raw
        guesses[:, OFFSET] = off.mean(axis=1)
        return np.asarray(guesses[np.argmin(off.var(axis=1).sum(axis=1))])

    def guess_all(self, start: Array) -> None:
        """Set the offset to that of a sphere through all raw fields, and all headings to those of the fields then."""
        around = np.column_stack([-2.0 * self.raw, np.ones(len(self.raw))])
        start[OFFSET] = np.linalg.lstsq(around, np.square(self.raw).sum(axis=1), rcond=None)[0][:3]
        ahead, right, _ = np.einsum("pij,pi->jp", self._tilts, self.raw + start[OFFSET])
        headings = np.arctan2(-right, ahead)
        start[_HEADING], start[_TURNS:] = headings[0], np.diff(headings)

    def expected(self, at: Floats) -> Floats:
        """Return the raw fields (m, poses, 3) for m sets of unknowns (m, size)."""
        turned = np.cumsum(self._turns * (1.0 + at[:, _TURN_SCALE, None]) + at[:, _TURNS:], axis=1)
        headings = at[:, _HEADING, None] + np.concatenate([np.zeros((len(at), 1)), turned], axis=1)
        level = _level_field(headings, *np.moveaxis(at[:, _FIELD, None], 1, 0))
        field = np.einsum("pij,mpj->mpi", self._tilts, level)
        return np.asarray(np.linalg.solve(self.soft(at)[:, None], field[..., None])[..., 0] - at[:, None, OFFSET])

    def soft(self, at: Floats) -> Floats:
        return response(at[:, _DIAGONAL] - 1.0, at[:, _BESIDE])

    def solve(self, start: Array, prior: Array, free: Sequence[int]) -> tuple[LeastSquares, float]:
        """Fit with the usual scatter of the field, then with the scatter that the residuals show; return that too."""
        first = self._solve(start, prior, free, _SCATTER_GAUSS)
        readings = _SCATTER_WEIGHT + self.raw.size - len(free)
        ratio = (_SCATTER_WEIGHT + float(first.residual @ first.residual)) / readings
        scatter_gauss = _SCATTER_GAUSS * math.sqrt(ratio)
        return self._solve(start, prior, free, scatter_gauss), scatter_gauss

    def _solve(self, start: Array, prior: Array, free: Sequence[int], scatter_gauss: float) -> LeastSquares:
        sigma = np.hypot(self._noise, scatter_gauss)
        try:
            return fit(lambda at: ((self.raw - self.expected(at)) / sigma).reshape(len(at), -1), start, prior, free)
        except (ValueError, np.linalg.LinAlgError):
            raise CalibrationRefusedError("these readings are no compass': does it turn with the aircraft?") from None


def _prior(poses: Sequence[CompassPose], earth: MagneticField) -> Array:
    """Return the prior sigma of every unknown; of offset and heading, which have none, the limit of a step."""
    of_strength, of_dip = earth.strength_sigma_gauss, earth.strength_gauss * earth.inclination_sigma_deg * DEG
    spot = math.sqrt(_SPOT_SIGMA_GAUSS**2 + of_strength**2 + of_dip**2)
    figures = [*[_STEP_LIMIT_GAUSS] * 3, *[_SOFT_SIGMA] * 6]
    return np.array([*figures, math.pi, spot, spot, TURN_SCALE, *(pose.turn_sigma_rad for pose in poses[1:])])


def _covariance(found: LeastSquares, earth: MagneticField, tilt_sigma_rad: float, scatter_gauss: float) -> Matrix:
    """Return the covariance (9, 9) of offset and D; a tilt error or a field that turns along looks like hard iron."""
    covariance = found.covariance[:FIGURES, :FIGURES].copy()
    by_tilt = np.array([earth.down_gauss * tilt_sigma_rad, earth.down_gauss * tilt_sigma_rad, 0.0])
    bent = _TURNS_WITH_IT * max(scatter_gauss**2 - _SCATTER_GAUSS**2, 0.0)
    covariance[OFFSET, OFFSET] += np.diag(by_tilt**2 + bent)
    return np.asarray(covariance)


def _azimuth_turned(tilt: Matrix, turn_rad: float) -> float:
    """Return by how much the azimuth of a tilted aircraft's nose changes in a turn about its own z axis."""
    ahead, right, _ = tilt
    nose = ahead * math.cos(turn_rad) + right * math.sin(turn_rad)
    turned = math.atan2(nose[1], nose[0]) - math.atan2(ahead[1], ahead[0])
    return turn_rad + math.remainder(turned - turn_rad, math.tau)


def _level_field(headings: Floats, horizontal: Floats | float, down: Floats | float) -> Floats:
    """Return the Earth's field in the axes of a level aircraft, (..., 3), at magnetic headings in rad."""
    level = np.stack([horizontal * np.cos(headings), -horizontal * np.sin(headings), down + 0.0 * headings], axis=-1)
    return np.asarray(level)
