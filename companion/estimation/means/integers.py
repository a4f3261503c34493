"""Streams of truncated integers as the estimator takes them: second by second, in LSB, freed of the truncation.

The counts of all good seconds together give mean and sigma by maximum likelihood (`quantised`). The influence of every
integer on that mean then turns the counts of a single second into that second's own mean, to first order; so what
comes after (Huber's mean, ramps, Allan deviations) works on it as on the means of a stream of floats, and the scatter
of the seconds speaks for noise that is not independent from one reading to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.means.quantised import MIN_BEYOND_TWO, Cells, Fit, fit, shape_variance, truncation_edges
from companion.estimation.noise.robust import HUBER_C as FLOAT_HUBER_C
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA

Integers = NDArray[np.int64]

HUBER_C: Final = 4.0
"""Of a second's scale, for these streams: rare integers make the seconds' means skew, and 1.345 would cut the rare
ones off, which are what the mean is known by."""

HALF_STEP: Final = 0.5
BORROWED_RMS: Final = 0.1
"""Relative, between the noise of the three axes of one gyro or accelerometer."""

NO_SIDE: Final = 1.0
"""LSB that are added in quadrature where the mean stays unknown: half a step; or a whole one where it lies within a
step of zero, on either side."""

_OUTLIER: Final = 6.0
_CORE_SIGMAS: Final = 8.0
_LEAST_SPREAD: Final = 0.3
_CORE_MARGIN: Final = 3
_MAX_REACH: Final = 1024
_CELLS_PER_SIGMA: Final = 4.0


class IntegerColumns(msgspec.Struct, frozen=True):
    """What is different about the columns of truncated streams among those of all; (c,) or (m, c), SI units."""

    of: NDArray[np.bool_]
    """Which columns those are; the other figures of the rest are neutral."""
    values: Floats
    """(m, c) mean of every second."""
    huber_c: Floats
    least: Floats
    """Sigma of one second's mean, from the Fisher information."""
    hidden: Floats
    """Sigma that no averaging takes away: half a step where not identified, what the shape of the noise may hide where
    identified."""
    unknown: NDArray[np.bool_]
    """Not identified by their own readings, but by the noise of the triad's other axes, or not at all."""
    useless: NDArray[np.bool_]
    """Nor worked out with another axis' noise, and zero is among the readings: the mean could be anything within a step
    of it."""
    edge_rms: Floats
    """Displacement of the integers' edges that the readings show or may hide, in steps."""


def integer_columns(
    batches: Sequence[Sequence[Batch]], steps: Floats, truncates: NDArray[np.bool_], edges: Floats
) -> IntegerColumns:
    """Work out all truncated streams from their good batches, which are of the same seconds.

    Of all columns of all streams, (c,) each: their steps, whether they are truncated, and what is known of the rms
    displacement of the integers' edges, in steps.
    """
    of = truncates & (steps > 0.0)
    width = len(steps)
    result = IntegerColumns(
        of=of,
        values=np.zeros((len(batches[0]), width)),
        huber_c=np.where(of, HUBER_C, FLOAT_HUBER_C),
        least=np.zeros(width),
        hidden=np.zeros(width),
        unknown=np.zeros(width, dtype=np.bool_),
        useless=np.zeros(width, dtype=np.bool_),
        edge_rms=np.zeros(width),
    )
    each = width // len(batches)
    for index, own in enumerate(batches):
        part = slice(each * index, each * (index + 1))
        if not of[part].any():
            continue
        # One triad of a stream may be floats; its columns are worked out with any step and not used.
        step = np.where(of[part], steps[part], 1.0)
        _work_out(own, step, edges[part], result, part)
    return result


