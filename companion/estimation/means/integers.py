"""Means of readings that were truncated to integers toward zero, by maximum likelihood; in LSB, one column per axis.

A truncated stream shows n for every value in [n, n + 1) LSB, -n for (-n - 1, -n], and 0 for all of (-1, +1). The plain
mean of the integers is wrong by up to half a step, and near zero by up to a whole step, however many are averaged. But
the frequencies of the integers show mean and sigma of the underlying Gaussian noise (autopilots.md section 9.3.1
"Integer messages": error 3.5 instead of 102 deg/h). The log-likelihood of grouped normal data is concave in h = 1 /
sigma and a = mean / sigma (Burridge, Biometrika 68 (1981) 41-45). Scoring with shortened steps thus finds its maximum.

The fit uses the counts of all good seconds together. The influence of each integer on the fitted mean then converts the
counts of one second to the mean of that second, to first order. Robust means, ramps and Allan deviations use these
means like those of a stream of floats. The scatter of the means includes noise that is correlated between readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA

Integers = NDArray[np.int64]

MIN_BEYOND_TWO: Final = 5.0
"""Least number of readings, outside the two most frequent integers, that determines both mean and sigma. With two
integers alone, every sigma has a mean that fits. Simulation of one minute, sigma 0.2 to 0.5 LSB, mean -2 to 2 LSB: with
five or more, the error is within 15 deg/h, its rms 0.93 to 1.05 times sigma. That holds for 250 Hz readings behind a 20
Hz filter, too. With one to four, the rms is 0.9 to 1.3 times sigma, and the error up to 17 deg/h."""
EDGE_RMS: Final = 0.05
"""Assumed displacement of the edges between integers, rms in LSB. Causes: a sensor's own steps (2000 deg/s in 16 bits
are 1.07 mrad/s), a filter, and noise that is not quite Gaussian."""
HUBER_C: Final = 4.0
"""Huber limit, in robust sigmas, for one-second means of integer streams. Rare integers determine the mean, but skew
the one-second means; a limit of 1.345 would cut them off."""
BORROWED_RMS: Final = 0.1  # Relative difference between the noise of the three axes of one gyro or accelerometer
HALF_STEP: Final = 0.5  # Sigma, LSB, of a mean that the readings do not determine
NEAR_ZERO: Final = 1.0  # Sigma, LSB, of an undetermined mean within a step of zero, on either side

SPREAD_SHARE: Final = 0.4
"""Least number of seconds with rare integers, over the number by chance. Noise behind a filter comes in runs: 0.5."""
_ROUNDS: Final = 60
_HALVINGS: Final = 30
_CONVERGED: Final = 1e-7
_LEAST_PROBABILITY: Final = 1e-300
_LEAST_SIGMA: Final = 1e-3  # Lower bound of sigma, LSB; less noise does not determine the mean better
_OUTLIER: Final = 6.0
_CORE_SIGMAS: Final = 8.0
_LEAST_SPREAD: Final = 0.3
_CORE_MARGIN: Final = 3
_MAX_REACH: Final = 1024

_erfc = np.frompyfunc(math.erfc, 1, 1)


class Fit(msgspec.Struct, frozen=True):
    """Fit of Gaussian noise to truncated readings, in LSB; arrays are (c,) over the axes unless stated otherwise.

    `variance`: variance of `mean` by the Fisher information, for independent readings. No value is NaN. Where
    `identified` is false, the values are no estimate and must not be used.
    """

    mean: Floats
    sigma: Floats  # Noise of one reading
    variance: Floats
    identified: NDArray[np.bool_]
    influence: Floats
    """Change of the mean by one reading in each of the k cells, times the number of readings, (k, c). The average of
    (mean + influence) over a part of the readings estimates the mean of that part, to first order."""
    density: Floats
    """Probability density at the edges of the cells, (k + 1, c)."""


def truncation_edges(lowest: Integers, cells: int) -> Floats:
    """Return the edges (cells + 1, c), LSB, of consecutive integers from `lowest` (c,) on; integer 0 spans two LSB."""
    first = lowest + np.arange(cells + 1, dtype=np.int64)[:, None]
    return np.asarray(first - (first <= 0), dtype=np.float64)


def fit(edges: Floats, counts: Floats, sigma: Floats | None = None) -> Fit:
    """Estimate mean and sigma from the counts (k, c) of readings between ascending edges (k + 1, c).

    `sigma` (c,): noise known from another source, NaN if unknown. A wrong value is worse than none: 0.33 instead of
    0.386 LSB causes an error of 14 deg/h (autopilots.md section 9.3.2).
    """
    given = np.full(counts.shape[1], np.nan) if sigma is None else sigma
    known = given > 0.0
    occupied, beyond_two = (counts > 0.0).sum(axis=0), np.sort(counts, axis=0)[:-2].sum(axis=0)
    identified = np.where(known, occupied >= 2, beyond_two >= MIN_BEYOND_TWO)
    # A column that cannot be solved is replaced by one that can; its result is not used.
    counts = np.where(identified, counts, 1.0)
    total = counts.sum(axis=0)
    middle = (edges[1:] + edges[:-1]) / 2.0
    centre = (counts * middle).sum(axis=0) / total
    spread = np.sqrt(np.maximum((counts * np.square(middle - centre)).sum(axis=0) / total - 1.0 / 12.0, 0.04))
    at = edges - centre
    a, h = np.zeros_like(centre), 1.0 / np.where(known, np.maximum(given, _LEAST_SIGMA), spread)
    state = _State(at, counts, a, h, known)
    for _ in range(_ROUNDS):
        aa, ah, hh = state.inverse
        step_a, step_h = aa * state.by_a + ah * state.by_h, ah * state.by_a + hh * state.by_h
        # The likelihood is concave, so a short enough step increases it; h stays positive.
        size = np.where(step_h < 0.0, np.minimum(1.0, 0.9 * h / np.maximum(-step_h, 1e-300)), 1.0)
        better = _State(at, counts, a + size * step_a, h + size * step_h, known)
        for _ in range(_HALVINGS):
            worse = better.likelihood < state.likelihood - 1e-9 * np.abs(state.likelihood)
            if not worse.any():
                break
            size = np.where(worse, size / 2.0, size)
            better = _State(at, counts, a + size * step_a, h + size * step_h, known)
        a, h, state = a + size * step_a, h + size * step_h, better
        if bool(np.all(np.abs(size * step_a) + np.abs(size * step_h) * spread <= _CONVERGED * (1.0 + np.abs(a)))):
            break
    aa, ah, hh = state.inverse
    # The mean is a / h.
    by_a, by_h = 1.0 / h, -a / np.square(h)
    towards_a, towards_h = by_a * aa + by_h * ah, by_a * ah + by_h * hh
    return Fit(
        mean=np.asarray(centre + a / h),
        sigma=np.asarray(1.0 / h),
        variance=np.asarray(towards_a * by_a + towards_h * by_h),
        identified=np.asarray(identified),
        influence=np.asarray(total * (towards_a * state.slope_a + towards_h * state.slope_h)),
        density=np.asarray(h * state.density),
    )


class _State:
    """Log-likelihood for parameters a and h, its gradient (by_a, by_h), and its inverse information (aa, ah, hh)."""

    def __init__(self, edges: Floats, counts: Floats, a: Floats, h: Floats, known: NDArray[np.bool_]) -> None:
        z = np.clip(h * edges - a, -1e4, 1e4)
        self.density = np.exp(-np.square(z) / 2.0) / math.sqrt(2.0 * math.pi)
        # A cell above the mean is mirrored below it, where no digits cancel.
        above = z[:-1] > 0.0
        low, high = np.where(above, -z[1:], z[:-1]), np.where(above, -z[:-1], z[1:])
        root = math.sqrt(2.0)
        mass = np.asarray(_erfc(-high / root), dtype=np.float64) - np.asarray(_erfc(-low / root), dtype=np.float64)
        probability = np.maximum(mass / 2.0, _LEAST_PROBABILITY)
        ends = edges * self.density
        self.slope_a, self.slope_h = -np.diff(self.density, axis=0) / probability, np.diff(ends, axis=0) / probability
        self.likelihood = (counts * np.log(probability)).sum(axis=0)
        self.by_a, self.by_h = (counts * self.slope_a).sum(axis=0), (counts * self.slope_h).sum(axis=0)
        expected = probability * counts.sum(axis=0)
        aa = np.maximum((expected * np.square(self.slope_a)).sum(axis=0), 1e-12)
        ah = (expected * self.slope_a * self.slope_h).sum(axis=0)
        hh = np.maximum((expected * np.square(self.slope_h)).sum(axis=0), 1e-12)
        determinant = np.maximum(aa * hh - np.square(ah), 1e-12 * aa * hh)
        # With a known sigma, only the mean is unknown.
        inverse = np.stack([hh / determinant, -ah / determinant, aa / determinant])
        self.inverse = np.where(known, np.stack([1.0 / aa, np.zeros_like(aa), np.zeros_like(aa)]), inverse)


def shape_variance(found: Fit) -> Floats:
    """Return the variance (c,) of the mean, LSB^2, that edges displaced by `EDGE_RMS` cause."""
    sensitivity = np.square(np.diff(found.influence, axis=0) * found.density[1:-1]).sum(axis=0)
    return np.asarray(EDGE_RMS**2 * sensitivity)


def integer_columns(
    batches: Sequence[Batch], steps: Floats
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Estimate the means of truncated readings from at least one good second; `steps` (c,): size of the LSB.

    Returns, in the unit of `steps`:
        (m, c) mean of every second;
        (c,) sigma of one second's mean, from the Fisher information;
        (c,) sigma that averaging does not reduce: of an undetermined mean, or from the shape of the noise;
        (c,) flags of axes whose own readings do not determine the mean (the noise of the triad's other axes may);
        (c,) flags of axes whose mean nothing determines, and which read zero: the mean is within a step of zero.
    """
    sizes = np.array([batch.n for batch in batches], dtype=np.float64)
    plain = np.array([batch.mean for batch in batches]) / steps
    start, tables = _aligned(batches, plain, steps)
    bounds = truncation_edges(start, tables.shape[1])
    inside = np.maximum(tables.sum(axis=1), 1.0)
    pooled = tables.sum(axis=0)
    own = fit(bounds, pooled)
    own = msgspec.structs.replace(own, identified=own.identified & _is_everywhere(tables, pooled))
    sigma = _borrowed(own, pooled)
    borrows = bool((sigma > 0.0).any())
    weight, found = np.ones_like(plain), own
    for fit_again in (borrows, True):
        if fit_again:
            found = fit(bounds, (tables * weight[:, None, :]).sum(axis=0), sigma)
        values = found.mean + np.einsum("mkc,kc->mc", tables, found.influence) / inside
        second = np.sqrt(found.variance * (weight * sizes[:, None]).sum(axis=0) / np.median(sizes))
        off = np.abs(values - np.median(values, axis=0))
        outside = (off > _OUTLIER * np.maximum(second, MAD_TO_SIGMA * np.median(off, axis=0))) & found.identified
        if not outside.any():
            break
        # Exclude knocks from the common fit.
        weight = np.where(outside, 0.0, 1.0)
    by_sigma = np.zeros(len(sigma))
    if borrows:
        other = fit(bounds, pooled, sigma * (1.0 + BORROWED_RMS))
        by_sigma = np.where(sigma > 0.0, other.mean - found.mean, 0.0)
    known = found.identified
    integers = start + np.arange(tables.shape[1], dtype=np.int64)[:, None]
    has_zero = ((integers == 0) & (pooled > 0.0)).any(axis=0)
    half_off = plain + HALF_STEP * np.sign(plain.mean(axis=0))
    unknown = np.where(has_zero, NEAR_ZERO, HALF_STEP)
    hidden = np.where(known, np.sqrt(shape_variance(found) + np.square(by_sigma)), unknown)
    return (
        np.where(known, values, half_off) * steps,
        np.where(known, second, 0.0) * steps,
        hidden * steps,
        ~(own.identified & known),
        ~known & has_zero,
    )


