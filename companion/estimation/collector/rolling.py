"""The rolling collector: every stream in, one still stretch out.

It knows no clock: time comes in with the samples and with `now_s`. All sources share one 1 s grid; a second counts
when every source was still in it. Method 2.4, 3.1 and 3.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.afloat import Afloat
from companion.estimation.collector.intake import Intake, Source
from companion.estimation.collector.measurement import Estimates, Found, Measurement, Work
from companion.estimation.collector.outlook import Glance, Obstacle, Settings, Status, expected_s, is_enough
from companion.estimation.collector.swell import Swell
from companion.estimation.collector.trace import Snapshot, TraceLog
from companion.estimation.deck.deck import Deck
from companion.estimation.deck.estimate import DeckWork
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.stillness.stretch import HeadingWatch, Stretch

MIN_BATCHES: Final = 5
"""Of a window that was asked for with `since_s`: fewer say nothing about their own scatter."""

_GRACE_S: Final = 1.0
"""How long after its end a second waits for a silent source: the latency of a busy telemetry link."""
_CLOSE_S: Final = 0.25
_MARGIN: Final = 8


class RollingCollector(Intake):
    """Collects batches of all sources, judges stillness, and gives means of the still stretch.

    Pure: no clock and no I/O. Nothing that a sample holds makes it raise; what is dropped is counted by reason.
    Memory is bounded: `max_s` and a margin of one-second batches a source. None: there is no gradienter, no compass.

    Raises:
        ValueError: two IMUs of one name.
    """

    def __init__(
        self,
        settings: Settings,
        imus: Sequence[ImuInput],
        gradienter: GradienterModel | None = None,
        compass: CompassModel | None = None,
        *,
        on_deck: bool = False,
    ) -> None:
        if len({imu.name for imu in imus}) != len(imus):
            raise ValueError("two IMUs have one name")
        self._settings = settings
        self._min_good, self._max_slots = settings.min_slots, settings.max_slots
        self._least = min(MIN_BATCHES, self._min_good)
        deck = Deck(gradienter, compass) if on_deck else None
        super().__init__(self._max_slots + _MARGIN, gradienter, compass, deck, span=self._max_slots)
        self._afloat = None if deck is None else Afloat(deck, settings.horizon_s)
        self._watch = HeadingWatch()
        self._stretch = Stretch(self._min_good, self._max_slots)
        self._next: int | None = None
        self._now_s = -math.inf
        self._good: dict[int, bool] = {}
        self._estimates = Estimates()
        self._trace = TraceLog()
        self._restarts = 0
        self._swell = Swell()
        self.on_second: list[Callable[[], object]] = []
        """Called when every source has closed a second, from within the call that closed it: they only take note."""
        for imu in imus:
            self.set_imu(imu)

    # ------------------------------------------------------------------------------------------------- what changes

    def retarget(self, settings: Settings) -> None:
        """Other targets from the next look on; the lengths (`min_still_s`, `max_s`) stay as they were."""
        self._settings = msgspec.structs.replace(
            self._settings,
            target_gyro_sigma_rad_s=settings.target_gyro_sigma_rad_s,
            target_accel_sigma_m_s2=settings.target_accel_sigma_m_s2,
        )

    def reset(self, why: str, imu: str | None = None) -> None:
        """Forget what was measured, of one IMU or of everything: armed, offsets written, restarted.

        The second under way is forgotten too. The stretch begins again; learned noise stays.
        """
        self._forget(imu)
        if self._afloat is not None:
            self._afloat.clear()

    def tick(self, now_s: float) -> None:
        """Let the seconds end that are over at `now_s` (the samples' clock), also of sources that say nothing.

        Whoever feeds it does this, a few times a second; everything below only looks.
        """
        if math.isfinite(now_s):
            self._now_s = now_s
            for source in self._sources():
                source.batches.close_before(now_s - _CLOSE_S)
            if self._field is not None:
                self._field.batches.close_before(now_s - _CLOSE_S)
        self._evaluate()

    # ------------------------------------------------------------------------------------------------- what is known

    def glance(self, now_s: float) -> Glance:
        """How still it is at `now_s`; costs a small part of what `status` does."""
        afloat, stretch = self._afloat, self._stretch
        still, steady = (stretch.good, stretch.steady) if afloat is None else (afloat.seconds, afloat.seconds)
        return Glance(obstacle=self._obstacle(now_s), still_s=float(still), steady_s=float(steady))

    def pending(self, now_s: float, *, since_s: float | None = None) -> Work | DeckWork | None:
        """What `window` would have to work out now, for somebody who does it elsewhere; None when there is nothing.

        It takes milliseconds, more on small boards, and what must be answered at once shall not wait for it.
        """
        if self._obstacle(now_s) is not None:
            return None
        if self._afloat is not None:
            return self._afloat.pending(since_s)
        slots = self._slots(since_s)
        if not self._are_enough(slots, since_s) or self._estimates.known(slots[-1], since_s) is not None:
            return None
        return self._work(slots, since_s)

    def accept(self, work: Work | DeckWork, found: Any) -> None:
        """Take what such work has found; too late, it is left."""
        if isinstance(work, Work):
            self._estimates.keep(work, found)
        elif self._afloat is not None:
            self._afloat.accept(work, found)

    def status(self, now_s: float) -> Status:
        """Where it stands at `now_s` (the samples' clock). Its figures may be those of the second before."""
        sources = tuple(source.status(now_s) for source in self._sources())
        if self._afloat is not None:
            obstacle, found = self._obstacle(now_s), self._afloat.progress(self._settings)
            return Status(
                still_s=float(self._afloat.seconds),
                obstacle=obstacle,
                enough=found.enough and obstacle is None,
                progress=min(found.share, 1.0 if found.enough else 0.99),
                sources=sources,
                measuring=found.words,
                left=found.left,
            )
        waiting, enough, progress = self._waiting_for(now_s), False, 0.0
        if self._stretch.begun and waiting is None:
            estimates = self._estimate_later(self._slots(None), None, late=1)()
            if isinstance(estimates, CalibrationRefusedError):
                waiting = Obstacle(str(estimates))
            else:
                enough = self._stretch.full or is_enough(self._settings, estimates)
                needed = max(expected_s(self._settings, estimates), self._stretch.good + 1)
                progress = 1.0 if enough else self._stretch.good / needed
        elif self._stretch.start is not None:
            progress = min(self._stretch.good / self._max_slots, 0.99)
        return Status(
            still_s=float(self._stretch.good),
            obstacle=waiting,
            enough=enough,
            progress=min(progress, 1.0 if enough else 0.99),
            sources=sources,
            measuring=f"still for {self._stretch.good} s",
        )

    def window(self, now_s: float, *, since_s: float | None = None) -> Window:
        """Means over the still stretch that ends with the latest complete second, at most `max_s` long.

        Of seconds that lie wholly after `since_s`, for a look at what a write has done, 5 good ones are enough;
        `duration_s` says how many there were.

        Raises:
            CalibrationRefusedError: not still, not still for long enough, or a source fails its checks.
        """
        return self.measurement(now_s, since_s=since_s).window()

    def measurement(self, now_s: float, *, since_s: float | None = None) -> Measurement:
        """What `window` would give, not worked out yet; costs a small part of it.

        Raises:
            CalibrationRefusedError: not still, or not still for long enough.
        """
        if (reason := self._obstacle(now_s)) is not None:
            raise CalibrationRefusedError(reason.words)
        if self._afloat is not None:
            return self._afloat.measurement(since_s)
        slots = self._slots(since_s)
        if not self._are_enough(slots, since_s):
            needed = self._min_good if since_s is None else self._least
            raise CalibrationRefusedError(f"still for {len(slots)} s only, needs {needed} s")
        return Measurement(
            slots=slots,
            estimate=self._estimate_later(slots, since_s),
            settling=self._settles(slots, 0),
            tilt=None if self._tilt is None else self._tilt.settled(slots),
            heading=None if self._heading is None else self._heading.settled(slots),
            from_field=self._field is not None and self._field.from_field,
            wander_deg=self.wander_deg,
            field=self._field.window(slots) if self._field and self._heading else None,
            begun_s=self.begun_s,
            turn=self.turn,
        )

    @property
    def wander_deg(self) -> float | None:
        """How far the heading has wandered since the aircraft last moved; None until that is known."""
        return self._watch.wander_deg

    def snapshot(self, started_s: float, measured_s: tuple[float, float] | None) -> Snapshot:
        """What was seen since `started_s`, or since the window `measured_s` (start, end) began; cheap."""
        return self._trace.snapshot(started_s, measured_s)

    # ------------------------------------------------------------------------------------------------- inside

    def _break(self) -> None:
        self._stretch.clear()
        self._good.clear()
        self._estimates.clear()
        self._turns.new_stretch()
        for source in self._sources():
            source.gate.new_stretch()

    def _evaluate(self) -> None:
        """Judge every second that all sources have closed, or that has waited long enough for the missing ones."""
        sources = self._sources()
        restarts = sum(source.batches.restarts for source in sources)
        if restarts > self._restarts:
            # Seconds that were good have lost a share.
            self._break()
        self._restarts = restarts
        known = [slot for source in sources if (slot := source.batches.closed_through) is not None]
        if not known:
            return
        ready = min(known) if len(known) == len(sources) else -math.inf
        if math.isfinite(self._now_s):
            ready = max(ready, math.floor(self._now_s - _GRACE_S) - 1)
        if not math.isfinite(ready):
            return
        last = int(ready)
        if self._next is None or max(known) < self._next - self._keep:
            # The beginning, or every clock went back.
            self._break()
            self._next = min(last, *known)
        if last - self._next > self._keep:
            # Nobody closed anything for so long that nothing of it is left.
            self._break()
            self._next = last - 1
        if last < self._next:
            return
        for slot in range(self._next, last + 1):
            self._judge(slot, sources)
        self._next = last + 1
        for notify in tuple(self.on_second):
            notify()

    def _judge(self, slot: int, sources: list[Source]) -> None:
        # Every gate sees every second: one that is skipped learns nothing.
        good, moved = True, False
        for source in sources:  # the IMUs first: they say whether it moved
            good = source.judge(slot, moved=moved) and good
            moved = moved or (source.kind == "imu" and not source.verdict.still and not source.verdict.fault)
        if self._heading is not None:
            others = [source.verdict for source in sources if source is not self._heading]
            self._watch.add_second(self._heading.batches.batches.get(slot), others)
        self._trace.add(slot, sources, good=good)
        self._swell.add(next((each.batches.batches.get(slot) for each in self._imus.values()), None))
        if not self._stretch.add(slot, good=good):
            self._break()
        if not self._watch_turn(slot, good=good):
            self._break()
        if not good and self._stretch.start is None:
            return
        self._good[slot] = good
        while len(self._good) > self._keep:
            del self._good[next(iter(self._good))]
        if not good:
            return
        for source in sources:
            batch = source.batches.batches.get(slot)
            if batch is None:
                continue
            if source.kind == "imu" or slot not in source.unsettled:
                source.gate.accept(batch)

    def _obstacle(self, now_s: float) -> Obstacle | None:
        """A silent source, or the latest second was not still; None when nothing is in the way."""
        sources = self._sources()
        if (silence := next(filter(None, (source.silence(now_s) for source in sources)), None)) is not None:
            return Obstacle(silence)
        others = any(source.verdict.words for source in sources if source is not self._heading)
        if self._turns.words and not others:
            return Obstacle(self._turns.words, moving=True)
        if self._stretch.good_now:
            return None
        said = [source.verdict for source in sources if source.verdict.words]
        moving = not any(verdict.fault for verdict in said)
        if self._afloat is not None and moving:
            return None
        if not said:
            return Obstacle(f"hold still {self._min_good} s", moving, self._min_good)
        words = said[0].words
        if said[0].fault:
            return Obstacle(words, moving)
        boat = f"; on a boat? {self._settings.on_a_boat}" if self._swell.is_regular else ""
        return Obstacle(f"hold still: {words}{boat}", moving)

    def _waiting_for(self, now_s: float) -> Obstacle | None:
        if (moves := self._obstacle(now_s)) is not None:
            return moves
        left_s = 0 if self._stretch.begun else self._min_good - self._stretch.good
        settles = self._settles(self._slots(None), left_s)
        if settles is not None:
            return Obstacle(settles)
        return Obstacle(f"hold still {left_s} s more", hold_still_s=left_s) if left_s else None

    def _settles(self, slots: list[int], left_s: int) -> str | None:
        """What the mean of a pose sensor over these seconds and the next `left_s` has to wait for; None for nothing."""
        sources = filter(None, (self._tilt, self._heading))
        return next(filter(None, (source.lacks(slots, self._least, left_s) for source in sources)), None)

    def _slots(self, since_s: float | None) -> list[int]:
        start = self._stretch.start
        if start is None or self._next is None:
            return []
        start = max(start, self._next - self._max_slots)
        if since_s is not None:
            start = max(start, math.ceil(since_s))
        return [slot for slot in range(start, self._next) if self._good.get(slot, False)]

    def _are_enough(self, slots: list[int], since_s: float | None) -> bool:
        if since_s is not None:
            return len(slots) >= self._least
        # A stretch that has begun may have had up to a fifth rejected since.
        return len(slots) >= self._min_good or (self._stretch.begun and bool(slots))

    def _work(self, slots: list[int], since_s: float | None) -> Work:
        return Work(
            imus=[self._inputs[name] for name in self._imus],
            batches=[[source.batches.batches[slot] for slot in slots] for source in self._imus.values()],
            slots=slots,
            horizon_s=self._settings.horizon_s,
            since_s=since_s,
            generation=self._estimates.generation,
        )

    def _estimate_later(self, slots: list[int], since_s: float | None, late: int = 0) -> Callable[[], Found]:
        """Worked out when it is asked for, of what is known now; once a second, however often that is."""
        found = self._estimates.known(slots[-1] - late, since_s)
        if found is not None:
            return lambda: found
        work = self._work(slots, since_s)

        def estimate() -> Found:
            found = work.run()
            self._estimates.keep(work, found)
            return found

        return estimate
