"""When the samples of a device are taken, what its clock says then, and when the host reads them: plain numpy.

Written after the comparison of methods in sensors 4.4, and independent of the code under test.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RATE_HZ: Final = 200.0
LEAST_DELAY_S: Final = 0.0015
JITTER_S: Final = 0.0004
STALL_S: Final = 0.060


class Reads(NamedTuple):
    """One entry a sample."""

    taken_s: Floats
    """Times by the host's clock: the truth."""
    device_s: Floats
    arrival_s: Floats


def reads(
    *,
    timer_s: float,
    skew_ppm: float,
    seconds: float = 120.0,
    stalls: int = 12,
    seed: int = 0,
    sliding: bool = False,
    since_s: float = 100.0,
    device_since_s: float = 7.0,
) -> Reads:
    """Samples of a device behind an adapter that hands over every `timer_s`, read by a host that stalls.

    Args:
        skew_ppm: the device's clock is so much too fast.
        sliding: the clock that is off also paces the samples; else these come at the host's exact rate.
    """
    rng = np.random.default_rng([seed, 9])
    n = int(seconds * RATE_HZ)
    skew = 1.0 + skew_ppm * 1e-6
    passed_s = np.arange(n) / RATE_HZ / (skew if sliding else 1.0)
    taken_s = since_s + passed_s
    ready_s = np.maximum.accumulate(taken_s + LEAST_DELAY_S + rng.exponential(JITTER_S, n))
    arrival_s = np.ceil(ready_s / timer_s - 1e-9) * timer_s
    for start_s in since_s + rng.uniform(0.0, seconds, stalls):
        waiting = (arrival_s >= start_s) & (arrival_s < start_s + STALL_S)
        arrival_s[waiting] = start_s + STALL_S
    return Reads(taken_s, device_since_s + passed_s * skew, arrival_s)
