"""Tells people what in the autopilot overwrites our biases: that it will, that it did, that it was switched off."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
from collections.abc import Mapping, Sequence
from typing import Final

from companion.autopilot.firmware.imu_calibration import ImuCalibration, Rival, stop
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu

logger = logging.getLogger(__name__)

JUST_NOW_S: Final = 20.0
"""How long after a landing or a start a rewritten offset is taken for the work of who acts then."""


class Rivalry:
    """Watches over the autopilot's IMUs."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._imus, self._say = imus, core.say
        self.stop_rivals = core.config.push.stop_rivals
        """Whether they are to be switched off with the next write."""
        self._told: set[str] = set()
        """Those that the ground stations have heard of since they were switched on; status shows them always."""
        self._disarmed_s = self._rebooted_s = -math.inf
        self._was_armed = False
        core.vehicle.on_event.add(self._on_event)
        for name, imu in imus.items():
            imu.on_read.add(functools.partial(self._on_read, name))

    @property
    def warnings(self) -> list[str]:
        """Of those that are switched on, as far as it is known at the moment."""
        known = [imu.calibration for imu in self._imus.values() if imu.calibration is not None]
        return list(dict.fromkeys(rival.words for calibration in known for rival in calibration.rivals))

    def changes(self, calibrations: Sequence[ImuCalibration]) -> list[Change]:
        """What to write, before the biases, so that they stay; nothing unless that is configured."""
        if not self.stop_rivals:
            return []
        rivals = {rival.parameter: rival for calibration in calibrations for rival in calibration.rivals}
        return stop(tuple(rivals.values()))

    def left_of(self, calibration: ImuCalibration) -> list[str]:
        """The warnings about a calibration, without those of rivals that are about to be switched off."""
        stopped = {r.words for r in calibration.rivals if not r.until_boot} if self.stop_rivals else set()
        return [warning for warning in calibration.warnings if warning not in stopped]

    def switch(self, *, stop_rivals: bool) -> None:
        """Change whether rivals are switched off with the next write."""
        self.stop_rivals = stop_rivals

    def _on_event(self, event: VehicleEvent) -> None:
        now_s = asyncio.get_running_loop().time()
        if event == "armed":
            self._was_armed = True
        elif event == "disarmed":
            self._disarmed_s = now_s if self._was_armed else self._disarmed_s
            self._was_armed = False
        elif event == "rebooted":
            self._rebooted_s, self._was_armed = now_s, False

    def _on_read(self, name: str, before: ImuCalibration | None, after: ImuCalibration) -> None:
        self._told &= {rival.name for rival in after.rivals}
        for rival in after.rivals:
            if rival.name not in self._told and (rival.until_boot or not self.stop_rivals):
                self._told.add(rival.name)
                what = "all" if rival.accelerometers else "gyro"
                words = f"The autopilot may rewrite {what} offsets: set {rival.parameter} to 0"
                if rival.until_boot:
                    words = "Reboot PX4: its gyro calibration still runs"
                self._say(Severity.WARNING, words, Weight.NEWS)
        if before is not None and before.parameters == after.parameters:
            self._compare(name, before, after)

    def _compare(self, name: str, before: ImuCalibration, after: ImuCalibration) -> None:
        gyros = before.gyro_offset_rad_s != after.gyro_offset_rad_s
        accelerometers = before.accel_offset_m_s2 != after.accel_offset_m_s2
        if not (gyros or accelerometers):
            return
        what = "all" if gyros and accelerometers else "gyro" if gyros else "accelerometer"
        rival = self._culprit(after.rivals, accelerometers=accelerometers)
        if rival is not None:
            logger.warning("imu %s: %s offsets rewritten by the autopilot itself (%s)", name, what, rival.words)
            words = f"The autopilot rewrote {what} offsets of {name}: {rival.name}"
        else:
            logger.warning("imu %s: %s offsets rewritten by somebody else", name, what)
            words = f"Somebody rewrote {what} offsets of {name}"
        self._say(Severity.WARNING, words, Weight.NEWS)

    def _culprit(self, rivals: Sequence[Rival], *, accelerometers: bool) -> Rival | None:
        """Which of the rivals it was, by the time at which each acts."""
        now_s = asyncio.get_running_loop().time()
        acting = {
            "at a start": now_s - self._rebooted_s < JUST_NOW_S,
            "after a flight": now_s - self._disarmed_s < JUST_NOW_S,
            "while still": not accelerometers,
        }
        able = [rival for rival in rivals if acting[rival.acts] and (rival.accelerometers or not accelerometers)]
        return min(able, key=lambda rival: rival.acts == "while still", default=None)
