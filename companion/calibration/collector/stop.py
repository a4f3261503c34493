"""When more seconds buy nothing, and when that is expected (method section 3, item 7)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.means.windows import WHITE_SHARE, Estimate, ImuEstimate
from companion.calibration.noise.allan import floor_variance


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """How long and how good. A target that nobody asked for is `math.inf`."""

    min_still_s: float
    max_s: float
    target_gyro_sigma_rad_s: float
    target_accel_sigma_m_s2: float
    horizon_s: float = 180.0
    dither: bool = False
    """Integers that do not tell are measured in another way afterwards: more seconds of them are not waited for."""

    @property
    def min_slots(self) -> int:
        """Whole seconds before which nothing is ever enough."""
        return max(math.ceil(self.min_still_s), 1)

    @property
    def max_slots(self) -> int:
        """Whole seconds after which everything is enough."""
        return max(math.floor(self.max_s), self.min_slots)


def is_enough(settings: Settings, estimates: Sequence[ImuEstimate]) -> bool:
    """Whether every axis meets its target, or its white part is below 30 % of what averaging cannot remove."""
    return all(
        bool(_done(triad.white_variance, triad.use_variance, np.asarray(target), _waited_for(settings, triad)).all())
        for triad, target in _triads(settings, estimates)
    )


def expected_s(settings: Settings, estimates: Sequence[ImuEstimate]) -> int:
    """Good seconds after which it is expected to be enough, the noise staying as seen so far."""
    triads = _triads(settings, estimates)
    if not triads:
        return settings.min_slots
    seconds = np.arange(settings.min_slots, settings.max_slots + 1, dtype=np.float64)[:, None]
    white = np.square(np.concatenate([triad.white for triad, _ in triads])) / seconds
    floor = floor_variance(
        np.concatenate([triad.flicker for triad, _ in triads]),
        np.concatenate([triad.walk for triad, _ in triads]),
        seconds,
        settings.horizon_s,
    )
    undecided = np.concatenate([_waited_for(settings, triad) for triad, _ in triads])
    done = _done(white, white + floor, np.repeat([target for _, target in triads], 3), undecided).all(axis=1)
    return settings.min_slots + int(done.argmax()) if done.any() else settings.max_slots


def _triads(settings: Settings, estimates: Sequence[ImuEstimate]) -> list[tuple[Estimate, float]]:
    gyros = [(item.gyro, settings.target_gyro_sigma_rad_s) for item in estimates]
    return gyros + [(item.accel, settings.target_accel_sigma_m_s2) for item in estimates]


def _waited_for(settings: Settings, triad: Estimate) -> NDArray[np.bool_]:
    return triad.undecided & (not settings.dither)


def _done(
    white: NDArray[np.float64], use: NDArray[np.float64], target: NDArray[np.float64], undecided: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    enough = (white < WHITE_SHARE * (use - white)) & ~undecided
    return np.asarray(np.where(undecided, np.isinf(target), use <= np.square(target)) | enough)
