"""Angular rate of the platform under a standing aircraft: a quantity with a sigma, not an assumption.

Two witnesses: the slope of the heading since the last movement, and the gyros against their level at rest. A
significant rate blocks a calibration. A smaller one is not subtracted, since the ground does not turn, but belongs to
the sigma of every gyro. So does the slope of gravity, for the level axes; the gates refuse a larger tilt.

A heading that turns while the gyros stay at their level is a magnetic field that turns. Gyros that leave their level
while the heading stands have changed themselves. One gyro without compass cannot tell a turn from a new bias.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Final, Literal

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.estimation.noise.slope import FEWEST, fit_slope, hidden_by_steps, plain_slope
from companion.estimation.seconds.batch import Batch, decimal, few_distinct
from companion.estimation.turning.level import SIGNIFICANT, GyroChange, ImuLevel, common_change
from companion.physics.frames import Array, Matrix, vector, wrap_deg
from companion.physics.units import DEG
from companion.samples import Vector

LEAST_RAD_S: Final = 0.005 * DEG
"""A smaller rate never blocks: a compass warms up and wanders by some tenths of a degree in a minute."""
LEAST_BY_GYROS_RAD_S: Final = 0.01 * DEG
"""A smaller rate never blocks without compass: a gyro that warms up unevenly shows as much."""
CHANCE_SIGMAS: Final = 2.0
STEADY_SIGMAS: Final = 2.5
"""Seconds that are farther off do not join the level: a slow turn would become the level."""
EVEN: Final = 0.25
"""Share of the rate that each half of the headings must show; after a jump one half does not."""
CLEARED_S: Final = 10
"""Seconds after which gyros at their level have not begun to turn with the latest movement."""
SMOOTHED_OVER: Final = 5
"""Headings in one value of the wander, so that noise does not look like wander."""
BLIND_S: Final = 5
"""Longest pause, for example while offsets are written, after which headings still belong together."""

Witness = Literal["compass", "gyros", "compass and gyros", "earlier calibrations"]


class Turn(msgspec.Struct, frozen=True, kw_only=True):
    """Angular rate of the platform during a window."""

    rate_rad_s: float = 0.0
    """About the vertical, clockwise seen from above; never subtracted."""
    sigma_rad_s: float = 0.0
    noise_rad_s: float = 0.0
    """Sigma of the gyros without warm-up."""
    by: Witness | None = None
    """None: nothing measures it, and the platform counts as fixed to the Earth."""
    tilting_rad_s: Vector = (0.0, 0.0, 0.0)
    """Level part, vehicle FRD."""
    tilting_sigma_rad_s: float = 0.0
    step_rad_s: float = 0.0
    """Error of the window's mean where a turn may have begun within it."""
    is_vouched: bool = True
    """A compass has seen the level of the gyros at rest; else that level may hold a turn."""

    @property
    def is_significant(self) -> bool:
        """Whether the platform turns about the vertical."""
        least = LEAST_BY_GYROS_RAD_S if self.by == "gyros" else LEAST_RAD_S
        return abs(self.rate_rad_s) > max(SIGNIFICANT * self.sigma_rad_s, least)

    @property
    def in_words(self) -> str:
        """'turns 0.15 deg/s to the left'."""
        size = abs(self.rate_rad_s) / DEG
        digits = max(1, 1 - math.floor(math.log10(size))) if size > 0.0 else 2
        return f"turns {size:.{digits}f} deg/s to the {'right' if self.rate_rad_s > 0.0 else 'left'}"

    @property
    def is_chance(self) -> bool:
        """Whether a platform at rest may well show such a rate."""
        return abs(self.rate_rad_s) <= CHANCE_SIGMAS * self.sigma_rad_s

    @property
    def is_told(self) -> bool:
        """Whether the rate is measured; else the ground counts as fixed to the Earth."""
        return self.by is not None and self.is_vouched

    @property
    def at_most_rad_s(self) -> float:
        """Rate about the vertical that is hardly exceeded."""
        return abs(self.rate_rad_s) + 2.0 * self.sigma_rad_s

    @property
    def variance(self) -> float:
        """Variance of the error in a gyro about the vertical, (rad/s)^2.

        Without compass the ground counts as fixed unless the gyros show more than chance.
        """
        if self.is_told:
            return self.rate_rad_s**2 + self.sigma_rad_s**2 + self.step_rad_s**2
        known = self.rate_rad_s if abs(self.rate_rad_s) > self.noise_rad_s else 0.0
        return known**2 + self.step_rad_s**2

    def covariance(self, up: Array) -> Matrix:
        """Covariance of the error in every gyro, (3, 3) vehicle FRD; `up` (3,) is the vertical there."""
        level = np.eye(3) - np.outer(up, up)
        tilting = level @ np.array(self.tilting_rad_s)
        return np.outer(up, up) * self.variance + np.outer(tilting, tilting) + level * self.tilting_sigma_rad_s**2


