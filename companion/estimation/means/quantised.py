"""Mean and noise of a reading that was cut to integers toward zero, by maximum likelihood.

A truncated stream says n for every value of [n, n + 1) LSB, -n for (-n - 1, -n], and 0 for all of (-1, +1). The mean of
the integers is off by up to half a step, and by up to a whole one around zero, however long it is averaged; the share
of every integer still tells mean and sigma of the Gaussian noise underneath (autopilots 9.3.1 "Integer messages": 102
deg/h against 3.5). Everything here is in LSB and pure; arrays have one column an axis.

The log-likelihood of grouped normal data is concave in h = 1 / sigma and a = mean / sigma (Burridge, Biometrika 68
(1981) 41-45), so Newton's method from anywhere finds the one maximum. Tails are kept as Mills' ratio, so that a cell 40
sigmas away has a finite log-likelihood.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.physics.frames import Floats

MIN_BEYOND_TWO: Final = 5.0
"""Readings that must lie outside the two commonest integers for both mean and sigma to be known. With two integers
alone every sigma has a mean that fits. Simulated over 0.2 to 0.5 LSB, means of -2 to 2 and a minute: with five or more
the error is within 15 deg/h and its rms 0.93 to 1.05 of the stated one, also where a 20 Hz filter makes readings of
250 Hz come in clumps; with one to four it is 0.9 to 1.3 of it, and up to 17 deg/h."""

EDGE_RMS: Final = 0.05
"""LSB by which the integers' edges may be displaced where the readings cannot tell: what is left of a sensor's own,
equally coarse steps (2000 deg/s in 16 bits are 1.07 mrad/s), of a filter's and of noise that is not quite Gaussian."""

_ROUNDS: Final = 60
_HALVINGS: Final = 30
_CONVERGED: Final = 1e-7
_LOG_ROOT_2_PI: Final = 0.5 * math.log(2.0 * math.pi)
_MILLS_DIRECT: Final = 6.0
_MIN_CELLS: Final = 4
"""Their total and two parameters take three degrees of freedom."""
LEAST_SIGMA: Final = 1e-3
"""LSB. Quieter than that tells the mean no better, and its likelihood leaves the range of the numbers."""
_EXPECTED_LEAST: Final = 5.0
"""Pearson's chi-square needs so many expected in a cell."""

_erfc = np.frompyfunc(math.erfc, 1, 1)


class Cells(msgspec.Struct, frozen=True):
    """How often, (k, c), the reading fell between neighbouring edges, (k + 1, c) ascending; may be weighted."""

    edges: Floats
    counts: Floats


class Fit(msgspec.Struct, frozen=True):
    """Gaussian noise under truncation; arrays are (c,) unless said otherwise, in LSB.

    Nothing here is NaN; where `identified` is false the figures are no estimate and must not be used.
    """

    mean: Floats
    sigma: Floats
    """Of the noise of one reading."""
    variance: Floats
    """Of `mean`, from the observed Fisher information, every reading being independent of the next."""
    identified: NDArray[np.bool_]
    influence: Floats
    """(k, c): by how much one reading in that cell moves the mean, times the number of readings. So the mean over a
    part of the readings of (mean + influence) estimates that part's mean to first order."""
    probability: Floats
    """(k, c) of the cells by the fit, and its density (k + 1, c) at their edges."""
    density: Floats
    slopes: Floats
    """(2, k, c): derivatives of the cells' log-probability by the two parameters."""


def truncation_edges(lowest: NDArray[np.int64], cells: int, width: NDArray[np.int64] | int = 1) -> Floats:
    """(cells + 1, c) edges of cells that hold `width` neighbouring integers each, from (c,) `lowest` on, in LSB.

    The integer 0 spans two LSB.
    """
    first = lowest + np.arange(cells + 1, dtype=np.int64)[:, None] * width
    return np.asarray(first - (first <= 0), dtype=np.float64)


def beyond_two(counts: Floats) -> Floats:
    """(c,) how many readings lie outside the two commonest cells."""
    if counts.shape[0] < 3:
        return np.zeros(counts.shape[1])
    return np.asarray(np.sort(counts, axis=0)[:-2].sum(axis=0))


