"""How fast the platform turns under a standing aircraft: a quantity with a sigma, not an assumption.

Three witnesses: the slope of the heading since the gyros last felt a movement, the gyros against their own level at
rest, and for the level part the slope of gravity in the accelerometers. A rate that differs from zero significantly is
in the way of a calibration. One that does not is not taken off, since the ground does not turn; but what cannot be
excluded belongs to the sigma of every gyro.

Who turns, field or aircraft? If the compass turns while the gyros stay at their level, it is the field. If the gyros
have left their level while the heading stands, it is the gyros. Where only gyros speak, one alone cannot tell a turn
from a new bias; several can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final, Literal

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.estimation.noise.slope import FEWEST, fit_slope, hidden_by_steps, plain_slope
from companion.estimation.seconds.batch import Batch
from companion.estimation.seconds.recent import Recent
from companion.estimation.seconds.resolution import few_distinct, step
from companion.estimation.turning.level import Change, Common, ImuLevel, Step, common_change
from companion.physics.frames import Array, Floats, Matrix, vector
from companion.physics.units import DEG
from companion.samples import Vector

SIGNIFICANT: Final = 4.0
"""Sigmas. The rate is looked at every second: 3 would be exceeded by chance in one still minute of a hundred."""
LEAST_RAD_S: Final = 0.005 * DEG
"""What is in nobody's way, but in sigma: a compass warms up and wanders by a few tenths of a degree in a minute."""
LEAST_BY_GYROS_RAD_S: Final = 0.01 * DEG
"""Likewise where no compass says it too: a gyro that warms up unevenly may do the same."""
LEAST_TILTING_RAD_S: Final = 0.05 * DEG
"""Likewise of the tilt: accelerometers drift, and what was just set down settles by a few hundredths of a degree."""
CHANCE_SIGMAS: Final = 2.0
STEADY_SIGMAS: Final = 2.5
"""Seconds whose level is farther off make no part of it: a slow turn would become the level."""
EVEN: Final = 0.25
"""So much of the rate must each half of the headings show."""
STEP_SIGMAS: Final = 5.0
STEP_CHI_SQUARE: Final = 12.0
"""A step of the rate within a stretch ends it: what was before is a level, and what comes is compared with that."""
SUSPECT_SIGMAS: Final = 3.5
SUSPECT_CHI_SQUARE: Final = 4.0
"""A step that may be one makes every later sigma of the stretch larger: it will be forgotten by the level."""
CLEARED_S: Final = 10
"""So many seconds say whether the level is the one before."""
GROWN: Final = 30
"""A stretch of a minute and more is looked at again once it has grown by this part: a log may have an hour."""
CHANGED_RAD_S: Final = 0.5 * DEG
CHANGED_HELD_S: Final = 30
"""A gyro that is so far off its level by itself, by a shock, is believed after so long."""

Witness = Literal["compass", "gyros", "compass and gyros", "earlier calibrations"]


