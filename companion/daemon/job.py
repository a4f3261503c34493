"""One request under way, as its requesters see it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

import msgspec

from companion.component.service import JobResult
from companion.errors import CalibrationRefusedError
from companion.estimation.records.align_record import AlignmentRecord, FacesRecord, TurnRecord
from companion.estimation.records.record import Record, WrittenParameter
from companion.estimation.request import What
from companion.links.system.waiting import comes
from companion.storage.changes import BY_TEMPERATURE, ChangeSet

ALIGNMENT: Final = "gradienter alignment"
FACES: Final = "measurement on all sides"
TURN: Final = "turn on the spot"
TEMPERATURE: Final = "temperature curve"
NO_CALIBRATION: Final = (ALIGNMENT, FACES, TURN, TEMPERATURE)

GoOn = Callable[[str], None]


class Undone(msgspec.Struct, frozen=True):
    """One step back."""

    step: ChangeSet
    written: dict[str, WrittenParameter]
    """What was put back; less than the step where others have changed something."""
    by_hand: bool
    """Whether it was of what stands or curves had told, so that the last calibration is as it was."""


class CurvesWritten(msgspec.Struct, frozen=True):
    """Curves over temperature that are in the autopilot now."""

    imus: dict[str, dict[str, WrittenParameter]]
    """By IMU and parameter."""
    warnings: tuple[str, ...]


Product = Record | AlignmentRecord | FacesRecord | TurnRecord | Undone | CurvesWritten


class JobCancelledError(Exception):
    """Raised inside a job at the next safe point after somebody cancelled it."""


class Job:
    """A calibration or an undo; `finished` is done exactly once."""

    def __init__(
        self,
        kind: str,
        what: What,
        requester: str,
        deadline_s: float | None,
        *,
        reboot: bool = False,
        automatic: bool = False,
    ) -> None:
        self.kind, self.what, self.requester = kind, what, requester
        self.reboot = reboot
        """Whether the autopilot is to be restarted once the result is stored."""
        self.automatic = automatic
        """Whether nobody asked for it."""
        self.was_armed = False
        """Whether the aircraft was armed since, be it for a moment."""
        self.deadline_s = deadline_s
        """Loop time until which measuring may take; None: no limit."""
        self.finished: asyncio.Future[JobResult] = asyncio.get_running_loop().create_future()
        self.product: Product | None = None
        """The record of a calibration or an alignment, or what an undo has put back."""
        self.words = ""
        """What is going on now, for people."""
        self.hold_still_s: int | None = None
        """How long the aircraft has to stand still before anything else goes on."""
        self._percent = 0
        self._until_s = 0.0
        self._cancelled_by: str | None = None
        self._nudge = asyncio.Event()

    @property
    def undone(self) -> Undone | None:
        """What came of an undo."""
        return self.product if isinstance(self.product, Undone) else None

    @property
    def undid_calibration(self) -> bool:
        """Whether what a calibration has written was taken back; also one that nobody had asked for."""
        return self.kind == "undo" and (self.undone is None or not self.undone.by_hand)

    @property
    def short(self) -> str:
        """What it is, as the command line calls it."""
        return {FACES: "faces", TURN: "turn", TEMPERATURE: BY_TEMPERATURE}.get(self.kind, self.kind)

    @property
    def record(self) -> Record | None:
        """What came of a calibration."""
        return self.product if isinstance(self.product, Record) else None

    def deliver(self, product: Product) -> None:
        """This is what came of it."""
        self.product = product

    @property
    def is_running(self) -> bool:
        """Whether its end is still to come."""
        return not self.finished.done()

    @property
    def progress_percent(self) -> int:
        """0 to 100, never falling."""
        return self._percent

    def progress(self, percent: float, words: str, hold_still_s: int | None = None) -> None:
        """Say how far it is and what is going on; and how long to hold still, where that is all."""
        self._percent = max(self._percent, min(99, int(percent)))
        self.words, self.hold_still_s = words, hold_still_s

    def lasts(self, seconds: float) -> None:
        """Say how long what is going on now will take."""
        self._until_s = asyncio.get_running_loop().time() + seconds

    @property
    def left_s(self) -> float:
        """How long it will take yet, about."""
        return max(0.0, self._until_s - asyncio.get_running_loop().time())

    @property
    def cancelled(self) -> bool:
        """Whether somebody has asked it to stop."""
        return self._cancelled_by is not None

    def cancel(self, by: str) -> None:
        """Ask it to stop at the next safe point."""
        self._cancelled_by = self._cancelled_by or by
        self._nudge.set()

    def look_again(self) -> None:
        """What it pauses for may have come: a `pause` under way ends."""
        self._nudge.set()

    def check_cancelled(self) -> None:
        """The safe point.

        Raises:
            JobCancelledError: somebody cancelled it; says who.
        """
        if self._cancelled_by is not None:
            raise JobCancelledError(f"cancelled by {self._cancelled_by}")

    def going_on(self, percent: float, otherwise: str = "") -> GoOn:
        """What to call now and then with words, or none, for what goes on; raises JobCancelledError."""

        def go_on(words: str) -> None:
            self.check_cancelled()
            self.progress(percent, words or otherwise)

        return go_on

    def check_time(self) -> None:
        """The end of its patience.

        Raises:
            CalibrationRefusedError: it has taken as long as it may.
        """
        if self.deadline_s is not None and asyncio.get_running_loop().time() >= self.deadline_s:
            raise CalibrationRefusedError(f"not finished in the time given: {self.words}")

    async def pause(self, seconds: float) -> None:
        """Wait, but not past a cancel or a `look_again`.

        Raises:
            JobCancelledError: somebody cancelled it.
        """
        self.check_cancelled()
        self._nudge.clear()
        if await comes(self._nudge, seconds):
            self.check_cancelled()

    def finish(self, result: JobResult) -> None:
        """Tell everybody who waits."""
        self._percent = 100
        if not self.finished.done():
            self.finished.set_result(result)
