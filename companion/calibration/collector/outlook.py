"""What is in the way of a measurement, and when more seconds buy nothing (method section 3, item 7)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.collector.intake import SourceStatus
from companion.calibration.means.windows import WHITE_SHARE, Estimate, ImuEstimate
from companion.calibration.noise.allan import floor_variance
from companion.physics.frames import Floats


class Obstacle(msgspec.Struct, frozen=True):
    """What is in the way of a measurement."""

    words: str
    moving: bool = False
    """Nothing but a movement, which a hand can end; no fault."""
    hold_still_s: int | None = None
    """Nothing but time: how long it has to stand still yet."""


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Where the collector stands."""

    still_s: float
    """Good seconds, common to all sources, of the stretch under way."""
    obstacle: Obstacle | None
    """None when still long enough and nothing is in the way."""
    enough: bool
    """The stop rule is met: `window` gives a result that more seconds would not better."""
    progress: float
    """0..1 towards `enough`; falls to 0 when the stretch breaks."""
    sources: tuple[SourceStatus, ...]
    measuring: str
    """What is under way where nothing is waited for, in words."""
    left: str = ""
    """For how long yet, where that is minutes; part of `measuring`."""

    @property
    def waiting_for(self) -> str | None:
        """The obstacle's words."""
        return None if self.obstacle is None else self.obstacle.words


class Glance(msgspec.Struct, frozen=True, kw_only=True):
    """What can be said of the stillness at once, without looking at the readings themselves."""

    obstacle: Obstacle | None
    """What is in the way at this moment, however long it has been still: it moves, or a source is silent or stuck."""
    still_s: float
    steady_s: float
    """Good seconds without a bad one until now."""

    @property
    def moving(self) -> bool:
        """Whether a movement is in the way."""
        return self.obstacle is not None and self.obstacle.moving

    @property
    def moves(self) -> str | None:
        """What moves at this moment; None where nothing does, however short a time it has been still."""
        found = self.obstacle
        return found.words if found is not None and found.moving and found.hold_still_s is None else None


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """How long and how good. A target that nobody asked for is `math.inf`."""

    min_still_s: float
    max_s: float
    target_gyro_sigma_rad_s: float
    target_accel_sigma_m_s2: float
    horizon_s: float = 180.0
    on_a_boat: str = 'set vehicle.platform = "deck"'
    """What to do where it sways with a regular wave, in words."""
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


def _done(white: Floats, use: Floats, target: Floats, undecided: NDArray[np.bool_]) -> NDArray[np.bool_]:
    enough = (white < WHITE_SHARE * (use - white)) & ~undecided
    return np.asarray(np.where(undecided, np.isinf(target), use <= np.square(target)) | enough)
