"""Settings and state of the collector, and the rule by which it is done (method 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.estimation.collector.intake import SourceStatus
from companion.estimation.means.windows import WHITE_SHARE, Estimate
from companion.physics.frames import Floats

_NO_ROOM: Final = 1e-300


class CollectorObstacle(msgspec.Struct, frozen=True):
    """Reason why nothing can be measured now."""

    words: str
    moving: bool = False
    """True for a movement, which a hand can end; False for a fault."""
    hold_still_s: int | None = None
    """Seconds to stand still yet, where nothing else is missing."""


class CollectorStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the collector; a glance leaves out what an estimate tells."""

    still_s: float
    """Good seconds, common to all sources, of the stretch under way."""
    steady_s: float
    """Seconds that count without a bad one until now."""
    good_now: bool
    """True if the latest second counts."""
    hold_still_s: int = 0
    """Seconds to stand still yet before a window is possible."""
    obstacle: CollectorObstacle | None = None
    """A movement now, or a source that is silent or stuck; by an estimate, too, what it still waits for."""
    enough: bool = False
    """The stop rule is met: `window` gives a result that more seconds would not better."""
    progress: float = 0.0
    """0..1 towards `enough`; falls to 0 when the stretch breaks."""
    sources: tuple[SourceStatus, ...] = ()
    measuring: str = ""
    """Words for a measurement under way."""
    left: str = ""
    """Part of `measuring` that says how much longer it takes, where that is minutes."""

    @property
    def waiting_for(self) -> str | None:
        """The obstacle's words."""
        return None if self.obstacle is None else self.obstacle.words

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

    @property
    def min_slots(self) -> int:
        """Whole seconds before which nothing is ever enough."""
        return max(math.ceil(self.min_still_s), 1)

    @property
    def max_slots(self) -> int:
        """Whole seconds after which everything is enough."""
        return max(math.floor(self.max_s), self.min_slots)


def is_enough(settings: Settings, found: Sequence[Estimate]) -> bool:
    """Tell whether every axis meets its target, or its white part is below 30 % of the part that stays."""
    return all(bool((each.white_variance <= _room(settings, each)).all()) for each in found)


def expected_s(settings: Settings, found: Sequence[Estimate]) -> int:
    """Return the good seconds after which it is expected to be enough, the noise staying as seen so far."""
    needed = [np.square(each.white) / np.maximum(_room(settings, each), _NO_ROOM) for each in found]
    longest = max((float(each.max()) for each in needed), default=0.0)
    return min(max(math.ceil(min(longest, settings.max_s)), settings.min_slots), settings.max_slots)


def _room(settings: Settings, own: Estimate) -> Floats:
    """Return the variance that white noise may leave in each axis; below zero for integers that are waited for."""
    target = np.repeat([settings.target_gyro_sigma_rad_s, settings.target_accel_sigma_m_s2], 3)
    stays = own.use_variance - own.white_variance
    room = np.maximum(np.square(target) - stays, WHITE_SHARE * stays)
    return np.where(own.undecided & np.isfinite(target), -1.0, room)
