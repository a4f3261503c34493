"""Restarts of the autopilot after a write: on request, or required because PX4's EKF2 still uses an old tilt.

A required restart is saved on disk. Either of two signs shows that PX4 restarted while the companion was off. PX4's
time since boot is shorter than at the write, or PX4 booted after the write by the clock of a board that kept running.
Without either sign the restart stays required: one restart too many costs a minute.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.commands import result_name
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.daemon.job import GoOn
from companion.errors import AutopilotError, NotDisarmedError, StorageError
from companion.messages import message
from companion.storage.records import this_boot
from companion.storage.state import StateFile

logger = logging.getLogger(__name__)

CLOCK_STEP_S: Final = 0.5
"""Tolerance for the autopilot's time since boot: late packets make it seem to step back by up to this much."""
OWED_POLL_S: Final = 1.0
POLL_S: Final = 0.2
STORED_AFTER_S: Final = 3.0
"""Wait for the autopilot to save parameters: PX4 needs up to 2 s (docs/reference/autopilots.md section 8)."""
ANSWER_S: Final = 3.0
BACK_WITHIN_S: Final = 60.0


class NotRebootedError(AutopilotError):
    """Error: the autopilot was not restarted; the written values are active nevertheless."""


def harm_of_reboot(calibrations: Sequence[ImuCalibration], changes: Sequence[Change]) -> str | None:
    """Return the reason why the autopilot would replace the new offsets at a restart; None if it would keep them."""
    after = {change.parameter: change.after for change in changes}
    gyros = {name for calibration in calibrations for name in calibration.parameters.gyro_offset}
    for rival in (rival for calibration in calibrations for rival in calibration.rivals):
        if rival.at_start and after.get(rival.parameter) != 0.0 and gyros & set(after):
            reason = f"{rival.parameter} = {rival.value} would measure the gyros anew; set {rival.parameter} to 0 first"
            return message("reboot_not_completed", reason=f"{reason} (push.stop_rivals = true does)")
    return None


async def reboot(vehicle: Vehicle, go_on: GoOn) -> None:
    """Restart the disarmed autopilot once its parameters are stored, and wait until it is back and disarmed.

    Raises NotRebootedError if it was not restarted, another AutopilotError if it did not come back.
    """
    loop = asyncio.get_running_loop()
    stored_s = loop.time() + STORED_AFTER_S
    while loop.time() < stored_s:
        go_on("waiting until the autopilot has stored the new offsets")
        await asyncio.sleep(POLL_S)
    boots = vehicle.boots
    try:
        await vehicle.disarmed.ensure()
    except NotDisarmedError as error:
        raise NotRebootedError(message("reboot_not_completed", reason=error)) from error
    logger.info("rebooting %s", vehicle.name)
    command = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    result = await vehicle.commands.send(command, 1.0, timeout_s=ANSWER_S)
    if result not in (mavlink.MAV_RESULT_ACCEPTED, None):
        reason = f"{vehicle.name} refused ({result_name(result or 0)})"
        raise NotRebootedError(message("reboot_not_completed", reason=reason))
    # A missing answer proves nothing: the autopilot may have restarted before it answered.
    back_s = loop.time() + BACK_WITHIN_S
    while vehicle.boots == boots or vehicle.arm_state is not ArmState.DISARMED:
        if loop.time() > back_s:
            if vehicle.boots == boots and vehicle.alive:
                raise NotRebootedError(message("reboot_not_completed", reason=f"{vehicle.name} did not answer"))
            reason = f"{vehicle.name} not back, disarmed, within {BACK_WITHIN_S:.0f} s"
            raise AutopilotError(message("reboot_not_completed", reason=reason))
        await asyncio.sleep(POLL_S)


class _Owed(msgspec.Struct, frozen=True):
    """Required restart of PX4: tilt error of its EKF2 and time of the write; `host`: our board's boot id, or empty."""

    system_id: int
    tilt_deg: float
    boot_s: float  # Time of the write since the autopilot's boot
    host: str
    host_s: float  # Time of the write on our board's clock since its boot


def owed_in(directory: Path) -> StateFile[_Owed]:
    return StateFile(directory / "reboot-owed.json", _Owed)


class RequiredReboot:
    """Reminder, also on disk, that PX4 must be restarted before flight; `run` deletes it after the restart."""

    def __init__(self, core: Core) -> None:
        self._vehicle, self._offload, self._core = core.vehicle, core.offload, core
        self._file, self._host = owed_in(core.config.storage.path), this_boot()
        self._owed: _Owed | None = None
        self._boots = 0
        """Number of autopilot restarts seen before one became required; 0 if an earlier run required it."""
        self._from_earlier_run = False

    def load(self) -> None:
        self._owed = self._file.load()
        self._from_earlier_run = True

    @property
    def words(self) -> str | None:
        owed = self._owed
        if owed is None or self._vehicle.system_id not in (None, owed.system_id) or self._restarted(owed):
            return None
        return message("reboot_owed", tilt=f"{owed.tilt_deg:.1f}")

    def say(self) -> None:
        if (words := self.words) is not None:
            self._core.say(Severity.WARNING, f"Before flight: {words}", Weight.RESULT)

    async def after(self, changes: Sequence[Change]) -> None:
        """Note that PX4 must be restarted if these changes require it; raise StorageError if that cannot be saved."""
        stale_deg = self._vehicle.kind.stale_tilt_deg(changes)
        if stale_deg == 0.0:
            return
        # A small offset change does not reduce the tilt error that an earlier, larger one left in the EKF.
        left_deg = self._owed.tilt_deg if self._owed is not None and self.words is not None else 0.0
        tilt_deg = max(left_deg, stale_deg)
        now_s, (boot_s, _) = asyncio.get_running_loop().time(), self._vehicle.boot.latest or (0.0, 0.0)
        owed = _Owed(self._vehicle.system_id or 0, round(tilt_deg, 2), boot_s, self._host, now_s)
        await self._offload(self._file.write, owed)
        self._owed, self._boots, self._from_earlier_run = owed, self._vehicle.boots, False

    def _restarted(self, owed: _Owed) -> bool:
        latest = self._vehicle.boot.latest
        if not self._from_earlier_run or latest is None:
            return self._vehicle.boots != self._boots
        boot_s, heard_s = latest
        began_later = owed.host == self._host != "" and heard_s - boot_s > owed.host_s
        return began_later or boot_s < owed.boot_s - CLOCK_STEP_S or self._vehicle.boots != self._boots

    async def run(self) -> None:
        while True:
            await asyncio.sleep(OWED_POLL_S)
            if self._owed is not None and self._vehicle.system_id == self._owed.system_id and self.words is None:
                logger.info("PX4 has restarted: nothing is owed to it any more")
                with contextlib.suppress(StorageError):
                    await self._offload(self._file.clear)
                    self._owed = None
