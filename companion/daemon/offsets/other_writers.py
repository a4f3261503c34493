"""Other writers of the parameters that we write: further companions, and the autopilot's own calibrations ("rivals").

Two companions would save each other's values as "old" ones, so that no order of undos restores the values from before
both. Therefore each companion announces itself, and all but one refuse to write. A heartbeat cannot announce it:
companions usually share their MAVLink ids, and routers do not forward a heartbeat to links where its ids were heard.
Each announces a random instance number in NAMED_VALUE_INT, which ArduPilot and PX4 forward. The rank depends on
announced constants and on no clock, so that all companions agree. A companion that has run alone precedes a new one;
otherwise the lower number precedes the higher.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration, stop
from companion.autopilot.parameters.change import Change
from companion.component.statustext import Say, Severity, Weight
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.links.mavlink.link import MavlinkLink
from companion.messages import message

logger = logging.getLogger(__name__)

NAME: Final = "CMP_INST"
BEAT_S: Final = 1.0
SETTLE_S: Final = 6.0
"""Time after our start within which the announcement of an already running companion must arrive."""
CONFIRM_S: Final = 0.5
"""Minimum time between a companion's first and latest announcement: after its end, queued ones arrive together."""
EXPIRE_S: Final = 12.0
"""Silence after which another companion counts as gone: it announces itself every second, but messages may be lost."""
MOST: Final = 8
"""Maximum number of other companions stored: forged messages can have any number of different instance numbers."""
INSTANCE_BITS: Final = 30


class _Other(msgspec.Struct):
    system_id: int
    component_id: int
    is_new: bool
    instance: int
    boot_ms: int
    first_s: float
    latest_s: float

    @property
    def rank(self) -> tuple[bool, int]:
        return self.is_new, self.instance

    def words(self, does: str) -> str:
        return message("second_companion", system=self.system_id, component=self.component_id, does=does)

    def counts(self, now_s: float) -> bool:
        return self.latest_s - self.first_s >= CONFIRM_S and now_s - self.latest_s < EXPIRE_S


class OtherCompanions:
    """Detection of other companions: announces this one once a second and receives their announcements."""

    def __init__(self, link: MavlinkLink, say: Say, writes: Callable[[], bool]) -> None:
        self._link, self._say, self._writes = link, say, writes
        self._instance, self._is_new = int.from_bytes(os.urandom(4)) >> 32 - INSTANCE_BITS, True
        self._others: dict[int, _Other] = {}
        self._told: str | None = None
        link.subscribe(mavlink.MAVLink_named_value_int_message, self._on_value)

    def why_not(self) -> str | None:
        other = self._other()
        return None if other is None or other.rank > (self._is_new, self._instance) else other.words("writes")

    @property
    def warning(self) -> str | None:
        other = self._other()
        return None if other is None else self.why_not() or other.words("waits")

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        while True:
            await asyncio.sleep(BEAT_S)  # nothing may be sent before the component's first heartbeat
            now_s = loop.time()
            if self._is_new and now_s - started_s >= SETTLE_S and self.why_not() is None:
                self._is_new = False
            if self._writes() and self._link.connected:
                value = self._instance << 1 | self._is_new
                name = NAME.encode("ascii")
                self._link.send(mavlink.MAVLink_named_value_int_message(int(now_s * 1e3) % 2**32, name, value))
            words = self.warning
            if words is not None and words != self._told:
                logger.warning("%s", words)
                self._say(Severity.WARNING, words[:1].upper() + words[1:], Weight.NEWS)
            self._told = words

    def _other(self) -> _Other | None:
        """Return the highest-ranking other companion; None if there is none, or if this companion never writes."""
        if not self._writes():
            return None
        now_s = asyncio.get_running_loop().time()
        present = (other for other in self._others.values() if other.counts(now_s))
        return min(present, key=lambda other: other.rank, default=None)

    def _on_value(self, message: mavlink.MAVLink_named_value_int_message, t_s: float) -> None:
        if message.name != NAME or message.get_srcSystem() != self._link.system_id:
            return
        instance, is_new, boot_ms = message.value >> 1, bool(message.value & 1), message.time_boot_ms
        if instance == self._instance:
            return  # our own announcement, sent back
        known = self._others.get(instance)
        if known is None or t_s - known.latest_s >= EXPIRE_S:
            self._others = {number: each for number, each in self._others.items() if t_s - each.latest_s < EXPIRE_S}
            if len(self._others) < MOST:
                ids = message.get_srcSystem(), message.get_srcComponent()
                self._others[instance] = _Other(*ids, is_new, instance, boot_ms, t_s, t_s)
        elif boot_ms != known.boot_ms:  # ignore copies: routers in a loop repeat messages for ever
            known.is_new, known.boot_ms, known.latest_s = is_new, boot_ms, t_s


class FirmwareCalibrationWarnings:
    """Warns about autopilot calibrations that overwrite our offsets; the setting `push.stop_rivals` disables these."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._imus, self._say = imus, core.say
        self.stop_rivals = core.config.push.stop_rivals  # True: the next write disables these calibrations
        self._told: set[str] = set()
        """Names of active autopilot calibrations ("rivals") that the ground stations were already warned about."""
        for name, imu in imus.items():
            imu.on_read.add(functools.partial(self._on_read, name))

    @property
    def warnings(self) -> list[str]:
        known = [imu.calibration for imu in self._imus.values() if imu.calibration is not None]
        return list(dict.fromkeys(rival.words for calibration in known for rival in calibration.rivals))

    def changes(self, calibrations: Sequence[ImuCalibration]) -> list[Change]:
        if not self.stop_rivals:
            return []
        rivals = {rival.parameter: rival for calibration in calibrations for rival in calibration.rivals}
        return stop(tuple(rivals.values()))

    def left_of(self, calibration: ImuCalibration) -> list[str]:
        """Return an IMU's warnings, except warnings about autopilot calibrations that the next write will disable."""
        stopped = {r.words for r in calibration.rivals if not r.until_boot} if self.stop_rivals else set()
        return [warning for warning in calibration.warnings if warning not in stopped]

    def _on_read(self, name: str, before: ImuCalibration | None, after: ImuCalibration) -> None:
        self._told &= {rival.name for rival in after.rivals}
        for rival in after.rivals:
            if rival.name not in self._told and (rival.until_boot or not self.stop_rivals):
                self._told.add(rival.name)
                what = "all" if rival.accelerometers else "gyro"
                words = message("rival_may_rewrite", what=what, parameter=rival.parameter)
                if rival.until_boot:
                    words = message("rival_runs_until_reboot")
                self._say(Severity.WARNING, words, Weight.NEWS)
        if before is not None and before.parameters == after.parameters:
            self._compare(name, before, after)

    def _compare(self, name: str, before: ImuCalibration, after: ImuCalibration) -> None:
        gyros = before.gyro_offset_rad_s != after.gyro_offset_rad_s
        accelerometers = before.accel_offset_m_s2 != after.accel_offset_m_s2
        if not (gyros or accelerometers):
            return
        what = "all" if gyros and accelerometers else "gyro" if gyros else "accelerometer"
        able = [rival.name for rival in after.rivals if rival.accelerometers or not accelerometers]
        suspect = f", perhaps {able[0]}" if able else ""
        words = message("offsets_rewritten", what=what, imu=name, suspect=suspect)
        logger.warning("%s", words)
        self._say(Severity.WARNING, words, Weight.NEWS)
