"""A window whose seconds are chosen and whose figures are not worked out yet: choosing costs a small part of it."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from companion.calibration.means.estimates import Found
from companion.calibration.means.pose_windows import FieldWindow, HeadingWindow, TiltWindow, heading_window, tilt_window
from companion.calibration.means.windows import Window
from companion.calibration.seconds.batch import Batch
from companion.errors import CalibrationRefusedError


class PoseSeconds(msgspec.Struct, frozen=True):
    """The seconds of a pose sensor that count for a window."""

    label: str
    batches: list[Batch]
    among: int
    """Seconds of the window."""
    from_field: bool = False
    wander_deg: float | None = None

    def some(self) -> list[Batch]:
        """Its batches.

        Raises:
            CalibrationRefusedError: there is none.
        """
        if not self.batches:
            raise CalibrationRefusedError(f"no reading from {self.label} in {self.among} s")
        return self.batches


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that a window is made of; holds nothing that changes later."""

    slots: list[int]
    """Its good seconds, ascending, at least one."""
    estimate: Callable[[], Found]
    settling: str | None
    """What a pose sensor's mean has to wait for."""
    tilt: PoseSeconds | None
    heading: PoseSeconds | None
    field: FieldWindow | None

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
        return Window(
            start_s=float(self.slots[0]),
            end_s=self.slots[-1] + 1.0,
            imus=tuple(item.window for item in estimates),
            tilt=self._tilt(),
            heading=self._heading(),
            field=self.field,
        )

    def with_wander(self, wander_deg: float | None) -> Measurement:
        """The same where the heading was watched for longer than its readings are known."""
        if self.heading is None:
            return self
        return msgspec.structs.replace(self, heading=msgspec.structs.replace(self.heading, wander_deg=wander_deg))

    def _tilt(self) -> TiltWindow | None:
        return None if self.tilt is None else tilt_window(self.tilt.some())

    def _heading(self) -> HeadingWindow | None:
        seconds = self.heading
        if seconds is None:
            return None
        return heading_window(seconds.some(), from_field=seconds.from_field, wander_deg=seconds.wander_deg)
