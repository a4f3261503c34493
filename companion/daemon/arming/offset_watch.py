"""Detects changes of the autopilot's offsets by others: people, or a boot that measures the gyros (INS_GYR_CAL = 1)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.service import JobResult
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import NO_CALIBRATION, Job
from companion.estimation.records.validity import Why

logger = logging.getLogger(__name__)


_Known = tuple[tuple[float, ...], int]
"""Offsets, and number of boots. Without names: PX4 may move an IMU to other parameters."""


class OffsetWatch:
    """Compares offsets; `poll` often. `lost` is called with an IMU whose offsets are not ours any more, and why."""

    def __init__(self, vehicle: Vehicle, imus: Mapping[str, AutopilotImu], lost: Callable[[str, Why], object]) -> None:
        self._vehicle, self._imus, self._lost = vehicle, imus, lost
        self._known: dict[str, _Known] = {}
        self._before: dict[str, _Known] = {}
        """Offsets before a job, until those after it are read."""
        self._failed = self._asked_restart = False
        self._written: dict[str, dict[str, float]] = {}
        """Values just written, by IMU, until they are read."""
        self.foreign: str | None = None
        """Change by somebody else since the last request, in short."""

    def known(self) -> dict[str, _Known]:
        """Return the present offsets for a later comparison."""
        return dict(self._known)

    def let_go(self) -> None:
        """Expect changes of our own until the next `poll`."""
        self._before, self._known = dict(self._known) or self._before, {}

    def on_ended(self, job: Job, result: JobResult) -> None:
        """Handle the end of a calibration, an alignment or an undo."""
        self.let_go()
        self._written, self._failed = {}, result.outcome != "done"
        if job.kind == "undo":
            return
        if not job.automatic and job.kind not in NO_CALIBRATION:
            self.foreign = None
        if not self._failed and job.record is not None:
            self._asked_restart = job.reboot
            for imu in job.record.imus:
                self._written[imu.name] = {name: one.after for name, one in imu.written.items()}

    def poll(self) -> None:
        """Compare the autopilot's offsets with those before."""
        for name, imu in self._imus.items():
            calibration = imu.calibration
            if calibration is None:
                continue
            now = tuple(calibration.offsets.values()), self._vehicle.boots
            known, self._known[name] = self._known.get(name), now
            if known is None:
                self._check_after_job(name, self._before.pop(name, now), now, calibration)
            elif known[1] != now[1]:
                self._lost(name, Why.REPLACED if known[0] != now[0] else Why.REBOOTED)
            elif known != now:
                self._changed_by_others(name)

    def _check_after_job(self, name: str, before: _Known, now: _Known, calibration: ImuCalibration) -> None:
        """Compare with the end of a job: the EKF may have settled for minutes since."""
        written, rebooted = self._written.pop(name, {}), before[1] != now[1]
        restarted = rebooted and not self._asked_restart
        changed = (self._failed and before[0] != now[0]) or (written and calibration.contradicts(written))
        if changed and rebooted and (self._failed or restarted):
            # Our own changes have been restored by now.
            self._lost(name, Why.FAILED if self._failed else Why.REPLACED)
        elif changed:
            self._changed_by_others(name)
        elif restarted:
            self._lost(name, Why.REBOOTED)

    def _changed_by_others(self, name: str) -> None:
        self.foreign = f"{name} was changed"
        logger.warning("imu %s: somebody else changed its offsets; they are left alone", name)
        self._lost(name, Why.CHANGED)
