"""Watch for a turn of the ground, second by second, by two witnesses.

The witnesses are the slope of the heading since the last movement, and the gyros against their level at rest. A heading
that turns while the gyros stay at their level is a magnetic field that turns. Gyros that leave their level while the
heading stands have changed themselves. One gyro without compass cannot tell a turn from a new bias.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Final

import msgspec

from companion.config.sections import NoiseProfile
from companion.estimation.seconds.batch import Batch
from companion.estimation.turning.level import ImuLevel
from companion.estimation.turning.turn import Turn, by_both, by_compass, by_gyros
from companion.physics.frames import Matrix, vector, wrap_deg

STEADY_SIGMAS: Final = 2.5
"""Seconds that are farther off do not join the level: a slow turn would become the level."""
CLEARED_S: Final = 10
"""Seconds after which gyros at their level have not begun to turn with the latest movement."""
SMOOTHED_OVER: Final = 5
"""Headings in one value of the wander, so that noise does not look like wander."""
BLIND_S: Final = 5
"""Longest pause, for example while offsets are written, after which headings still belong together."""


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
        found = {name: one for name, level in self._levels.items() if (one := level.evidence())}
        # A turn is in all gyros; the quietest shows its beginning best.
        quietest = min(found.values(), key=lambda one: one.white, default=None)
        if quietest is not None and quietest.began is not None:
            for level in self._levels.values():
                level.split(quietest.began)
            self._is_suspect = True
            return False
        gyros = by_gyros([one.turn for one in found.values() if one.turn is not None and not one.has_changed])
        seen = by_compass([batch for _, batch in self._headings])
        if seen is None or not seen.is_significant:
            # A jump of the compass may lie before the still stretch.
            seen = by_compass([batch for good, batch in self._headings if good])
        turn = by_both(gyros, seen)
        # A gyro has changed itself if other gyros or a heading that stands contradict it.
        others = gyros or turn if turn.is_significant else turn
        for name, one in found.items():
            if one.turn is not None and (one.has_changed or one.turn.contradicts(others)):
                self._levels[name].forget_level()
        if quietest is not None:
            surest = min(found.values(), key=lambda one: one.tilting_variance)
            turn = msgspec.structs.replace(
                turn,
                tilting_rad_s=vector(surest.tilting_rad_s),
                tilting_sigma_rad_s=math.sqrt(surest.tilting_variance),
                step_rad_s=0.0 if turn.is_told else quietest.step_rad_s,
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