def _work_out(batches: Sequence[Batch], steps: Floats, edges: Floats, result: IntegerColumns, part: slice) -> None:
    """Work out one stream's `part` of the columns, from good seconds, at least one, with their counts.

    A second without counts is taken at its plain mean.
    """
    sizes = np.array([batch.n for batch in batches], dtype=np.float64)
    plain = np.array([batch.mean for batch in batches]) / steps
    start, tables = _aligned(batches, plain, steps)
    pooled = tables.sum(axis=0)
    integers = start + np.arange(len(pooled), dtype=np.int64)[:, None]
    width = _widths(pooled, integers)
    bounds, grouped = _grouped(tables, start, width)
    weight = np.ones_like(plain)
    found, values, scale = _linearised(bounds, grouped, sizes, weight, None)
    own = found.identified
    sigma = _borrowed(found, grouped.sum(axis=0))
    slope = np.zeros(len(steps))
    if sigma is not None and not own.all():
        found, values, scale = _linearised(bounds, grouped, sizes, weight, sigma)
        other = fit(Cells(bounds, grouped.sum(axis=0)), sigma * (1.0 + BORROWED_RMS))
        slope = np.where(found.identified & ~own, np.abs(other.mean - found.mean), 0.0)
    centre = np.median(values, axis=0)
    outside = np.abs(values - centre) > _OUTLIER * np.maximum(
        scale, MAD_TO_SIGMA * np.median(np.abs(values - centre), axis=0)
    )
    outside &= found.identified
    if outside.any():
        weight = np.where(outside, 0.0, 1.0)
        found, values, scale = _linearised(bounds, grouped, sizes, weight, sigma)
    cells = Cells(bounds, (grouped * weight[:, None, :]).sum(axis=0))
    second = np.sqrt(found.variance * cells.counts.sum(axis=0) / sizes.mean())
    dispersion = _dispersion(values, second)
    shape, edge = shape_variance(cells, found, dispersion, edges)
    has_zero = ((integers == 0) & (pooled > 0.0)).any(axis=0)
    known, side = found.identified, _sides(pooled, integers)
    unknown = np.where(np.abs(side) == 1.0, HALF_STEP, NO_SIDE)
    means = _half_step_means(tables, integers, side, plain)
    of = result.of[part]
    result.values[:, part] = np.where(known, values, means) * steps
    result.least[part] = np.where(of & known, second, 0.0) * steps
    result.hidden[part] = np.where(known, np.sqrt(shape + np.square(slope)), unknown) * steps
    result.unknown[part] = of & ~own
    result.useless[part] = of & ~known & has_zero
    result.edge_rms[part] = np.where(of & own, edge, 0.0)


def _borrowed(found: Fit, counts: Floats) -> Floats | None:
    """For axes that show two integers only, the sigma of the other axes of their triad; NaN for the others."""
    result = np.full(len(found.mean), np.nan)
    enough = counts.sum(axis=0) - counts.max(axis=0) >= MIN_BEYOND_TWO
    for start in range(0, len(result), 3):
        triad = slice(start, start + 3)
        known = found.identified[triad]
        if known.any() and not known.all():
            usual = float(np.median(found.sigma[triad][known]))
            result[triad] = np.where(~known & enough[triad], usual, result[triad])
    return None if np.isnan(result).all() else result


def _linearised(
    edges: Floats, grouped: Floats, sizes: Floats, weight: Floats, sigma: Floats | None
) -> tuple[Fit, Floats, Floats]:
    """The fit of the weighted counts, every second's own mean (m, c), and the sigma of those."""
    found = fit(Cells(edges, (grouped * weight[:, None, :]).sum(axis=0)), sigma)
    inside = np.maximum(grouped.sum(axis=1), 1.0)
    values = found.mean + np.einsum("mkc,kc->mc", grouped, found.influence) / inside
    total = (weight * sizes[:, None]).sum(axis=0)
    scale = np.sqrt(found.variance * total / np.median(sizes, axis=0))
    return found, values, scale


