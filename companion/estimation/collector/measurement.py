"""A window whose seconds are chosen and whose figures are not worked out yet: choosing costs a small part of it.

Estimates are kept while they are of use, and packed up so that they can be worked out elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from companion.errors import CalibrationRefusedError
from companion.estimation.means.pose import FieldWindow, heading_window, tilt_window
from companion.estimation.means.windows import ImuEstimate, ImuInput, Window, imu_estimates
from companion.estimation.seconds.batch import Batch
from companion.estimation.turning.watch import Turn

Found = list[ImuEstimate] | CalibrationRefusedError


class Work(msgspec.Struct, frozen=True, kw_only=True):
    """An estimate that is due; `run` touches nothing that changes, and may be called in another thread."""

    imus: list[ImuInput]
    batches: list[list[Batch]]
    slots: list[int]
    """The good seconds, the same of every IMU."""
    horizon_s: float
    since_s: float | None
    """The window's own beginning, where it is not the whole stretch."""
    generation: int

    def run(self) -> Found:
        """Work it out."""
        first, last = self.slots[0], self.slots[-1]
        rejected = last - first + 1 - len(self.slots)
        try:
            return imu_estimates(self.imus, self.batches, end_s=last + 1.0, horizon_s=self.horizon_s, rejected=rejected)
        except CalibrationRefusedError as error:
            return error


class Estimates:
    """The newest estimate of the whole stretch, and of one other window beside it."""

    def __init__(self) -> None:
        self._kept: dict[float | None, tuple[int, Found]] = {}
        self.generation = 0
        """Of the stretch that is under way."""

    def clear(self) -> None:
        """The stretch is over: what was worked out over it, or still is, is of no use."""
        self._kept.clear()
        self.generation += 1

    def known(self, last: int, since_s: float | None) -> Found | None:
        """The estimate of a window that ends with that second or a later one; None where there is none yet."""
        kept = self._kept.get(since_s)
        return kept[1] if kept is not None and kept[0] >= last else None

    def keep(self, work: Work, found: Found) -> None:
        """Remember what it has found, unless it comes too late."""
        if work.generation != self.generation:
            return
        self._kept = {key: one for key, one in self._kept.items() if key is None or key == work.since_s}
        self._kept[work.since_s] = (work.slots[-1], found)


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that a window is made of; holds nothing that changes later."""

    slots: list[int]
    """Its good seconds, ascending, at least one."""
    estimate: Callable[[], Found]
    settling: str | None = None
    """What a pose sensor's mean has to wait for."""
    tilt: list[Batch] | None = None
    """The seconds of the gradienter that count; None: there is none. Likewise the next."""
    heading: list[Batch] | None = None
    from_field: bool = False
    wander_deg: float | None = None
    """Of the heading, both as in its window."""
    field: FieldWindow | None = None
    begun_s: dict[str, float] = {}
    """By IMU, since when it has been switched on, as far as that is known."""
    turn: Turn = Turn()

    def window(self) -> Window:
        """Work it out; takes milliseconds.

        Raises:
            CalibrationRefusedError: a source fails its checks.
        """
        estimates = self.estimate()
        if isinstance(estimates, CalibrationRefusedError):
            raise estimates
        if self.settling is not None:
            raise CalibrationRefusedError(self.settling)
        for name, batches in (("gradienter", self.tilt), ("compass", self.heading)):
            if batches == []:
                raise CalibrationRefusedError(f"no reading from {name} in {len(self.slots)} s")
        return Window(
            start_s=float(self.slots[0]),
            end_s=self.slots[-1] + 1.0,
            imus=tuple(item.window for item in estimates),
            tilt=None if self.tilt is None else tilt_window(self.tilt),
            heading=None
            if self.heading is None
            else heading_window(self.heading, from_field=self.from_field, wander_deg=self.wander_deg),
            field=self.field,
            powered_s={name: self.slots[-1] + 1.0 - since_s for name, since_s in self.begun_s.items()},
            turn=self.turn,
        )