def fit(cells: Cells, sigma: Floats | None = None) -> Fit:
    """Maximum-likelihood mean, and sigma unless it is given.

    `sigma` (c,) of the noise where it is known from elsewhere, NaN in a column where it is not; a wrong one is worse
    than none (0.33 instead of 0.386 LSB makes 14 deg/h, autopilots 9.3.2).
    """
    known = np.zeros(cells.counts.shape[1], dtype=np.bool_) if sigma is None else sigma > 0.0
    occupied = (cells.counts > 0.0).sum(axis=0)
    identified = np.where(
        known,
        occupied >= 2,
        (occupied >= 3) & (beyond_two(cells.counts) >= MIN_BEYOND_TWO),
    )
    # What cannot be solved is replaced by something that can; nobody looks at its result.
    counts = np.where(identified, cells.counts, 1.0)
    known = known | ~identified
    total = counts.sum(axis=0)
    middle = (cells.edges[1:] + cells.edges[:-1]) / 2.0
    centre = (counts * middle).sum(axis=0) / total
    spread = np.sqrt(np.maximum((counts * np.square(middle - centre)).sum(axis=0) / total - 1.0 / 12.0, 0.04))
    if sigma is not None:
        spread = np.where(sigma > 0.0, np.maximum(sigma, LEAST_SIGMA), spread)
    edges = cells.edges - centre
    h = 1.0 / spread
    a = np.zeros_like(centre)
    state = _state(edges, counts, a, h)
    for _ in range(_ROUNDS):
        aa, ah, hh = _inverse(state.information, known)
        by_a, by_h = state.gradient
        step_a, step_h = aa * by_a + ah * by_h, ah * by_a + hh * by_h
        # The likelihood is concave, so a short enough step is one upwards.
        size = np.where(step_h < 0.0, np.minimum(1.0, 0.9 * h / np.maximum(-step_h, 1e-300)), 1.0)
        better = _state(edges, counts, a + size * step_a, h + size * step_h)
        for _ in range(_HALVINGS):
            worse = better.likelihood < state.likelihood - 1e-9 * np.abs(state.likelihood)
            if not worse.any():
                break
            size = np.where(worse, size / 2.0, size)
            better = _state(edges, counts, a + size * step_a, h + size * step_h)
        a, h, state = a + size * step_a, h + size * step_h, better
        if bool(np.all(np.abs(size * step_a) + np.abs(size * step_h) * spread <= _CONVERGED * (1.0 + np.abs(a)))):
            break
    aa, ah, hh = _inverse(state.information, known)
    # The mean is a / h.
    by_a, by_h = 1.0 / h, -a / np.square(h)
    towards_a, towards_h = by_a * aa + by_h * ah, by_a * ah + by_h * hh
    influence = total * (towards_a * state.slopes[0] + towards_h * state.slopes[1])
    return Fit(
        mean=np.asarray(centre + a / h),
        sigma=np.asarray(1.0 / h),
        variance=np.asarray(np.maximum(towards_a * by_a + towards_h * by_h, 0.0)),
        identified=np.asarray(identified),
        influence=np.asarray(influence),
        probability=np.exp(state.log_probability),
        density=state.density,
        slopes=state.slopes,
    )


class _State(msgspec.Struct, frozen=True):
    """Everything at one point (a, h)."""

    likelihood: Floats
    gradient: Floats
    """(2, c)."""
    information: Floats
    """(3, c): minus the second derivatives aa, ah, hh."""
    slopes: Floats
    log_probability: Floats
    density: Floats


def _mills(z: Floats) -> Floats:
    """(1 - Phi(z)) / phi(z) for z >= 0."""
    near = np.minimum(z, _MILLS_DIRECT)
    tail = np.asarray(_erfc(near / math.sqrt(2.0)), dtype=np.float64)
    direct = math.sqrt(math.pi / 2.0) * np.exp(np.square(near) / 2.0) * tail
    far = np.maximum(z, _MILLS_DIRECT)
    fraction = far
    for k in range(24, 0, -1):  # Laplace's continued fraction
        fraction = far + k / fraction
    return np.asarray(np.where(z <= _MILLS_DIRECT, direct, 1.0 / fraction))


def _state(edges: Floats, counts: Floats, a: Floats, h: Floats) -> _State:
    z = np.clip(h * edges - a, -1e7, 1e7)
    size = np.abs(z)
    mills = _mills(size)
    low, high = z[:-1], z[1:]
    # Of the two ends of a cell the one nearer to the mean, and its distance; phi(near) is taken out of everything.
    flipped = high <= 0.0
    straddling = (low < 0.0) & (high > 0.0)
    near = np.where(straddling, 0.0, np.where(flipped, size[1:], size[:-1]))
    far = np.where(flipped, size[:-1], size[1:])
    near_mills = np.where(flipped, mills[1:], mills[:-1])
    far_mills = np.where(flipped, mills[:-1], mills[1:])
    low_phi = np.exp(-(np.square(low) - np.square(near)) / 2.0)
    high_phi = np.exp(-(np.square(high) - np.square(near)) / 2.0)
    one_side = near_mills - np.exp(-(np.square(far) - np.square(near)) / 2.0) * far_mills
    both_sides = math.sqrt(2.0 * math.pi) - low_phi * mills[:-1] - high_phi * mills[1:]
    mass = np.maximum(np.where(straddling, both_sides, one_side), 1e-300)
    log_probability = np.log(mass) - np.square(near) / 2.0 - _LOG_ROOT_2_PI
    low_ratio, high_ratio = low_phi / mass, high_phi / mass
    low_edge, high_edge = edges[:-1], edges[1:]
    by_a = low_ratio - high_ratio
    by_h = high_edge * high_ratio - low_edge * low_ratio
    low_z, high_z = low * low_ratio, high * high_ratio
    aa = np.square(by_a) - (low_z - high_z)
    ah = by_a * by_h - (high_edge * high_z - low_edge * low_z)
    hh = np.square(by_h) - (np.square(low_edge) * low_z - np.square(high_edge) * high_z)
    return _State(
        likelihood=(counts * log_probability).sum(axis=0),
        gradient=np.stack([(counts * by_a).sum(axis=0), (counts * by_h).sum(axis=0)]),
        information=np.stack([(counts * aa).sum(axis=0), (counts * ah).sum(axis=0), (counts * hh).sum(axis=0)]),
        slopes=np.stack([by_a, by_h]),
        log_probability=log_probability,
        density=h * np.exp(-np.square(z) / 2.0 - _LOG_ROOT_2_PI),
    )


