"""A tilt that PX4's EKF2 keeps from before a write until PX4 restarts; remembered, over our own ends too.

A restart while the companion was off shows in the time since boot: it is less than it was at the write, or began after
that, where the board has run on. What shows in neither counts as none: one restart too many costs a minute.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from companion.autopilot.firmware.px4 import LEVEL, stale_tilt_deg
from companion.autopilot.parameters.change import Change
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.errors import StorageError
from companion.storage.learned import this_boot
from companion.storage.state import StateFile

logger = logging.getLogger(__name__)

GATED_TILT_DEG: Final = 0.3
"""Tilt that PX4 may have kept from before a write, above which it has to be restarted before it flies. A smaller one is
what its EKF2 shows of the biases of an uncalibrated sensor (autopilots 9.3)."""
BACK_S: Final = 0.5
"""By which late packets step back."""
POLL_S: Final = 1.0


class _Owed(msgspec.Struct, frozen=True):
    """What was owed, and when in the life of the autopilot and of the board."""

    system_id: int
    tilt_deg: float
    boot_s: float
    """The autopilot's time since boot."""
    host: str
    """Which start of the board it was; empty: unknown."""
    host_s: float
    """On that start's clock."""


def owed_in(directory: Path) -> StateFile[_Owed]:
    """What is kept in a storage directory."""
    return StateFile(directory / "reboot-owed.json", _Owed)


class RebootOwed:
    """Remembers it; `run` forgets it when the restart was seen."""

    def __init__(self, core: Core) -> None:
        self._vehicle, self._offload, self._core = core.vehicle, core.offload, core
        self._file, self._host = owed_in(core.config.storage.path), this_boot()
        self._owed: _Owed | None = None
        self._boots = 0
        """Restarts seen when it was owed, or read."""
        self._earlier = False
        """Whether it was read: of an earlier run of the companion."""

    def load(self) -> None:
        """Read what was kept before this start; blocking."""
        self._owed = self._file.load()
        self._earlier = True

    @property
    def words(self) -> str | None:
        """Why it must be restarted before it may arm, in few words; None when it need not."""
        owed = self._owed
        if owed is None or self._vehicle.system_id not in (None, owed.system_id) or self._restarted(owed):
            return None
        return f"reboot PX4: tilt {owed.tilt_deg:.1f} deg off"

    def say(self) -> None:
        """Tell the pilot, where there is something to tell."""
        if (words := self.words) is not None:
            self._core.say(Severity.WARNING, f"Before flight: {words}", Weight.RESULT)

    async def after(self, changes: Sequence[Change]) -> None:
        """These come into force.

        Raises:
            StorageError: that a restart is owed cannot be kept.
        """
        level = {change.parameter: change.after - change.before for change in changes if change.parameter in LEVEL}
        turned_deg, stale_deg = math.hypot(*level.values()), stale_tilt_deg(changes)
        if turned_deg == 0.0 and stale_deg < GATED_TILT_DEG:
            return
        # A small step after a large one leaves what the large one has left.
        left_deg = self._owed.tilt_deg if self._owed is not None and self.words is not None else 0.0
        tilt_deg = max(left_deg, turned_deg, stale_deg)
        now_s, boot_s = asyncio.get_running_loop().time(), self._vehicle.boot.clock.latest_s
        owed = _Owed(self._vehicle.system_id or 0, round(tilt_deg, 2), boot_s or 0.0, self._host, now_s)
        await self._offload(self._file.write, owed)
        self._owed, self._boots, self._earlier = owed, self._vehicle.boots, False

    def _restarted(self, owed: _Owed) -> bool:
        latest = self._vehicle.boot.clock.latest
        if not self._earlier or latest is None:
            return self._vehicle.boots != self._boots
        boot_s, heard_s = latest
        began_later = owed.host == self._host != "" and heard_s - boot_s > owed.host_s
        return began_later or boot_s < owed.boot_s - BACK_S or self._vehicle.boots != self._boots

    async def run(self) -> None:
        """Forget it once the restart was seen, until cancelled."""
        while True:
            await asyncio.sleep(POLL_S)
            if self._owed is not None and self._vehicle.system_id == self._owed.system_id and self.words is None:
                logger.info("PX4 has restarted: nothing is owed to it any more")
                with contextlib.suppress(StorageError):
                    await self._offload(self._file.clear)
                    self._owed = None