class Turn(msgspec.Struct, frozen=True, kw_only=True):
    """The platform's own angular rate during a window."""

    rate_rad_s: float = 0.0
    """About the vertical, clockwise seen from above; not taken off anything."""
    sigma_rad_s: float = 0.0
    noise_rad_s: float = 0.0
    """That of the gyros without what a warm-up may have done."""
    by: Witness | None = None
    """None: nothing tells, and the platform is taken for fixed to the Earth."""
    tilting_rad_s: Vector = (0.0, 0.0, 0.0)
    """The level part, vehicle FRD."""
    tilting_sigma_rad_s: float = 0.0
    is_even: bool = True
    """The heading does not jump."""
    step_rad_s: float = 0.0
    """A turn that may have begun within the window makes its mean wrong by so much; zero where nothing hints at one."""
    is_vouched: bool = True
    """The level of the gyros is one at rest as somebody else saw it; else as fixed as the ground is taken for."""
    gyros_stay: bool = False
    """The compass moves and the gyros do not: it is the field that turns."""

    @property
    def is_significant(self) -> bool:
        """Whether it turns about the vertical."""
        least = LEAST_BY_GYROS_RAD_S if self.by == "gyros" else LEAST_RAD_S
        return self.is_even and _is_significant(self.rate_rad_s, self.sigma_rad_s, least)

    @property
    def tilts(self) -> bool:
        """Whether it turns about a level axis."""
        return _is_significant(math.hypot(*self.tilting_rad_s), self.tilting_sigma_rad_s, LEAST_TILTING_RAD_S)

    @property
    def in_words(self) -> str:
        """'turns 0.15 deg/s to the left'."""
        size = abs(self.rate_rad_s) / DEG
        digits = max(1, 1 - math.floor(math.log10(size))) if size > 0.0 else 2
        return f"turns {size:.{digits}f} deg/s to the {'right' if self.rate_rad_s > 0.0 else 'left'}"

    @property
    def is_chance(self) -> bool:
        """Whether a platform that does not turn may well show that much."""
        return abs(self.rate_rad_s) <= CHANCE_SIGMAS * self.sigma_rad_s

    @property
    def is_told(self) -> bool:
        """Whether anybody has seen how fast it turns; else the ground is taken for fixed to the Earth."""
        return self.by is not None and self.is_vouched

    @property
    def at_most_rad_s(self) -> float:
        """The rate about the vertical that can hardly be exceeded."""
        return abs(self.rate_rad_s) + 2.0 * self.sigma_rad_s

    @property
    def variance(self) -> float:
        """Of the error that it makes in a gyro about the vertical, (rad/s)^2.

        Without a compass the ground is taken for fixed unless the gyros say more than chance would.
        """
        if self.by is None or (self.by == "gyros" and not self.gyros_stay):
            known = self.rate_rad_s if abs(self.rate_rad_s) > self.noise_rad_s else 0.0
            return known**2 + self.step_rad_s**2
        return self.rate_rad_s**2 + self.sigma_rad_s**2

    def covariance(self, up: Array) -> Matrix:
        """Of the error that it makes in every gyro, (3, 3) vehicle FRD, `up` (3,) being the vertical there."""
        level = np.eye(3) - np.outer(up, up)
        tilting = level @ np.array(self.tilting_rad_s)
        return np.outer(up, up) * self.variance + np.outer(tilting, tilting) + level * self.tilting_sigma_rad_s**2


def _is_significant(rate: float, sigma: float, least: float) -> bool:
    return abs(rate) > max(SIGNIFICANT * sigma, least)


def _by_gyros(common: Common, *, gyros_stay: bool = False) -> Turn:
    return Turn(
        rate_rad_s=common.rate,
        sigma_rad_s=math.sqrt(common.variance),
        noise_rad_s=math.sqrt(common.noise),
        by="gyros",
        is_vouched=common.is_vouched,
        gyros_stay=gyros_stay,
    )


_SLOT, _GOOD, _DEG, _WHITE, _N = range(5)
_LOW, _HIGH, _DISTINCT = (slice(at, at + 1) for at in range(5, 8))
_COLUMNS: Final = 8
"""Of a second of the compass."""


