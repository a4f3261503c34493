"""White noise, flicker and random walk of a sensor from recordings of it at rest, each with its error.

Maximum likelihood of the overlapping Allan variances at averaging times of 1, 2, 4, ... 256 s; a calibration asks for
no longer ones, and a drift or a bounded wander costs there what it costs a calibration. The variance at t is
N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3. Each octave counts as length / (2 t) independent squares: those of Haar's
wavelets, which together are all that a recording tells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.noise.allan import FLOOR_OF_FLICKER, allan_variance
from companion.physics.frames import Floats, vector

KNOWN_SIGMAS: Final = 2.0
"""N^2, B^2 or K^2 over its standard error from which the recordings show it: within 25 % of N, B or K."""
UPPER_SIGMAS: Final = 1.645
"""One-sided 95 %: the upper limit of a figure that the recordings do not show."""
LEAST_SLOTS: Final = 8
"""Least seconds of a stretch: shorter ones have no two averages that show more than white noise."""
LONGEST_S: Final = 256
_LONGEST_SHARE: Final = 3
"""The longest average is a third of the stretch: beyond, one difference is all there is."""
_ROUNDS: Final = 1000
_UPPER_ROUNDS: Final = 40
_UNBOUNDED: Final = 1e6


class AllanCurve(NamedTuple):
    """Allan variances of all stretches of a recording at rest; a row for each averaging time of each stretch."""

    spans: Floats
    """(k,) averaging times, s."""
    counts: Floats
    """(k,) seconds in an average; fewer where the stretch has holes."""
    freedom: Floats
    """(k,) independent squares."""
    variance: Floats
    """(k, c)."""


class AxisFit(msgspec.Struct, frozen=True):
    """Noise of one axis; figures in its unit (times sqrt(s), 1, over sqrt(s))."""

    figures: tuple[float, float, float]
    """N, B, K; none is negative."""
    sigmas: tuple[float, float, float]
    """Standard errors of the squares N^2, B^2, K^2."""
    upper: tuple[float, float, float]
    """One-sided 95 % limits of N, B, K; infinite where the recordings are too short for one."""
    known: tuple[bool, bool, bool]
    """True: the recordings show the figure."""


def curve(stretches: Iterable[tuple[NDArray[np.int64], Floats]]) -> AllanCurve:
    """Compute the Allan variances from the means (m, c) of ascending seconds (m,) of each stretch.

    Raises:
        ValueError: every stretch is too short.
    """
    rows = []
    for slots, values in stretches:
        length = int(slots[-1] - slots[0]) + 1
        filled = len(slots) / length
        span = 1
        while span <= min(length // _LONGEST_SHARE, LONGEST_S) and len(slots) >= LEAST_SLOTS:
            variance, freedom = allan_variance(slots, values, span)
            if freedom > 0.0:
                # One second has no hole; of a longer average only the seconds that are there average noise away.
                rows.append((span, max(filled * span, 1.0), len(slots) / (2.0 * span), variance))
            span *= 2
    if not rows:
        raise ValueError("nothing to fit: no stretch is long enough")
    return AllanCurve(*(np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)))


def fit_axis(found: AllanCurve, column: int) -> AxisFit:
    """Estimate N, B and K of one column.

    Raises:
        ValueError: the column never changes.
    """
    spans, counts, freedom, every = found
    variance = every[:, column]
    # In units of the scatter from second to second, so that no square is small.
    unit2 = float(variance[spans == 1.0].mean())
    if not unit2 > 0.0:
        raise ValueError("nothing to fit: readings that never change")
    variance = variance / unit2
    design = np.stack([1.0 / counts, np.full(len(spans), FLOOR_OF_FLICKER**2), spans / 3.0], axis=1)

    def errors(theta: Floats) -> Floats:
        information = design.T @ (design * (freedom / (2.0 * np.square(design @ theta)))[:, None])
        # One stretch with two averaging times tells no three figures: the error of the third comes out large.
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(information + np.diag(1e-12 * np.diag(information))))))

    def upper(which: int) -> float:
        """Find the square from which an estimate as low as this one is a matter of 5 %; a large one scatters more."""
        limit = theta.copy()
        for _ in range(_UPPER_ROUNDS):
            before = limit[which]
            limit[which] = theta[which] + UPPER_SIGMAS * errors(limit)[which]
            if limit[which] <= before * 1.001:
                return float(limit[which])
            if limit[which] > _UNBOUNDED:
                break
        return math.inf

    theta = np.array([1.0, 0.05, 1e-3])
    for _ in range(_ROUNDS):
        # The likelihood of chi-squares rises with every such step, and no figure becomes negative.
        model = design @ theta
        theta = theta * (design.T @ (freedom * variance / np.square(model))) / (design.T @ (freedom / model))
    sigmas = errors(theta)
    n, b, k = (theta > KNOWN_SIGMAS * sigmas).tolist()
    return AxisFit(
        figures=vector(np.sqrt(theta * unit2)),
        sigmas=vector(sigmas * unit2),
        upper=vector(np.sqrt(np.array([upper(which) for which in range(3)]) * unit2)),
        known=(n, b, k),
    )
