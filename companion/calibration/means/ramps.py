"""Is the slope of a window a warm-up, whose end counts, or chance and the part's own wander (method section 2.4)?

An untested line costs more than it saves: its end has four times the variance of a mean, and a part that wanders comes
back. So a slope must exceed what white noise makes and what the flicker and walk of the part make.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.robust import Line
from companion.physics.frames import Floats

RAMP_T: Final = 5.0
"""|t| of a slope that counts as one, more in a short window. On sensors without a ramp a lower one costs more than it
saves (2.4)."""
RAMP_FLOORS: Final = 3.0
"""Standard deviations of the slope that the part's own flicker and walk make. In a minute of an ADIS16405's
accelerometers 8 % of the slopes exceed |t| = 5 by flicker alone, and taking their ends costs 12 % of the rms error."""
RAMP_BATCHES: Final = 8
"""Fewer seconds make no line."""
_ONE_IN_10000: Final = 3.8906
"""Sigmas that a normal number exceeds with this probability, on either side."""


def is_ramp(line: Line, count: int, wander: Floats) -> NDArray[np.bool_]:
    """(c,) which columns' slopes are ramps.

    Args:
        line: through every column.
        count: of its values.
        wander: (c,) variance of a slope by the part's own flicker and walk; zero where they are not known.
    """
    chance = np.abs(line.t_statistic) > slope_limit(count)
    return np.asarray(chance & (np.abs(line.slope) > RAMP_FLOORS * np.sqrt(wander)))


def slope_limit(count: int) -> float:
    """|t| that the slope through so many values, at least 3, must exceed: `RAMP_T`, more for few.

    Of windows of 10 values 0.36 % show |t| > 5 by chance, and the end of such a line is far off. Student's t that
    chance exceeds once in 10 000, by Wallace's approximation (Biometrika 46 (1959) 124-130), is 7.2 there; from 20
    values on it is below 5.
    """
    freedom = count - 2.0
    normal = _ONE_IN_10000 * (8.0 * freedom + 3.0) / (8.0 * freedom + 1.0)
    return max(RAMP_T, math.sqrt(freedom * math.expm1(normal**2 / freedom)))
