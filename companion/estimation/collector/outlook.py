"""Settings and state of the collector, and the rule by which it is done (method 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.collector.intake import SourceStatus
from companion.estimation.means.windows import WHITE_SHARE, Estimate, ImuEstimate
from companion.estimation.noise.allan import floor_variance
from companion.physics.frames import Floats


class Obstacle(msgspec.Struct, frozen=True):
    """Reason why nothing can be measured now."""

    words: str
    moving: bool = False
    """True for a movement, which a hand can end; False for a fault."""
    hold_still_s: int | None = None
    """Seconds to stand still yet, where nothing else is missing."""


class Progress(msgspec.Struct, frozen=True):
    """Progress of an estimate towards good enough."""

    enough: bool
    share: float
    words: str
    left: str = ""
    """Part of the words that says how much longer it takes."""
    refused: str = ""
    """Reason why the readings give no estimate."""


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """State of the collector."""

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
    """Words for a measurement under way."""
    left: str = ""
    """Part of `measuring` that says how much longer it takes, where that is minutes."""

    @property
    def waiting_for(self) -> str | None:
        """The obstacle's words."""
        return None if self.obstacle is None else self.obstacle.words


class Glance(msgspec.Struct, frozen=True, kw_only=True):
    """State of the stillness, without any estimate."""

    obstacle: Obstacle | None
    """A movement now, or a source that is silent or stuck."""
    still_s: float
    steady_s: float
    """Good seconds without a bad one until now."""

    @property
    def moving(self) -> bool:
        """True for a movement now."""
        return self.obstacle is not None and self.obstacle.moving

    @property
    def moves(self) -> str | None:
        """Words for a movement at this moment; None where nothing moves."""
        found = self.obstacle
        return found.words if found is not None and found.moving and found.hold_still_s is None else None


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Lengths and targets of a calibration; a target that is not wanted is `math.inf`."""

    min_still_s: float
    max_s: float
    target_gyro_sigma_rad_s: float
    target_accel_sigma_m_s2: float
    horizon_s: float = 180.0
    dither: bool = False
    """True: undecided integers are measured by a dither afterwards, and are not waited for."""

    @property
    def min_slots(self) -> int:
        """Whole seconds before which nothing is ever enough."""
        return max(math.ceil(self.min_still_s), 1)

    @property
    def max_slots(self) -> int:
        """Whole seconds after which everything is enough."""
        return max(math.floor(self.max_s), self.min_slots)


def is_enough(settings: Settings, found: Sequence[ImuEstimate]) -> bool:
    """Tell whether every axis meets its target, or its white part is below 30 % of the part that stays."""
    target = _targets(settings)
    return all(
        bool(_done(one.white_variance, one.use_variance, target, _waited_for(settings, one)).all())
        for one in (each.own for each in found)
    )


def expected_s(settings: Settings, found: Sequence[ImuEstimate]) -> int:
    """Good seconds after which it is expected to be enough, the noise staying as seen so far."""
    if not found:
        return settings.min_slots
    own = [each.own for each in found]
    seconds = np.arange(settings.min_slots, settings.max_slots + 1, dtype=np.float64)[:, None]
    white = np.square(np.concatenate([one.white for one in own])) / seconds
    floor = floor_variance(
        np.concatenate([one.flicker for one in own]),
        np.concatenate([one.walk for one in own]),
        seconds,
        settings.horizon_s,
    )
    undecided = np.concatenate([_waited_for(settings, one) for one in own])
    done = _done(white, white + floor, np.tile(_targets(settings), len(own)), undecided).all(axis=1)
    return settings.min_slots + int(done.argmax()) if done.any() else settings.max_slots


def _targets(settings: Settings) -> Floats:
    return np.repeat([settings.target_gyro_sigma_rad_s, settings.target_accel_sigma_m_s2], 3)


def _waited_for(settings: Settings, own: Estimate) -> NDArray[np.bool_]:
    return own.undecided & (not settings.dither)


def _done(white: Floats, use: Floats, target: Floats, undecided: NDArray[np.bool_]) -> NDArray[np.bool_]:
    enough = (white < WHITE_SHARE * (use - white)) & ~undecided
    return np.asarray(np.where(undecided, np.isinf(target), use <= np.square(target)) | enough)
