"""The collector's side of a deck: when an estimate is due, how good it is, what is said of it."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from companion.calibration.collector.measurement import Measurement
from companion.calibration.collector.outlook import Settings
from companion.calibration.deck.deck import Deck
from companion.calibration.deck.estimate import MAX_S, MIN_LOOK_S, MIN_S, DeckFound, DeckWork, Triads
from companion.calibration.means.windows import WHITE_SHARE, Window
from companion.errors import CalibrationRefusedError
from companion.physics.units import DEG_H, MG

Smoothed = DeckFound | CalibrationRefusedError
_FASTER: Final = 2.0 / 3.0
"""Time over what sigma falls to: through waves and compass noise a slope falls with the time to the power 1.5."""


class DeckMeasurement(Measurement, frozen=True, kw_only=True):
    """Everything that a deck's window is made of, perhaps worked out already."""

    work: DeckWork
    known: Smoothed | None

    def window(self) -> Window:
        """Work it out, if nobody has.

        Raises:
            CalibrationRefusedError: the readings do not tell.
        """
        found = self.known or self.work.run()
        if isinstance(found, CalibrationRefusedError):
            raise found
        return found.window


class Progress(msgspec.Struct, frozen=True):
    """How far it is."""

    enough: bool
    share: float
    words: str


class Afloat:
    """Keeps the newest estimate of all seconds, and that of those since a write."""

    def __init__(self, deck: Deck, horizon_s: float) -> None:
        self._deck, self._horizon_s = deck, horizon_s
        self._kept: dict[float | None, tuple[range, Smoothed]] = {}
        self._reference_deg: tuple[float, float] | None = None

    def clear(self) -> None:
        """What was worked out is of no use any more; the tilt it was given at stays, to compare with."""
        self._kept.clear()

    @property
    def seconds(self) -> int:
        """How many there are."""
        return self._deck.seconds

    def pending(self, since_s: float | None) -> DeckWork | None:
        """What has to be worked out now; None when there is nothing."""
        slots = self._slots(since_s)
        kept = self._kept.get(since_s)
        return None if slots is None or (kept is not None and kept[0] == slots) else self._work(slots, since_s)

    def accept(self, work: DeckWork, found: Smoothed) -> None:
        """Take what was found, unless what it is of was forgotten meanwhile."""
        if self._slots(work.since_s) is None:
            return
        self._kept = {key: one for key, one in self._kept.items() if key is None or key == work.since_s}
        self._kept[work.since_s] = (work.slots, found)
        if work.since_s is None and isinstance(found, DeckFound) and (tilt := found.window.tilt) is not None:
            self._reference_deg = tilt.x_deg, tilt.y_deg

    def measurement(self, since_s: float | None) -> DeckMeasurement:
        """What a window is made of.

        Raises:
            CalibrationRefusedError: too few seconds.
        """
        slots = self._slots(since_s)
        if slots is None:
            raise CalibrationRefusedError(
                f"measured {self.seconds} s of at least {MIN_S if since_s is None else MIN_LOOK_S} s"
            )
        kept = self._kept.get(since_s)
        known = kept[1] if kept is not None and kept[0] == slots else None
        return DeckMeasurement(
            slots=list(slots),
            estimate=list,
            settling=None,
            tilt=None,
            heading=None,
            field=None,
            work=self._work(slots, since_s),
            known=known,
        )

    def progress(self, settings: Settings) -> Progress:
        """How far the newest estimate is from good enough."""
        kept = self._kept.get(None)
        found = None if kept is None else kept[1]
        if found is None:
            share = min(self.seconds / MIN_S, 1.0) / 4.0
            return Progress(enough=False, share=share, words=f"measured {self.seconds} s of at least {MIN_S} s")
        if isinstance(found, CalibrationRefusedError):
            return Progress(enough=False, share=0.0, words=str(found))
        farthest, words = 1.0, "sigma is good enough"
        for triads in found.triads:
            for sigma, goal, unit, digits in _goals(triads, settings):
                if goal / sigma < farthest:
                    farthest = goal / sigma
                    words = f"sigma {sigma:.{digits}f} {unit}, good at {goal:.{digits}f}"
        full = self.seconds >= MAX_S
        return Progress(enough=farthest >= 1.0 or full, share=farthest**_FASTER, words=words)

    def _slots(self, since_s: float | None) -> range | None:
        slots = self._deck.slots(since_s)
        return slots if len(slots) >= (MIN_S if since_s is None else MIN_LOOK_S) else None

    def _work(self, slots: range, since_s: float | None) -> DeckWork:
        reference = None if since_s is None else self._reference_deg
        return self._deck.work(slots, self._horizon_s, reference, since_s)


def _goals(triads: Triads, settings: Settings) -> list[tuple[float, float, str, int]]:
    """Sigma and what is enough, of gyros and accelerometers: the target, or all that more time can give."""
    found = []
    for use, white, target, unit, name, digits in (
        (triads.gyro_use, triads.gyro_white, settings.target_gyro_sigma_rad_s, DEG_H, "deg/h", 1),
        (triads.accel_use, triads.accel_white, settings.target_accel_sigma_m_s2, MG, "mg", 2),
    ):
        goal = max(target, math.sqrt((use - white) * (1.0 + WHITE_SHARE)))
        found.append((math.sqrt(use) / unit, goal / unit, name, digits))
    return found
