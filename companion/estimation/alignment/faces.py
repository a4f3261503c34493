"""Bias, scale and shear of three accelerometers from the length of gravity, in stands of any orientation.

Nothing but the strength of gravity has to be known: however the sensor is held, what it should read is that long
(Tedaldi, Pretto and Menegatti, ICRA 2014; Skog and Haendel, 2006). With u of length 1, up in the sensor's axes,

    f = (I + S) g u + b           S symmetric: scale on its diagonal, shear beside it

so that |(I + S)^-1 (f - b)| = g in every stand. A rotation of the three axes together changes no length: how the sensor
sits in the aircraft is not told here, but by turning it on a spot. Unlike the triangular matrix of that paper, a
symmetric one gives no axis a place above the others, and its diagonal is what a firmware's scale should be, which
knows no shear.

Each stand counts by the noise of its own mean, gravity by what the place leaves open of it. So every figure has a
sigma from the first stand on. A stand that does not fit is found by leaving out one after another.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import widened_by
from companion.estimation.alignment.align_model import response
from companion.physics.frames import Array, Matrix, symmetric_by
from companion.physics.units import MG

FIGURES: Final = 9
BIAS: Final = slice(0, 3)
SCALE: Final = slice(3, 6)
SHEAR: Final = slice(6, 9)
PRIOR_BIAS_M_S2: Final = 100.0 * MG
PRIOR_SCALE: Final = 0.03
PRIOR_SHEAR: Final = 0.01
"""One sigma of what a part may have from the factory (ICM-42688-P: 0.5 %, cross axis 1 %; mounted parts are worse)."""
W_LIMIT: Final = 3.9
"""|w| of a stand (Baarda): passed by chance once in ten thousand."""
LEAST_SPARE: Final = 2
"""Stands beyond the figures, below which a wrong one cannot be told from the others."""
_MAX_ROUNDS: Final = 30
_CONVERGED: Final = 1e-8
_LEAST_REDUNDANCY: Final = 1e-3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Face:
    """The mean of one still stand in the sensor's axes, with one sigma per axis; m/s^2, shapes (3,)."""

    accel_m_s2: Array
    sigma_m_s2: Array


class Sides(msgspec.Struct, frozen=True):
    """Accelerometers of one IMU as all sides have told of them, under the offsets and scales in force."""

    figures: Array
    """(9,), as in `Faces`, in the sensor's axes; m/s^2 and no unit."""
    sigma: Array
    """One sigma of each, with what time and temperature have added to the biases."""
    vehicle_from_sensor: Matrix


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """What all stands together tell: figures (9,), bias x y z, scale x y z, shear xy xz yz, with their covariance."""

    figures: Array
    by_stands: Matrix
    """Their covariance, (9, 9), as the stands tell them."""
    wander_m_s2: Array
    """One sigma, (3,), of what the biases do from here to where they are used."""
    gravity_m_s2: float
    gravity_sigma_m_s2: float
    up: Matrix
    """(stands, 3), up in the sensor's axes, corrected."""
    left_out: tuple[int, ...]
    """Stands, counted from 0, that do not fit the others."""
    off_m_s2: Array
    """(stands,) how much longer than gravity each reads, corrected; of one that was left out, by the others."""
    in_doubt: tuple[int, ...]
    """Stands of which one does not fit, and nobody can tell which; the next stand does."""

    @property
    def covariance(self) -> Matrix:
        """(9, 9), with what the biases wander."""
        both = self.by_stands.copy()
        both[BIAS, BIAS] += np.diag(self.wander_m_s2**2)
        return both

    @property
    def sigma(self) -> Array:
        """One sigma of each figure, (9,)."""
        return np.sqrt(np.diag(self.covariance))


def faces(
    stands: Sequence[Face], gravity_m_s2: float, gravity_sigma_m_s2: float, wander_m_s2: Array | None = None
) -> Faces:
    """Estimate from all stands, at least one; what they do not determine keeps the sigma of what was known before.

    `wander_m_s2` as in `Faces`; None: nothing.

    Raises:
        CalibrationRefusedError: readings that no accelerometer can give.
    """
    everyone = tuple(range(len(stands)))
    gravity = (gravity_m_s2, gravity_sigma_m_s2)
    fit = _fit(stands, everyone, gravity)
    left_out: tuple[int, ...] = ()
    in_doubt: tuple[int, ...] = ()
    while not fit.fits:
        kept = tuple(k for k in everyone if k not in left_out)
        if 4 * (len(left_out) + 1) > len(stands):
            in_doubt = kept
            break
        without = {k: _fit(stands, tuple(j for j in kept if j != k), gravity) for k in kept}
        mended = [k for k in kept if without[k].fits]
        if len(mended) > 1 or len(kept) - FIGURES < LEAST_SPARE:
            in_doubt = tuple(mended) or kept
            break
        worst = mended[0] if mended else min(kept, key=lambda k: without[k].chi_square)
        left_out, fit = (*left_out, worst), without[worst]
    stretch, bias = response(fit.figures[SCALE], fit.figures[SHEAR]), fit.figures[BIAS]
    inside = np.linalg.solve(stretch, np.array([stand.accel_m_s2 - bias for stand in stands]).T).T
    lengths = np.linalg.norm(inside, axis=1)
    return Faces(
        figures=fit.figures,
        by_stands=fit.covariance,
        wander_m_s2=np.zeros(3) if wander_m_s2 is None else wander_m_s2,
        gravity_m_s2=gravity_m_s2,
        gravity_sigma_m_s2=gravity_sigma_m_s2,
        up=inside / lengths[:, None],
        left_out=tuple(sorted(left_out)),
        off_m_s2=lengths - gravity_m_s2,
        in_doubt=in_doubt,
    )


