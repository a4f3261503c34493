"""Estimates of windows, kept while they are of use, and packed up so that they can be worked out elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from companion.calibration.means.windows import ImuEstimate, ImuInput, imu_estimates
from companion.calibration.seconds.batch import Batch
from companion.errors import CalibrationRefusedError

Found = list[ImuEstimate] | CalibrationRefusedError


class Work(msgspec.Struct, frozen=True):
    """An estimate that is due; `run` touches nothing that changes, and may be called in another thread."""

    run: Callable[[], Found]
    since_s: float | None
    """The window's own beginning, where it is not the whole stretch."""
    last: int
    """Its last second."""
    generation: int


class Estimates:
    """The newest estimate of the whole stretch, and of one other window beside it."""

    def __init__(self) -> None:
        self._kept: dict[float | None, tuple[int, Found]] = {}
        self._generation = 0

    def clear(self) -> None:
        """The stretch is over: what was worked out over it, or still is, is of no use."""
        self._kept.clear()
        self._generation += 1

    def known(self, last: int, since_s: float | None) -> Found | None:
        """The estimate of a window that ends with that second or a later one; None where there is none yet."""
        kept = self._kept.get(since_s)
        return kept[1] if kept is not None and kept[0] >= last else None

    def work(
        self,
        imus: Sequence[ImuInput],
        batches: Sequence[Sequence[Batch]],
        slots: Sequence[int],
        *,
        horizon_s: float,
        since_s: float | None,
    ) -> Work:
        """Pack up the estimate of these good seconds (`slots`), the same of every IMU."""
        last = slots[-1]
        rejected = last - slots[0] + 1 - len(slots)

        def run() -> Found:
            try:
                return imu_estimates(imus, batches, end_s=last + 1.0, horizon_s=horizon_s, rejected=rejected)
            except CalibrationRefusedError as error:
                return error

        return Work(run, since_s, last, self._generation)

    def keep(self, work: Work, found: Found) -> None:
        """Remember what it has found, unless it comes too late."""
        if work.generation != self._generation:
            return
        self._kept = {key: one for key, one in self._kept.items() if key is None or key == work.since_s}
        self._kept[work.since_s] = (work.last, found)
