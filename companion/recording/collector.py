"""A rolling collector that says what is done with it, in the order in which it is."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any, Final

from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.means.windows import ImuInput, Window
from companion.links.system.listeners import Listeners
from companion.recording.journal import Journal, Means
from companion.samples import CompassSample, ImuSample, TiltSample

WINDOWS_KEPT: Final = 240
"""Between a measurement and its solution a dither may lie, while others look at the readings once a second."""


class RecordedCollector(RollingCollector):
    """`RollingCollector`, every call of which goes into a journal first; made as that is."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        self.journal = Journal()
        self.windows: deque[tuple[int, Window]] = deque(maxlen=WINDOWS_KEPT)
        """The latest windows of whole stretches, with their numbers."""
        self.seconds: Listeners[[]] = Listeners()
        """Told when every source has had its say on a second, from within whatever call brought that about: look
        later, not there."""
        self._messages: dict[str, str | None] = {}
        """By IMU, the autopilot's message that its samples come in."""
        self._windows_made = 0
        super().__init__(*arguments, **named)

    def number_of(self, window: Window) -> int | None:
        """The number of a window that was made lately."""
        return next((number for number, each in self.windows if each is window), None)

    def add_imu(self, name: str, sample: ImuSample) -> None:  # noqa: D102 - as in the base class
        if self.journal.is_on:
            self.journal.imu(name, sample, self._messages.get(name))
        super().add_imu(name, sample)

    def add_tilt(self, sample: TiltSample) -> None:  # noqa: D102
        self.journal.tilt(sample)
        super().add_tilt(sample)

    def _take_heading(self, sample: CompassSample) -> None:
        self.journal.compass(sample)
        super()._take_heading(sample)

    def _evaluate(self) -> None:
        before = self._next
        super()._evaluate()
        if self._next != before:
            self.seconds.tell()

    def set_imu(self, imu: ImuInput, message: str | None = None) -> None:
        """As in the base class; `message` is the autopilot's that its samples come in, None for one of our own."""
        self._messages[imu.name] = message
        self.journal.set_in_force(self._loop_s(), "imu", imu)
        super().set_imu(imu)

    def expect(self, *, gradienter: bool, compass: bool) -> None:  # noqa: D102
        self.journal.set_in_force(self._loop_s(), "expect", (gradienter, compass))
        super().expect(gradienter=gradienter, compass=compass)

    def reset(self, why: str, imu: str | None = None) -> None:  # noqa: D102
        self.journal.event(self._loop_s(), "reset", (why, imu))
        super().reset(why, imu)

    def _loop_s(self) -> float:
        """Before the journal begins, when nothing of this is written with its time, there may be no loop yet."""
        return asyncio.get_running_loop().time() if self.journal.is_on else 0.0

    def tick(self, now_s: float) -> None:  # noqa: D102
        self.journal.event(now_s, "tick")
        super().tick(now_s)

    def window(self, now_s: float, *, since_s: float | None = None) -> Window:  # noqa: D102
        if since_s is not None:
            # A look at what a write has done: nothing is estimated from it.
            return super().window(now_s, since_s=since_s)
        self._windows_made += 1
        number = self._windows_made
        self.journal.event(now_s, "window", Means(number, self.wander_deg))
        window = super().window(now_s)
        self.windows.append((number, window))
        return window
