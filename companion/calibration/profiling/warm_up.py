"""By how much the biases of one part move while it warms up, out of recordings that begin when it is switched on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.calibration.noise.allan import WARM_UP_K
from companion.calibration.profiling.profile_fit import Rest
from companion.errors import CalibrationRefusedError
from companion.physics.frames import Floats

LEAST_S: Final = 900
"""Boards warm up within 20 min, most of it in the first ten."""
_BLOCK_S: Final = 60
_LEAST_IN_BLOCK: Final = 30
_LEAST_K: Final = 3.0
"""A thermometer that moves by less tells nothing of what a kelvin does."""


def learn_warm_up(recordings: Sequence[Sequence[Rest]]) -> tuple[float, float]:
    """What `WARM_UP_K` do to gyro and accelerometer: rad/s and m/s^2 of the axis that moves most.

    The range of the minutes' means of each recording (its stretches at rest, in the order of time); where its
    thermometer moved, in proportion to that, but not less than the range itself.

    Raises:
        CalibrationRefusedError: too little at rest.
    """
    found = np.zeros(2)
    for rests in recordings:
        minutes = np.array([row for rest in rests for row in _minutes(rest)])
        seconds = sum(len(rest.slots) for rest in rests)
        if seconds < LEAST_S or len(minutes) < 2:
            raise CalibrationRefusedError(
                f"--warm-up: {seconds} s at rest; to see a warm-up takes {LEAST_S} s from the switch-on"
            )
        moved = np.ptp(minutes, axis=0)
        kelvin = float(moved[6])
        share = max(WARM_UP_K / kelvin, 1.0) if kelvin >= _LEAST_K else 1.0
        found = np.maximum(found, np.array([moved[:3].max(), moved[3:6].max()]) * share)
    return float(found[0]), float(found[1])


def _minutes(rest: Rest) -> list[Floats]:
    """Means of six axes and the thermometer (NaN: none) over each minute that is mostly there."""
    block = (rest.slots - rest.slots[0]) // _BLOCK_S
    table = np.column_stack([rest.means, rest.temperature_degc])
    return [table[block == k].mean(axis=0) for k in np.unique(block) if (block == k).sum() >= _LEAST_IN_BLOCK]