def along(up: Array, gravity_m_s2: float) -> Array:
    """How the length of a reading changes with the figures, (9,), where `up` is up in the sensor's axes."""
    return np.concatenate([up, gravity_m_s2 * up**2, gravity_m_s2 * up @ symmetric_by(up)])


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    figures: Array
    covariance: Matrix
    chi_square: float
    fits: bool


def _fit(stands: Sequence[Face], which: Sequence[int], gravity: tuple[float, float]) -> _Fit:
    """Gauss-Newton with priors, gravity sought too; everything in units of the prior sigmas."""
    force = np.array([stands[k].accel_m_s2 for k in which])
    variance = np.array([stands[k].sigma_m_s2 for k in which]) ** 2
    prior = np.concatenate(
        [np.repeat([PRIOR_BIAS_M_S2, PRIOR_SCALE, PRIOR_SHEAR], 3), [max(gravity[1], 1e-9)]],
    )
    at = np.zeros(FIGURES + 1)
    for _ in range(_MAX_ROUNDS):
        residual, scaled = _linearised(force, variance, at, gravity[0], prior)
        step, *_ = np.linalg.lstsq(scaled, residual, rcond=None)
        at = at + step * prior
        if not (np.isfinite(step).all() and np.abs(at[SCALE]).max() < 0.5):
            break
        if np.abs(step).max() < _CONVERGED:
            return _judged(*_linearised(force, variance, at, gravity[0], prior), at, prior, len(which))
    raise CalibrationRefusedError("the accelerometers' readings are no gravity: is every stand still?")


def _linearised(force: Matrix, variance: Matrix, at: Array, gravity_m_s2: float, prior: Array) -> tuple[Array, Matrix]:
    """Residuals over sigma, measured minus foretold, and the derivatives of what is foretold times the prior sigmas."""
    inverse = np.linalg.inv(response(at[SCALE], at[SHEAR]))
    inside = (force - at[BIAS]) @ inverse
    lengths = np.linalg.norm(inside, axis=1)
    across = inside / lengths[:, None] @ inverse
    """By which reading each length goes, (stands, 3)."""
    sigma = np.sqrt(np.einsum("ki,ki->k", across**2, variance))
    derivative = np.empty((len(force), FIGURES + 1))
    derivative[:, BIAS] = across
    derivative[:, SCALE] = across * inside
    derivative[:, SHEAR] = [one @ symmetric_by(other) for one, other in zip(across, inside, strict=True)]
    derivative[:, FIGURES] = 1.0
    residual = lengths - gravity_m_s2 - at[FIGURES]
    return (
        np.concatenate([residual / sigma, -at / prior]),
        np.vstack([derivative / sigma[:, None] * prior, np.eye(FIGURES + 1)]),
    )


def _judged(residual: Array, scaled: Matrix, at: Array, prior: Array, count: int) -> _Fit:
    inverse = np.linalg.inv(scaled.T @ scaled)
    residual, freedom = residual[:count], count - FIGURES
    chi_square = float(residual @ residual)
    redundancy = 1.0 - np.einsum("ij,jk,ik->i", scaled[:count], inverse, scaled[:count])
    w = residual / np.sqrt(np.maximum(redundancy, _LEAST_REDUNDANCY))
    # Against what the other stands scatter, where that is more than their sigmas.
    others = np.maximum((chi_square - w**2) / (freedom - 1), 1.0) if freedom > 1 else np.ones(count)
    covariance = widened_by(chi_square, freedom) * inverse * np.outer(prior, prior)
    return _Fit(
        figures=at[:FIGURES],
        covariance=covariance[:FIGURES, :FIGURES],
        chi_square=chi_square,
        fits=bool((np.abs(w) <= W_LIMIT * np.sqrt(others)).all()),
    )
