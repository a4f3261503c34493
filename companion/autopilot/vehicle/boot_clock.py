"""Did the autopilot restart? Told from its time since boot."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.mavlink.signing import EARLIEST_S
from companion.links.system.waiting import comes

_BACK_S: Final = 0.5
"""Late and repeated packets step back by milliseconds; a restart by all the time it was up."""

_GAP_S: Final = 2.0
_CONFIRM_S: Final = 0.5
_CLOCKS: Final = 1.01
"""More than two quartz clocks ever differ by."""
_WRAP_S: Final = 2**32 * 1e-3
"""time_boot_ms is a 32 bit number: it starts again after 49.7 days."""


class BootClock:
    """Watches the time since boot that many messages carry; all of them count from the same boot.

    A restart shows in one of two ways. The time goes back. Or, after a silence, it has advanced by less than half
    of what the host's clock has, and is not longer than the silence: a restart while the link was lost, of which the
    time since boot has meanwhile overtaken the old one. (Half, since a simulator may run slower than real time; on a
    busy machine slower than that, but an autopilot that was up for longer than we heard nothing has not restarted
    meanwhile. And the first messages after a silence of our own making are old ones from a buffer, so this second way
    must hold for another half second.)
    """

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None
        self._before_gap: tuple[float, float] | None = None
        self._suspected_s = 0.0

    @property
    def latest(self) -> tuple[float, float] | None:
        """The time since boot that was heard last, and when."""
        return self._last

    @property
    def latest_s(self) -> float | None:
        """The time since boot that was heard last."""
        return None if self._last is None else self._last[0]

    def rebooted(self, boot_s: float, t_s: float) -> bool:
        """Take one message's time since boot, received at `t_s`; True when a restart lies between it and the last."""
        if self._last is None:
            self._last = (boot_s, t_s)
            return False
        last_boot_s, last_t_s = self._last
        advance_s = boot_s - last_boot_s
        if advance_s < -_BACK_S and not (last_boot_s > _WRAP_S - 60.0 and boot_s < 60.0 + (t_s - last_t_s)):
            self._last, self._before_gap = (boot_s, t_s), None
            return True
        if self._before_gap is None and _too_slow(boot_s, t_s, self._last):
            self._before_gap, self._suspected_s = self._last, t_s
        elif self._before_gap is not None:
            if not _too_slow(boot_s, t_s, self._before_gap):
                self._before_gap = None
            elif t_s - self._suspected_s >= _CONFIRM_S:
                self._last, self._before_gap = (boot_s, t_s), None
                return True
        if advance_s < -_BACK_S or advance_s >= 0.0:
            self._last = (boot_s, t_s)
        return False


def _too_slow(boot_s: float, t_s: float, since: tuple[float, float]) -> bool:
    silence_s = t_s - since[1]
    advance_s = (boot_s - since[0]) % _WRAP_S
    fits_in_silence = boot_s <= silence_s * _CLOCKS + _BACK_S
    return silence_s > _GAP_S and fits_in_silence and advance_s < 0.5 * silence_s - 0.5


class BootWatch:
    """Reads the time since boot from every message of the autopilot that carries it.

    `on_restart` is called when it has restarted, before anybody else hears of the message that shows it.
    """

    def __init__(self, link: MavlinkLink, sent: Callable[[Message], bool], on_restart: Callable[[], None]) -> None:
        self._sent, self._on_restart = sent, on_restart
        self.clock = BootClock()
        self._heard = asyncio.Event()
        for kind in (
            mavlink.MAVLink_system_time_message, mavlink.MAVLink_global_position_int_message,
            mavlink.MAVLink_attitude_message, mavlink.MAVLink_scaled_imu_message, mavlink.MAVLink_scaled_imu2_message,
            mavlink.MAVLink_scaled_imu3_message,
        ):  # fmt: skip
            link.subscribe(kind, self._on_boot_ms)
        link.subscribe(mavlink.MAVLink_raw_imu_message, self._on_boot_us)
        link.subscribe(mavlink.MAVLink_highres_imu_message, self._on_boot_us)

    async def wait(self, timeout_s: float) -> bool:
        """Wait for the next message that carries the time since boot; False: none came in time."""
        self._heard.clear()
        return await comes(self._heard, timeout_s)

    def _on_boot_ms(self, message: Any, t_s: float) -> None:
        if self._sent(message):
            self._follow(message.time_boot_ms * 1e-3, t_s)

    def _on_boot_us(self, message: Any, t_s: float) -> None:
        # The field may carry UTC instead; no autopilot has been up since the nineteen-seventies.
        if self._sent(message) and message.time_usec * 1e-6 < EARLIEST_S:
            self._follow(message.time_usec * 1e-6, t_s)

    def _follow(self, boot_s: float, t_s: float) -> None:
        restarted = self.clock.rebooted(boot_s, t_s)
        self._heard.set()
        if restarted:
            self._on_restart()
