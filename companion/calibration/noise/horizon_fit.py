"""A noise model that says of the next minutes what the recordings saw of them, and no more.

A random walk that is bounded, as the wander of most parts is after some minutes, looks like a walk at averages of a
minute; of what it does in the next three minutes the walk says too much. `sigma_use` speaks of the mean over H seconds
after a mean over T seconds, so that is what is measured: the mean square of their difference, at the T and H that
calibrations have. Where it is less than the model's, flicker and walk are fitted to it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.allan import AllanModel, floor_variance
from companion.physics.frames import Floats

HORIZONS_S: Final = tuple(itertools.product((10, 30, 60), (60, 180)))
"""T and H."""
LEAST_WINDOWS: Final = 8.0
"""Side by side; fewer say nothing against a model."""
CAUTION_SIGMAS: Final = 1.0
"""By so much of its standard error more than was measured counts, and the largest of three axes."""


def within_horizon(model: AllanModel, stretches: Sequence[tuple[NDArray[np.int64], Floats]]) -> AllanModel:
    """The model with the flicker and walk that hold for means of 10 to 60 s and the 60 to 180 s after them.

    `stretches`: slots (m,) and means (m, 3) of seconds at rest.
    """
    rows, targets = [], []
    for mean_s, next_s in HORIZONS_S:
        white = model.white**2 * (1.0 / mean_s + 1.0 / next_s)
        target = float(floor_variance(model.flicker, model.walk, mean_s, next_s)) + white
        seen, windows = _seen(stretches, mean_s, next_s)
        if windows >= LEAST_WINDOWS:
            target = min(target, seen * (1.0 + CAUTION_SIGMAS * math.sqrt(2.0 / windows)))
        flicker, walk = float(floor_variance(1.0, 0.0, mean_s, next_s)), float(floor_variance(0.0, 1.0, mean_s, next_s))
        rows.append([flicker / target, walk / target])
        targets.append(max(target - white, 0.0) / target)
    flicker2, walk2 = _not_negative(np.array(rows), np.array(targets))
    return AllanModel(model.white, math.sqrt(flicker2), math.sqrt(walk2))


def _seen(stretches: Sequence[tuple[NDArray[np.int64], Floats]], mean_s: int, next_s: int) -> tuple[float, float]:
    """Mean square of what the next seconds differed by, of the worst axis; and for how many windows there was room."""
    total, many, windows = np.zeros(3), 0, 0.0
    length = mean_s + next_s
    for slots, means in stretches:
        if len(slots) < length:
            continue
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(means - means.mean(axis=0), axis=0)])
        past = (sums[mean_s : len(sums) - next_s] - sums[: len(sums) - length]) / mean_s
        coming = (sums[length:] - sums[mean_s : len(sums) - next_s]) / next_s
        whole = slots[length - 1 :] - slots[: len(slots) - length + 1] == length - 1
        total += np.square(coming - past)[whole].sum(axis=0)
        many += int(whole.sum())
        windows += float(whole.sum()) / length
    return (float(total.max()) / many if many else 0.0), windows


def _not_negative(rows: Floats, targets: Floats) -> tuple[float, float]:
    """Least squares for two unknowns, neither of which may be negative."""
    best, least = (0.0, 0.0), float(targets @ targets)
    for chosen in ((0, 1), (0,), (1,)):
        found = np.zeros(2)
        found[list(chosen)] = np.linalg.lstsq(rows[:, chosen], targets, rcond=None)[0]
        loss = float(np.square(rows @ found - targets).sum())
        if bool((found >= 0.0).all()) and loss < least:
            best, least = (float(found[0]), float(found[1])), loss
    return best