class TurnWatch:
    """Estimates the platform's rate from every second of all sources.

    `span`: seconds of the longest window.
    """

    def __init__(self, span: int) -> None:
        self._span = span
        self._levels: dict[str, ImuLevel] = {}
        self._headings: deque[tuple[bool, Batch]] = deque(maxlen=span)
        """Seconds of the compass since the last movement, and whether each is one of the still stretch."""
        self._last_slot = 0
        self._start: int | None = None
        """First second of the still stretch."""
        self._is_suspect = False
        """Gyros that have moved or stepped since may be off their level by a turn; else they drift."""
        self.turn = Turn()
        """Rate as of the last second."""
        self.words = ""
        """Reason why no calibration is possible, for a pilot; empty without one."""
        self._forget_headings()

    def set_imu(self, name: str, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float]) -> None:
        """Add an IMU, or begin anew with another stream of it; arguments as for `ImuLevel`."""
        self._levels[name] = ImuLevel(rotation, profile, steps, self._span)

    def forget(self, imu: str | None) -> None:
        """Drop readings of one IMU, or of all: they are not comparable with later ones."""
        for name, level in self._levels.items():
            if imu is None or name == imu:
                level.forget()

    def new_stretch(self) -> None:
        """End the still stretch; its seconds join the levels."""
        turned = self._turned()
        for level in self._levels.values():
            level.new_stretch(turned)
        self._headings = deque(((False, batch) for _, batch in self._headings), maxlen=self._span)
        self._start = None
        self.turn = Turn()

    def moved(self) -> None:
        """The gyros or the gradienter felt a movement."""
        self._forget_headings()
        self._is_suspect = True
        self.words = ""

    def _forget_headings(self) -> None:
        self._headings.clear()
        self._smoothed: deque[float] = deque(maxlen=SMOOTHED_OVER)
        self._low_deg, self._high_deg = math.inf, -math.inf

    @property
    def wander_deg(self) -> float | None:
        """Range of the heading since the last movement; None until enough is known."""
        return self._high_deg - self._low_deg if math.isfinite(self._low_deg) else None

    def add_second(self, slot: int, imus: Mapping[str, Batch], heading: Batch | None, *, good: bool) -> bool:
        """Add a second in which nothing but, perhaps, the compass has moved; False where the stretch ends with it.

        Args:
            slot: ascending.
            imus: by name.
            heading: None without one, or while it still follows a movement.
            good: whether the second belongs to a still stretch.
        """
        if slot - self._last_slot > BLIND_S:
            self._forget_headings()
        self._last_slot = slot
        if heading is not None:
            self._add_heading(heading, good=good)
        if good:
            self._start = slot if self._start is None else self._start
            turned = self._turned()
            for name, level in self._levels.items():
                if name in imus:
                    level.add(slot, imus[name], turned)
        return self._judge(slot)

    def _add_heading(self, heading: Batch, *, good: bool) -> None:
        self._headings.append((good, heading))
        value = float(heading.mean[0])
        last = self._smoothed[-1] if self._smoothed else value
        self._smoothed.append(last + wrap_deg(value - last))
        if len(self._smoothed) == SMOOTHED_OVER:
            smooth = sum(self._smoothed) / SMOOTHED_OVER
            self._low_deg, self._high_deg = min(self._low_deg, smooth), max(self._high_deg, smooth)

    def _turned(self) -> float | None:
        """Variance of the rate by the compass, NaN without; None where seconds cannot join a level at rest."""
        turn = self.turn
        # By gyros alone a gradual change is a drift, and the level follows.
        drifts = turn.by == "gyros" and not self._is_suspect
        if self.words or (not drifts and abs(turn.rate_rad_s) > STEADY_SIGMAS * turn.sigma_rad_s):
            return None
        return turn.variance if turn.by in ("compass", "compass and gyros") else math.nan

    def _judge(self, slot: int) -> bool:
        looks = {name: look for name, level in self._levels.items() if (look := level.look())}
        # By the quietest gyro: a turn is in all of them.
        step = min(looks.values(), key=lambda look: look.white).step if looks else None
        if step is not None and step.is_sure:
            for level in self._levels.values():
                level.split(step.first)
            self._is_suspect = True
            return False
        changes = {name: look.change for name, look in looks.items() if look.change is not None}
        common = common_change(changes.values())
        seen = _by_compass([batch for _, batch in self._headings])
        if seen is None or not seen.is_significant:
            # A jump of the compass may lie before the still stretch.
            seen = _by_compass([batch for good, batch in self._headings if good])
        gyros = None if common is None else _by_gyros(common)
        turn = _weigh(gyros, seen)
        for name, change in changes.items():
            # A gyro has changed itself if other gyros or a heading that stands contradict it.
            others = gyros or turn if turn.is_significant else turn
            if change.is_across or change.contradicts(others.rate_rad_s, others.sigma_rad_s):
                self._levels[name].forget_level()
        if looks:
            surest = min(looks.values(), key=lambda one: one.tilting_variance)
            turn = msgspec.structs.replace(
                turn,
                tilting_rad_s=vector(surest.tilting_rad_s),
                tilting_sigma_rad_s=math.sqrt(surest.tilting_variance),
                step_rad_s=0.0 if step is None or turn.is_told else abs(step.off_rad_s),
            )
        self.turn = turn
        noise = turn.noise_rad_s if turn.by == "gyros" else turn.sigma_rad_s
        is_long = self._start is not None and slot - self._start >= CLEARED_S
        if is_long and abs(turn.rate_rad_s) <= STEADY_SIGMAS * noise:
            self._is_suspect = False
        turns = turn.is_significant and (turn.by != "gyros" or self._is_suspect)
        self.words = self._turning() if turns else ""
        return True

    def _turning(self) -> str:
        words = f"the aircraft {self.turn.in_words}"
        if self.turn.by == "compass and gyros":
            return f"{words}: gyros and compass turn together"
        if self.turn.by == "gyros" and len(self._levels) == 1:
            (name,) = self._levels
            return f"{words}, or gyro {name} has changed: if it stands still, restart the companion"
        return words