class TurnWatch:
    """Sees every second of all sources, and says how fast the platform turns.

    `span`: seconds of the longest window.
    """

    def __init__(self, span: int) -> None:
        self._span = span
        self._levels: dict[str, ImuLevel] = {}
        self._headings = Recent(span, _COLUMNS)
        """Seconds of the compass, and whether each was one of a still stretch."""
        self._start: int | None = None
        """First second of the stretch under way."""
        self._looked = 0
        """Last second in which it was looked at."""
        self._moved: int | None = None
        """Last second in which something else moved."""
        self._is_suspect = False
        """The gyros were seen to step, or moved: what they are off their level by may be a turn, not a drift."""
        self._suspected_rad_s = 0.0
        self.turn = Turn()
        """As of the last second."""
        self.words = ""
        """What is in the way, for a pilot; empty while nothing is."""

    def set_imu(self, name: str, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float]) -> None:
        """Add an IMU, or say that its stream is another kind now; as for `ImuLevel`."""
        self._levels[name] = ImuLevel(rotation, profile, steps, self._span)

    def forget(self, imu: str | None) -> None:
        """Readings of one IMU, or of all, are not comparable with earlier ones."""
        for name, level in self._levels.items():
            if imu is None or name == imu:
                level.forget()

    def new_stretch(self) -> None:
        """The still stretch is over."""
        for level in self._levels.values():
            level.new_stretch(trusted=self._is_steady, turn_variance=self._unknown)
        self._start = None
        self._suspected_rad_s = 0.0
        self.turn = Turn()

    def moved(self, slot: int) -> None:
        """The gyros or the gradienter felt a movement in that second."""
        self._moved = slot
        self._is_suspect = True
        self.words = ""

    def add_second(self, slot: int, imus: Mapping[str, Batch], heading: Batch | None, *, good: bool) -> bool:
        """One second in which nothing but, perhaps, the compass has moved; False where the stretch ends with it.

        Args:
            slot: ascending.
            imus: by name.
            heading: None where the compass said nothing, or still follows a movement.
            good: it is one of the still stretch.
        """
        if heading is not None:
            (mean,), (white,), (low,), (high,) = (
                each.tolist() for each in (heading.mean, heading.white, heading.low, heading.high)
            )
            self._headings.append([heading.slot, good, mean, white, heading.n, low, high, int(heading.distinct[0])])
        if good:
            if self._start is None:
                self._start = slot
            for name, level in self._levels.items():
                if name in imus:
                    level.add(slot, imus[name])
                level.keep(self._span, trusted=self._is_steady, turn_variance=self._unknown)
        seconds = 0 if self._start is None else min(slot - self._start, self._span)
        if 0 < slot - self._looked < seconds // GROWN:
            return True
        self._looked = slot
        return self._judge(slot)

    @property
    def _is_steady(self) -> bool:
        """Whether what was read can become a level: nothing turns, as far as anybody knows."""
        turn = self.turn
        if turn.by == "gyros" and not self._is_suspect:
            # What has come gradually is a drift, and the level goes with it.
            return not self.words
        return not self.words and abs(turn.rate_rad_s) <= STEADY_SIGMAS * turn.sigma_rad_s

    @property
    def _unknown(self) -> float | None:
        """Variance of the turn by others than the level; None where nobody else tells."""
        return None if self.turn.by in (None, "gyros") else self.turn.variance

    def _judge(self, slot: int) -> bool:
        looks = {name: look for name, level in self._levels.items() if (look := level.look()) is not None}
        # By the quietest gyro: a turn is in all of them.
        step = min(looks.values(), key=lambda look: look.white).step if looks else None
        if step is not None and step.sigmas > STEP_SIGMAS and step.beats_drift_by > STEP_CHI_SQUARE:
            for level in self._levels.values():
                level.split(step.first, turn_variance=self._unknown)
            self._is_suspect = True
            return False
        changes = {name: look.change for name, look in looks.items() if look.change is not None}
        common = common_change(list(changes.values()))
        start, moved = self._start, self._moved
        headings = self._headings.rows
        measured = headings[(headings[:, _GOOD] > 0.0) & (headings[:, _SLOT] >= (math.inf if start is None else start))]
        seen = self._slope(measured)
        self.turn, changed = self._weigh(common, seen, changes)
        if looks:
            surest = min(looks.values(), key=lambda one: one.tilting_variance)
            self.turn = msgspec.structs.replace(
                self.turn,
                tilting_rad_s=vector(surest.tilting_rad_s),
                tilting_sigma_rad_s=math.sqrt(surest.tilting_variance),
                step_rad_s=self._hint(step),
            )
        noise = self.turn.noise_rad_s if self.turn.by == "gyros" else self.turn.sigma_rad_s
        if start is not None and slot - start >= CLEARED_S and abs(self.turn.rate_rad_s) <= STEADY_SIGMAS * noise:
            self._is_suspect = False
        waits = self._believe(changes, changed)
        # A compass that turns breaks the stretch again and again, but not its memory.
        since = headings if moved is None else headings[headings[:, _SLOT] > moved]
        longer = seen if len(since) <= len(measured) else self._slope(since)
        if longer is None or not longer.is_even or self.turn.gyros_stay or self._contradicts(common, longer):
            lasting = Turn()
        else:
            lasting, _ = self._weigh(common, longer, {})
        if lasting.is_significant:
            self.words = self._turning(lasting.rate_rad_s)
        elif self.turn.is_significant and (self.turn.by != "gyros" or self._is_suspect):
            self.words = self._turning(self.turn.rate_rad_s)
        elif self.turn.tilts:
            rate = math.hypot(*self.turn.tilting_rad_s) / DEG
            self.words = f"the aircraft tilts by {rate:.3f} deg/s"
        else:
            self.words = waits
        return True

    def _hint(self, step: Step | None) -> float:
        """What a turn that perhaps began within this stretch makes the mean wrong by."""
        if step is None:
            return self._suspected_rad_s
        if step.sigmas > SUSPECT_SIGMAS and step.beats_drift_by > SUSPECT_CHI_SQUARE:
            self._suspected_rad_s = max(abs(step.jump_rad_s), self._suspected_rad_s)
        return max(abs(step.off_rad_s), self._suspected_rad_s)

    def _turning(self, rate_rad_s: float) -> str:
        words = f"the aircraft {Turn(rate_rad_s=rate_rad_s).in_words}"
        if self.turn.by == "compass and gyros":
            return f"{words}: gyros and compass turn together"
        if self.turn.by == "gyros" and len(self._levels) == 1:
            (name,) = self._levels
            return f"{words}, or gyro {name} has changed: if it stands still, restart the companion"
        return words

    @staticmethod
    def _slope(headings: Floats) -> Turn | None:
        """By the compass alone; even if the heading goes on from beginning to end, as in a turn and after no jump."""
        if len(headings) < FEWEST:
            return None
        slots, values, white = headings[:, _SLOT].astype(np.int64), headings[:, _DEG], headings[:, _WHITE]
        turned = np.zeros((len(slots), 1))
        np.cumsum(np.mod(values[1:] - values[:-1] + 180.0, 360.0) - 180.0, out=turned[1:, 0])
        low, high, distinct = headings[:, _LOW], headings[:, _HIGH], headings[:, _DISTINCT]
        coarse, few = float(step(low, high, distinct)[0]), bool(few_distinct(distinct)[0])
        hidden = hidden_by_steps(coarse, float(white.mean()), dithered=not few)
        # Few seconds say little about their own noise; what is inside them says more.
        least = math.sqrt(float(np.mean(white / headings[:, _N])))
        found = fit_slope(slots, turned, white=least, hidden=hidden)
        rate = float(found.per_s[0])
        half = len(slots) // 2
        parts = [plain_slope(slots[part], turned[part, 0]) for part in (slice(None, -half), slice(half, None))]
        is_even = all(part * rate > EVEN * rate**2 for part in parts)
        sigma = math.sqrt(float(found.variance[0]))
        return Turn(rate_rad_s=rate * DEG, sigma_rad_s=sigma * DEG, by="compass", is_even=is_even)

    @staticmethod
    def _contradicts(common: Common | None, seen: Turn) -> bool:
        if common is None or not common.is_vouched:
            return False
        return abs(common.rate - seen.rate_rad_s) > SIGNIFICANT * math.sqrt(common.variance + seen.sigma_rad_s**2)

    def _weigh(self, common: Common | None, seen: Turn | None, changes: Mapping[str, Change]) -> tuple[Turn, set[str]]:
        """The turn by both witnesses, and the IMUs that have changed by themselves."""
        changed = {name for name, change in changes.items() if change.is_across}
        if common is not None:
            changed |= {
                name
                for name, change in changes.items()
                if abs(change.down_rad_s - common.rate) > SIGNIFICANT * math.sqrt(change.variance + common.variance)
            }
        elif changes:
            changed = set(changes)
        if seen is None:
            return (Turn() if common is None else _by_gyros(common)), changed
        if common is None or not common.is_vouched:
            return seen, changed
        if self._contradicts(common, seen):
            if abs(common.rate) <= SIGNIFICANT * math.sqrt(common.variance):
                return _by_gyros(common, gyros_stay=True), changed
            if abs(seen.rate_rad_s) <= SIGNIFICANT * seen.sigma_rad_s:
                changed = set(changes)
            return seen, changed
        share = seen.sigma_rad_s**2 / (common.variance + seen.sigma_rad_s**2)
        both = Turn(
            rate_rad_s=share * common.rate + (1.0 - share) * seen.rate_rad_s,
            sigma_rad_s=math.sqrt(share * common.variance),
            by="compass and gyros",
        )
        return both, changed

    def _believe(self, changes: Mapping[str, Change], changed: Iterable[str]) -> str:
        """Take the new level of gyros that have changed by themselves, the large changes after a while; the words."""
        words = ""
        for name, level in self._levels.items():
            if name not in changed:
                level.held = 0
                continue
            size = changes[name].largest_rad_s
            level.held += 1
            if size <= CHANGED_RAD_S or level.held >= CHANGED_HELD_S:
                level.adopt()
            else:
                words = words or f"gyro {name} is {size / DEG:.2f} deg/s off its level at rest"
        return words
