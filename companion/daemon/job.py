"""Running job: a calibration, an alignment, the writing of temperature curves, or an undo."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final, Literal

from companion.component.service import JobResult
from companion.errors import CalibrationRefusedError
from companion.estimation.machine import What
from companion.estimation.records.align_record import HandRecord
from companion.estimation.records.record import Record
from companion.formats import Object
from companion.links.system.events import comes
from companion.storage.changes import BY_TEMPERATURE

ALIGNMENT: Final = "gradienter alignment"
FACES: Final = "faces alignment"
TURN: Final = "turn on the spot"
COMPASS: Final = "compass alignment"
TEMPERATURE: Final = "temperature curve"
FIRMWARE: Final = "autopilot gyro calibration"
NO_CALIBRATION: Final = (ALIGNMENT, FACES, TURN, COMPASS, TEMPERATURE, FIRMWARE)

Act = Literal["", "PUT IT DOWN", "TURN IT", "HOLD STILL"]
"""Present task of an alignment's operator, shown by the headline; empty: wait."""
GoOn = Callable[[str], None]
"""Callback, called during a long wait: it sets the progress text, and raises `JobCancelledError` after a cancel."""


class JobCancelledError(Exception):
    """Raised inside a cancelled job at its next safe point."""


class Job:
    """One job: its request, its progress, and its result in the future `finished`, which is set exactly once."""

    def __init__(
        self,
        kind: str,
        what: What,
        requester: str,
        timeout_s: float | None = None,
        *,
        reboot: bool = False,
        automatic: bool = False,
    ) -> None:
        loop = asyncio.get_running_loop()
        self.kind, self.what, self.requester = kind, what, requester
        self.reboot = reboot  # Restart the autopilot once the result is stored
        self.automatic = automatic  # Started by the daemon itself
        self.was_armed = False
        self.limit(timeout_s)
        self.finished: asyncio.Future[JobResult] = loop.create_future()
        self.product: Record | HandRecord | Object | None = None
        self.undid_calibration = kind == "undo"
        """True if this job has undone a calibration; False for the undo of an alignment or a temperature curve."""
        self.words = ""  # Present activity, as text for people
        self.hold_still_s: int | None = None
        """Seconds for which the aircraft must be held motionless, if the job waits for nothing else; otherwise None."""
        self.act: Act | None = None  # None: no alignment, or not begun
        self.progress_percent = 0  # 0 to 100; it falls only where a measurement begins again
        self._until_s = 0.0
        self.cancelled_by: str | None = None
        self.has_written = False  # True once a write to the autopilot has begun, even if it was rolled back
        self._nudge = asyncio.Event()

    def limit(self, timeout_s: float | None) -> None:
        """Limit the time from now on; None: no limit."""
        self._timeout_s, self._begun_s = timeout_s, asyncio.get_running_loop().time()

    def restart_time(self) -> None:
        self.limit(self._timeout_s)

    @property
    def is_running(self) -> bool:
        return not self.finished.done()

    @property
    def record(self) -> Record | None:
        return self.product if isinstance(self.product, Record) else None

    @property
    def short(self) -> str:
        return {FACES: "faces", TURN: "turn", COMPASS: "compass", TEMPERATURE: BY_TEMPERATURE}.get(self.kind, self.kind)

    @property
    def left_s(self) -> float:
        return max(0.0, self._until_s - asyncio.get_running_loop().time())

    def lasts(self, seconds: float) -> None:
        self._until_s = asyncio.get_running_loop().time() + seconds

    def progress(self, percent: float, words: str, hold_still_s: int | None = None) -> None:
        self.progress_percent = max(self.progress_percent, min(99, int(percent)))
        self.words, self.hold_still_s = words, hold_still_s

    def going_on(self, percent: float, otherwise: str = "") -> GoOn:
        def go_on(words: str) -> None:
            self.check_cancelled()
            self.progress(percent, words or otherwise)

        return go_on

    def cancel(self, by: str) -> None:
        self.cancelled_by = self.cancelled_by or by
        self._nudge.set()

    def check_cancelled(self) -> None:
        """Raise JobCancelledError, which names the canceller, if cancelled; call this where stopping is safe."""
        if self.cancelled_by is not None:
            left = "" if self.has_written else "; nothing written"
            raise JobCancelledError(f"cancelled by {self.cancelled_by}{left}")

    def check_time(self) -> None:
        """Raise CalibrationRefusedError if the deadline has passed."""
        if self._timeout_s is not None and asyncio.get_running_loop().time() >= self._begun_s + self._timeout_s:
            boat = '; on a boat? set vehicle.platform = "deck"' if self.words.startswith("hold still: ") else ""
            raise CalibrationRefusedError(f"not finished in the time given: {self.words}{boat}")

    async def pause(self, seconds: float) -> None:
        """Wait for `seconds` or until `wake_up` is called; raise JobCancelledError once the job is cancelled."""
        self.check_cancelled()
        self._nudge.clear()
        if await comes(self._nudge, seconds):
            self.check_cancelled()

    def wake_up(self) -> None:
        self._nudge.set()

    def finish(self, result: JobResult) -> None:
        self.progress_percent = 100
        if not self.finished.done():
            self.finished.set_result(result)
