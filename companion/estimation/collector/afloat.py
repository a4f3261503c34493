"""The collector's side of a deck: when an estimate is due, how good it is, what is said of it."""

from __future__ import annotations

import msgspec

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.measurement import Measurement
from companion.estimation.collector.outlook import Settings
from companion.estimation.deck.deck import Deck
from companion.estimation.deck.estimate import MAX_S, MIN_LOOK_S, MIN_S, DeckFound, DeckWork
from companion.estimation.deck.outlook import Past, aim, more
from companion.estimation.means.windows import Window
from companion.physics.units import UNITS
from companion.samples import TRIADS

Smoothed = DeckFound | CalibrationRefusedError


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
    left: str = ""
    """The part of the words that says for how long yet."""


class Afloat:
    """Keeps the newest estimate of all seconds, and that of those since a write."""

    def __init__(self, deck: Deck, horizon_s: float) -> None:
        self._deck, self._horizon_s = deck, horizon_s
        self._kept: dict[float | None, tuple[range, Smoothed]] = {}
        self._past: list[Past] = []
        self._reference_deg: tuple[float, float] | None = None

    def clear(self) -> None:
        """What was worked out is of no use any more; the tilt it was given at stays, to compare with."""
        self._kept.clear()
        self._past.clear()

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
        if work.since_s is not None or not isinstance(found, DeckFound):
            return
        if (tilt := found.window.tilt) is not None:
            self._reference_deg = tilt.x_deg, tilt.y_deg
        if self._past and len(work.slots) <= self._past[-1].seconds:
            self._past.clear()
        self._past.append(Past(len(work.slots), found.known))

    def measurement(self, since_s: float | None) -> DeckMeasurement:
        """What a window is made of.

        Raises:
            CalibrationRefusedError: too few seconds.
        """
        slots = self._slots(since_s)
        if slots is None:
            raise CalibrationRefusedError(self._at_least(MIN_S if since_s is None else MIN_LOOK_S))
        kept = self._kept.get(since_s)
        known = kept[1] if kept is not None and kept[0] == slots else None
        return DeckMeasurement(slots=list(slots), estimate=list, work=self._work(slots, since_s), known=known)

    def progress(self, settings: Settings) -> Progress:
        """How far the newest estimate is from good enough."""
        kept = self._kept.get(None)
        found = None if kept is None else kept[1]
        if found is None or self.seconds < MIN_S:
            share = min(self.seconds / MIN_S, 1.0) / 4.0
            left = self._at_least(MIN_S)
            return Progress(enough=False, share=share, words=left, left=left)
        if isinstance(found, CalibrationRefusedError):
            return Progress(enough=False, share=0.0, words=str(found))
        targets = settings.target_gyro_sigma_rad_s, settings.target_accel_sigma_m_s2
        aims = [(aim(self._past, at, targets[at % 2]), TRIADS[at % 2]) for at in range(len(found.known))]
        last, triad = max(aims, key=lambda each: each[0].whole_s)
        if all(each.sigma <= each.goal for each, _ in aims):
            return Progress(enough=True, share=1.0, words="sigma is good enough")
        if self.seconds >= MAX_S:
            return Progress(enough=True, share=1.0, words=f"measured for {MAX_S // 60} min")
        left_s = max(last.whole_s - self.seconds, 1)
        left, unit = more(left_s), UNITS[triad]
        share = self.seconds / (self.seconds + left_s)
        return Progress(enough=False, share=share, words=f"{left}: {last.in_words(unit.si, unit.name)}", left=left)

    def _at_least(self, needed: int) -> str:
        return f"at least {max(needed - self.seconds, 1)} s more"

    def _slots(self, since_s: float | None) -> range | None:
        slots = self._deck.slots(since_s)
        return slots if len(slots) >= (MIN_S if since_s is None else MIN_LOOK_S) else None

    def _work(self, slots: range, since_s: float | None) -> DeckWork:
        reference = None if since_s is None else self._reference_deg
        return self._deck.work(slots, self._horizon_s, reference, since_s)