def _inverse(information: Floats, known: NDArray[np.bool_]) -> Floats:
    """(3, c) inverse of the symmetric 2x2; where sigma is given only of aa."""
    aa, ah, hh = information
    aa = np.maximum(aa, 1e-12)
    determinant = np.maximum(aa * hh - np.square(ah), 1e-12 * aa * np.maximum(hh, 1e-12))
    return np.stack(
        [
            np.where(known, 1.0 / aa, hh / determinant),
            np.where(known, 0.0, -ah / determinant),
            np.where(known, 0.0, aa / determinant),
        ]
    )


def shape_variance(cells: Cells, found: Fit, dispersion: Floats, least: Floats | None = None) -> tuple[Floats, Floats]:
    """What noise that is not Gaussian, or a second quantisation below this one, may have moved the mean by.

    Such things act as if the integers' edges were displaced. Displacements that look like another mean and sigma can
    never be seen, so `EDGE_RMS` is believed of every stream, and `least`, (c,), where more is known. Where the readings
    occupy more cells than the fit has parameters, Pearson's chi-square may tell of more (method of moments: its excess
    over its degrees of freedom, over the non-centrality that displacements of 1 LSB rms would give).

    (c,) variance to add to the mean's, LSB^2, and (c,) rms displacement of the edges, LSB. `dispersion` (c,): variance
    of the mean that the scatter in time shows over that of independent readings, >= 1.
    """
    steps = np.diff(found.influence, axis=0) * found.density[1:-1]
    sensitivity = np.square(steps).sum(axis=0)
    edge = np.maximum(EDGE_RMS, 0.0 if least is None else least) * np.ones(cells.counts.shape[1])
    for axis in np.flatnonzero(found.identified):
        displaced = _displacement(cells.counts[:, axis], found, int(axis), float(dispersion[axis]))
        edge[axis] = max(edge[axis], displaced)
    if least is not None:  # the edges of a grid below may also all be displaced alike, and the mean with them
        sensitivity = np.where(least > EDGE_RMS, np.maximum(sensitivity, 1.0), sensitivity)
    return np.where(found.identified, np.square(edge) * sensitivity, 0.0), edge


def _displacement(counts: Floats, found: Fit, axis: int, dispersion: float) -> float:
    """Rms displacement of the edges of one axis that the readings show; 0 where they show none or cannot."""
    total = float(counts.sum())
    probability = found.probability[:, axis]
    well_filled = np.flatnonzero(total * probability >= _EXPECTED_LEAST)
    if len(well_filled) < _MIN_CELLS:
        return 0.0
    first, last = int(well_filled[0]), int(well_filled[-1])
    inner = slice(first, last + 1)
    p, seen = probability[inner].copy(), counts[inner].copy()
    # What lies beyond goes to the outermost cells, which then reach to infinity.
    seen[0] += counts[:first].sum()
    seen[-1] += counts[last + 1 :].sum()
    tangent = (found.slopes[:, inner, axis] * p).T.copy()
    density = found.density[first + 1 : last + 1, axis]
    left, right = found.probability[:first, axis].sum(), found.probability[last + 1 :, axis].sum()
    p[0] += left + max(0.0, (1.0 - float(found.probability[:, axis].sum())) / 2.0)
    p[-1] += right + max(0.0, (1.0 - float(found.probability[:, axis].sum())) / 2.0)
    tangent[0] -= tangent.sum(axis=0) / 2.0
    tangent[-1] -= tangent.sum(axis=0)
    p /= p.sum()
    chi_square = float((np.square(seen - total * p) / (total * p)).sum()) / dispersion
    freedom = len(p) - 3
    # An edge that lies higher than believed moves readings from the cell above it to the one below.
    moved = np.zeros((len(p), len(density)))
    moved[np.arange(len(density)), np.arange(len(density))] = density
    moved[np.arange(1, len(p)), np.arange(len(density))] = -density
    root = np.sqrt(p)[:, None]
    basis, _ = np.linalg.qr(np.column_stack([root, tangent / root]))
    visible = moved / root
    visible = visible - basis @ (basis.T @ visible)
    sensitivity = total / dispersion * float(np.square(visible).sum())
    excess = chi_square - freedom
    luck = 3.0 * math.sqrt(2.0 * freedom)
    return math.sqrt(excess / sensitivity) if excess > luck and sensitivity > 0.0 else 0.0