def _aligned(batches: Sequence[Batch], plain: Floats, steps: Floats) -> tuple[Integers, Floats]:
    """Counts of every second on one grid of integers: (c,) lowest, (m, k, c) counts.

    The grid reaches as far as noise does; a reading beyond is a fault of the line and is left out.
    """
    centre = np.median(plain, axis=0)
    noise = np.sqrt(np.median([batch.variance for batch in batches], axis=0)) / steps
    spread = np.maximum(np.maximum(noise, _LEAST_SPREAD), np.abs(plain - centre).max(axis=0) / _CORE_SIGMAS)
    reach = int(min(np.ceil(_CORE_SIGMAS * spread.max()) + _CORE_MARGIN, _MAX_REACH))
    start = np.rint(centre).astype(np.int64) - reach
    tables = np.zeros((len(batches), 2 * reach + 1, len(steps)))
    counted = [(index, batch.counts) for index, batch in enumerate(batches) if batch.counts is not None]
    if not counted:
        return start, tables
    # All seconds in one go: a minute of them one by one would cost more than the fit.
    heights = np.array([len(counts.table) for _, counts in counted])
    rows = np.arange(heights.sum()) - np.repeat(np.cumsum(heights) - heights, heights)
    place = np.repeat([counts.lowest for _, counts in counted], heights, axis=0) - start + rows[:, None]
    second = np.repeat([index for index, _ in counted], heights)[:, None] + np.zeros_like(place)
    column = np.arange(len(steps)) + np.zeros_like(place)
    inside = (place >= 0) & (place < tables.shape[1])
    found = np.concatenate([counts.table for _, counts in counted])
    tables[second[inside], place[inside], column[inside]] = found[inside]
    return start, tables


def _widths(pooled: Floats, integers: Integers) -> Integers:
    """(c,) how many integers go into one cell: a quarter of sigma, so that wide noise costs no more than narrow."""
    total = np.maximum(pooled.sum(axis=0), 1.0)
    mean = (pooled * integers).sum(axis=0) / total
    sigma = np.sqrt((pooled * np.square(integers - mean)).sum(axis=0) / total)
    return np.asarray(np.maximum(np.floor(sigma / _CELLS_PER_SIGMA), 1.0), dtype=np.int64)


def _grouped(tables: Floats, start: Integers, width: Integers) -> tuple[Floats, Floats]:
    """Cells of `width` integers, without the empty ones at both ends: edges (k + 1, c), counts (m, k, c)."""
    occupied = tables.sum(axis=0) > 0.0
    length = len(occupied)
    first = np.where(occupied.any(axis=0), occupied.argmax(axis=0), 0)
    last = np.where(occupied.any(axis=0), length - 1 - occupied[::-1].argmax(axis=0), 0)
    # One empty cell on either side belongs to the picture: that nothing fell there.
    cells = int(((last - first) // width).max()) + 3
    counts = np.zeros((tables.shape[0], cells, tables.shape[2]))
    for column in range(tables.shape[2]):
        own = tables[:, first[column] : last[column] + 1, column]
        at = np.arange(0, own.shape[1], width[column])
        counts[:, 1 : len(at) + 1, column] = np.add.reduceat(own, at, axis=1)
    return truncation_edges(start + first - width, cells, width), counts


def _half_step_means(tables: Floats, integers: Integers, side: Floats, plain: Floats) -> Floats:
    """(m, c) where there is no fit: the plain means, half a step further from zero."""
    shift = np.where(integers == 0, side, np.sign(integers)) * HALF_STEP
    counted = tables.sum(axis=1)
    moved = np.einsum("mkc,kc->mc", tables, integers + shift) / np.maximum(counted, 1.0)
    return np.where(counted > 0.0, moved, plain + np.sign(plain) * HALF_STEP)


def _sides(pooled: Floats, integers: Integers) -> Floats:
    """(c,) +1 or -1 where all readings that are not zero lie on that side; 0 where there are both or none."""
    sides = np.sign(integers) * (pooled > 0.0)
    return np.asarray(sides.max(axis=0, initial=0) + sides.min(axis=0, initial=0), dtype=np.float64)


def _dispersion(values: Floats, second: Floats) -> Floats:
    """(c,) variance between neighbouring seconds over that of independent readings, at least 1."""
    if len(values) < 3:
        return np.ones(values.shape[1])
    scatter = np.square(np.diff(values, axis=0)).mean(axis=0) / 2.0
    return np.asarray(np.maximum(scatter / np.maximum(np.square(second), 1e-12), 1.0))
