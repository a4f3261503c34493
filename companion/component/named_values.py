"""Progress and readiness as numbers that ground stations show: NAMED_VALUE_FLOAT, for Mission Planner's Quick tab.

Mission Planner shows those of any component of the vehicle (`propagateNamedFloats`), QGroundControl those in its
MAVLink inspector. With every heartbeat while a calibration runs, else with every fifth: some 12 bytes a second.
"""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmGate, CalibrationService
from companion.links.mavlink.link import MavlinkLink

PROGRESS: Final = "CMP_PROG"
"""Percent of the calibration under way; 100 where none is."""
READY: Final = "CMP_READY"
"""1: it may arm; 0: not now."""
_IDLE_BEATS: Final = 5


class NamedValues:
    """Tells them; `beat` with every heartbeat."""

    def __init__(self, link: MavlinkLink, service: CalibrationService, gate: ArmGate) -> None:
        self._link, self._service, self._gate = link, service, gate
        self._beats = 0

    def beat(self, now_s: float) -> None:
        """Send what is due."""
        busy = self._service.mav_state == mavlink.MAV_STATE_CALIBRATING
        self._beats += 1
        if not busy and self._beats % _IDLE_BEATS:
            return
        ready = self._gate.answer().verdict == "accept"
        boot_ms = int(now_s * 1e3) % 2**32
        for name, value in ((PROGRESS, float(self._service.progress_percent)), (READY, float(ready))):
            self._link.send(mavlink.MAVLink_named_value_float_message(boot_ms, name.encode("ascii"), value))