def _is_everywhere(tables: Floats, pooled: Floats) -> NDArray[np.bool_]:
    """Return (c,) true if the rare integers are spread over the seconds like noise; a disturbance fills a few."""
    common = np.take_along_axis(tables, np.argsort(pooled, axis=0)[None, -2:], axis=1).sum(axis=1)
    rare, seconds = tables.sum(axis=1) - common, len(tables)
    expected = seconds * (1.0 - np.exp(-rare.sum(axis=0) / seconds))
    return np.asarray((rare > 0.0).sum(axis=0) >= np.maximum(min(MIN_BEYOND_TWO, seconds), SPREAD_SHARE * expected))


def _borrowed(own: Fit, pooled: Floats) -> Floats:
    """Return noise (c,): the other axes' median for an axis that toggles between two integers, else NaN."""
    result = np.full(len(own.mean), np.nan)
    enough = ~own.identified & (pooled.sum(axis=0) - pooled.max(axis=0) >= MIN_BEYOND_TWO)
    for triad in (slice(start, start + 3) for start in range(0, len(result), 3)):
        known = own.identified[triad]
        if known.any():
            result[triad] = np.where(enough[triad], float(np.median(own.sigma[triad][known])), np.nan)
    return result


def _aligned(batches: Sequence[Batch], plain: Floats, steps: Floats) -> tuple[Integers, Floats]:
    """Convert the counts of all seconds to one grid of integers; return its lowest integers (c,), counts (m, k, c).

    The grid covers the range of the noise. A reading outside the grid is a transmission fault and is dropped.
    """
    centre = np.median(plain, axis=0)
    noise = np.sqrt(np.median([batch.variance for batch in batches], axis=0)) / steps
    spread = np.maximum(np.maximum(noise, _LEAST_SPREAD), np.abs(plain - centre).max(axis=0) / _CORE_SIGMAS)
    reach = int(min(np.ceil(_CORE_SIGMAS * spread.max()) + _CORE_MARGIN, _MAX_REACH))
    start = np.rint(centre).astype(np.int64) - reach
    tables = np.zeros((len(batches), 2 * reach + 1, len(steps)))
    column = np.arange(len(steps))
    for index, batch in enumerate(batches):
        if batch.counts is not None:
            place = batch.counts.lowest - start + np.arange(len(batch.counts.table))[:, None]
            inside = (place >= 0) & (place < tables.shape[1])
            tables[index, place[inside], np.broadcast_to(column, place.shape)[inside]] = batch.counts.table[inside]
    return start, tables