def _by_gyros(common: GyroChange) -> Turn:
    return Turn(
        rate_rad_s=common.down_rad_s,
        sigma_rad_s=math.sqrt(common.variance),
        noise_rad_s=math.sqrt(common.noise),
        by="gyros",
        is_vouched=common.is_vouched,
    )


def _by_compass(headings: list[Batch]) -> Turn | None:
    """Estimate the rate by the compass alone; never significant where the heading jumps instead of turning."""
    if len(headings) < FEWEST:
        return None
    slots = np.array([batch.slot for batch in headings], dtype=np.int64)
    turned = np.unwrap(np.array([batch.mean for batch in headings]), period=360.0, axis=0)
    white, low, high, distinct = (
        np.array([getattr(batch, name) for batch in headings]) for name in ("white", "low", "high", "distinct")
    )
    step = max(float(np.where(distinct == 2, high - low, 0.0).max()), float(decimal(low, high)[0]))
    hidden = hidden_by_steps(step, float(white.mean()), enough=not few_distinct(distinct)[0])
    # Few seconds say little about their own noise; the readings within them say more.
    least = math.sqrt(float(np.mean([batch.white[0] / batch.n for batch in headings])))
    found = fit_slope(slots, turned, white=least, hidden=hidden)
    rate, sigma = float(found.per_s[0]), math.sqrt(float(found.variance[0]))
    half = len(slots) // 2
    parts = [plain_slope(slots[part], turned[part, 0]) for part in (slice(None, -half), slice(half, None))]
    if not all(part * rate > EVEN * rate**2 for part in parts):
        sigma = max(sigma, abs(rate) / SIGNIFICANT)
    return Turn(rate_rad_s=rate * DEG, sigma_rad_s=sigma * DEG, by="compass")


def _weigh(gyros: Turn | None, seen: Turn | None) -> Turn:
    """Combine gyros and compass; where they contradict, gyros at their level are right."""
    if gyros is None or seen is None:
        return gyros or seen or Turn()
    if not gyros.is_vouched:
        return seen
    if abs(gyros.rate_rad_s - seen.rate_rad_s) > SIGNIFICANT * math.hypot(gyros.sigma_rad_s, seen.sigma_rad_s):
        return gyros if abs(gyros.rate_rad_s) <= SIGNIFICANT * gyros.sigma_rad_s else seen
    share = seen.sigma_rad_s**2 / (gyros.sigma_rad_s**2 + seen.sigma_rad_s**2)
    return Turn(
        rate_rad_s=share * gyros.rate_rad_s + (1.0 - share) * seen.rate_rad_s,
        sigma_rad_s=math.sqrt(share) * gyros.sigma_rad_s,
        by="compass and gyros",
    )
