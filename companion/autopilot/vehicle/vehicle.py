"""State of the autopilot as seen over the link: identity, arm state, restarts and place.

`arm_state` follows the heartbeats. It is UNKNOWN from 2 s after the last heartbeat, and after a restart until the next.
It is DISARMED only if no armed heartbeat with the vehicle's ids has come for 3 s, from any sender (`heartbeats`).
Heartbeats may be old, so code that writes to the autopilot calls `disarmed.ensure` before every message.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from typing import Any, Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import Firmware
from companion.autopilot.firmware.firmwares import FIRMWARES, NO_FIRMWARE_YET, OTHER, firmware_with
from companion.autopilot.parameters.change import FirmwareName
from companion.autopilot.vehicle.commands import Commands, StandingRequests
from companion.autopilot.vehicle.disarmed import DisarmedCheck
from companion.autopilot.vehicle.heartbeats import (
    ArmingWatch,
    ArmState,
    AutopilotChooser,
    BootClock,
    is_aircraft,
    unique_id,
    version_text,
)
from companion.autopilot.vehicle.whereabouts import TimeAndPlace
from companion.links.mavlink.link import Handler, M, MavlinkLink, Message
from companion.links.mavlink.signing import EARLIEST_S
from companion.links.system.events import Listeners, comes
from companion.messages import message

__all__ = ["ArmState", "Vehicle", "VehicleEvent", "VehicleTimer"]

logger = logging.getLogger(__name__)

HEARTBEAT_TIMEOUT_S: Final = 2.0  # oldest heartbeat that shows the arm state (docs/reference/autopilots 8)

_HEARTBEAT_ID: Final[int] = mavlink.MAVLINK_MSG_ID_HEARTBEAT
_OVERDUE_S: Final = 1.1
_TICK_S: Final = 0.5
_STALL_S: Final = 1.0
_SLOWEST: Final = 5.0  # longest wait for one second of the autopilot's clock, in seconds of ours
_POLL_S: Final = 0.05

VehicleEvent = Literal["armed", "disarmed", "lost", "found", "rebooted"]
"""Events of `Vehicle.on_event`. "found": first heartbeat, or first one after "lost". "armed" and "disarmed": the arm
state has changed; the first heartbeat causes "found" and one of these. "disarmed" comes after 3 s without an armed
heartbeat."""


class Vehicle:
    """Autopilot to calibrate: the one with the given system id, otherwise the first real one with a heartbeat.

    The choice is final, and the link adopts the autopilot's system id. `is_carried`: whether the place may change.

    A real autopilot sends heartbeats with a known autopilot type and the type of a vehicle; those of ground stations,
    gimbals, ADS-B receivers and the like are ignored. Component 1 is chosen at once, another component only if it is
    ArduPilot or PX4 and component 1 stays silent for 2 s.
    """

    def __init__(
        self, link: MavlinkLink, *, system_id: int | None = None, is_carried: Callable[[], bool] = lambda: False
    ) -> None:
        self.system_id: int | None = None
        self.component_id: int = mavlink.MAV_COMP_ID_AUTOPILOT1
        self.kind: Firmware = NO_FIRMWARE_YET
        self.version: str | None = None  # Such as "4.6.1" or "4.8.0-dev"; None until AUTOPILOT_VERSION has come
        self.capabilities: int | None = None  # MAV_PROTOCOL_CAPABILITY bits; None until AUTOPILOT_VERSION has come
        self.uid: str | None = None  # id of the board; None until AUTOPILOT_VERSION has come
        self.system_status: int | None = None
        self.signs = False  # The autopilot signed its last heartbeat (MAVLink 2)
        self.boots = 0
        self.place = TimeAndPlace(is_carried)
        self.commands = Commands(link, lambda: None if self.system_id is None else (self.system_id, self.component_id))
        self.disarmed = DisarmedCheck(link, self.commands, lambda: self.arm_state, lambda: self.name)
        self.boot = BootClock()
        self._boot_heard = asyncio.Event()
        self._link = link
        self._latch = AutopilotChooser(system_id)
        self._heartbeat_s: float | None = None
        self._heartbeat_link_id: int | None = None
        self._arming = ArmingWatch()
        self._armed_told: bool | None = None
        self._conflict_logged = False
        self._lost = True
        self.on_event: Listeners[[VehicleEvent]] = Listeners()
        self.found = asyncio.Event()
        self._wanted = StandingRequests(self.commands)
        for each in FIRMWARES:
            if each.heartbeat_rate_hz is not None:
                self._wanted.add(mavlink.MAVLink_heartbeat_message, each.heartbeat_rate_hz, each.name)
        self._lost_timer: asyncio.TimerHandle | None = None
        self._tick_timer: asyncio.TimerHandle | None = None
        self._tick_due_s = math.inf
        # Subscribe first, so that a restart is detected before any other handler gets the message that shows it.
        for kind in (
            mavlink.MAVLink_system_time_message, mavlink.MAVLink_global_position_int_message,
            mavlink.MAVLink_attitude_message, mavlink.MAVLink_scaled_imu_message, mavlink.MAVLink_scaled_imu2_message,
            mavlink.MAVLink_scaled_imu3_message,
        ):  # fmt: skip
            link.subscribe(kind, self._on_boot_ms)
        link.subscribe(mavlink.MAVLink_raw_imu_message, self._on_boot_us)
        link.subscribe(mavlink.MAVLink_highres_imu_message, self._on_boot_us)
        self._unsubscribe = link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)
        self.hear(mavlink.MAVLink_system_time_message, self.place.hear_time)
        self.hear(mavlink.MAVLink_timesync_message, self._on_timesync)
        self.hear(mavlink.MAVLink_autopilot_version_message, self._on_version)
        self.hear(mavlink.MAVLink_global_position_int_message, self.place.hear_estimate)
        self.hear(mavlink.MAVLink_gps_raw_int_message, self.place.hear_receiver)

    @property
    def firmware(self) -> FirmwareName | None:
        return self.kind.name

    @property
    def arm_state(self) -> ArmState:
        """Arm state: ARMED or DISARMED while the autopilot's last heartbeat is younger than 2 s, otherwise UNKNOWN.

        Any armed heartbeat means ARMED for 3 s. A `conflict` means UNKNOWN.
        """
        now_s = asyncio.get_running_loop().time()
        armed = self._arming.armed(now_s)
        if self._lost or armed is None or self._heartbeat_s is None or self.conflict is not None:
            return ArmState.UNKNOWN
        if self._stalled(now_s) or now_s - self._heartbeat_s >= HEARTBEAT_TIMEOUT_S:
            return ArmState.UNKNOWN
        return ArmState.ARMED if armed else ArmState.DISARMED

    @property
    def conflict(self) -> str | None:
        """Description of two autopilots with the same ids, which makes the arm state UNKNOWN; None: no conflict."""
        return self._arming.conflict(asyncio.get_running_loop().time(), self.system_id)

    @property
    def alive(self) -> bool:
        age_s = self.heartbeat_age_s
        return not self._lost and age_s is not None and age_s < HEARTBEAT_TIMEOUT_S

    @property
    def heartbeat_age_s(self) -> float | None:
        if self._heartbeat_s is None:
            return None
        return asyncio.get_running_loop().time() - self._heartbeat_s

    @property
    def name(self) -> str:
        if self.system_id is None:
            return "no autopilot"
        return f"{self.kind.words}{' ' + self.version if self.version else ''}, system {self.system_id}"

    @property
    def why_silent(self) -> str:
        """Possible cause if an autopilot with heartbeats does not answer, to append to a message; may be empty."""
        return "; the autopilot signs its messages: does it refuse unsigned ones?" if self.signs else ""

    def sent(self, message: Message) -> bool:
        header = message.get_header()
        return header.srcComponent == self.component_id and header.srcSystem == self.system_id

    def hear(
        self, message: type[M], handler: Handler[M], rate_hz: float | None = None, of: FirmwareName | None = None
    ) -> None:
        """Call `handler` with each such autopilot message; `rate_hz`: also request it (only of firmware `of`)."""
        self._link.subscribe(message, self._of_ours(handler))
        if rate_hz is not None:
            self._wanted.add(message, rate_hz, of)

    async def hear_boot_time(self, timeout_s: float = 1.0) -> bool:
        """Request the time since boot and wait for it; afterwards `boots` counts every restart until now.

        Without this request, a quick restart shows only at the next time message. Return False on timeout.
        """
        request = self.commands.request_message(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME)
        try:
            self._boot_heard.clear()
            return await comes(self._boot_heard, timeout_s)
        finally:
            request.cancel()

    def close(self) -> None:
        self._lost = True
        self.found.clear()
        self._unsubscribe()
        for timer in (self._lost_timer, self._tick_timer):
            if timer is not None:
                timer.cancel()
        self.commands.close()

    def _tell(self, event: VehicleEvent) -> None:
        logger.log(logging.WARNING if event in ("lost", "rebooted") else logging.INFO, "%s: %s", self.name, event)
        self.on_event.tell(event)

    # --- heartbeats

    def _on_heartbeat(self, message: mavlink.MAVLink_heartbeat_message, t_s: float) -> None:
        if not is_aircraft(message):
            return
        if self.system_id is None and self._latch.takes(
            message, t_s, is_known=firmware_with(message.autopilot) is not OTHER
        ):
            self._latch_on(message)
        if not self.sent(message):
            return
        now_s = asyncio.get_running_loop().time()
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        ours = self._is_ours(message) and self._is_on_our_link(message) and not self._stalled(now_s)
        if ours or armed:
            self._arming.heard(now_s, armed=armed)
            self.disarmed.heard(armed=armed)
            self._log_conflict()
        if not ours:
            return
        was_lost = self._lost
        self._heartbeat_s = now_s
        self.system_status = message.system_status
        self.signs = bool(message.get_header().incompat_flags & mavlink.MAVLINK_IFLAG_SIGNED)
        self._lost = False
        self.found.set()
        if self._lost_timer is not None:
            self._lost_timer.cancel()
        self._lost_timer = asyncio.get_running_loop().call_later(HEARTBEAT_TIMEOUT_S, self._lose)
        if was_lost:
            self._ask_soon()
            self._tell("found")
        self._wanted.heard(message, now_s)
        # A disarmed heartbeat within 3 s after an armed one causes no event yet.
        believed = armed == self._arming.armed(now_s) and not self._arming.contradicts_itself(now_s)
        if believed and armed is not self._armed_told:
            self._armed_told = armed
            self._tell("armed" if armed else "disarmed")

    def _is_ours(self, message: mavlink.MAVLink_heartbeat_message) -> bool:
        """Check that a heartbeat has our vehicle's firmware: ArduPilot and PX4 both have system id 1 by default."""
        kind = firmware_with(message.autopilot)
        if kind is self.kind:
            return True
        if kind is OTHER:
            return False  # another device uses the ids; its arm state means nothing
        if not self._lost:
            self._arming.two_seen(asyncio.get_running_loop().time())
            self._log_conflict()
            return False
        # Another firmware was flashed while no heartbeats arrived.
        self.kind = kind
        self.boot = BootClock()
        self._arming.flashed()
        self._restarted()
        return True

    def _is_on_our_link(self, message: mavlink.MAVLink_heartbeat_message) -> bool:
        """Check that a heartbeat was signed for the link over which we receive the autopilot.

        The autopilot signs each of its links separately, so a delayed message of another link is recognised. Unsigned
        heartbeats (None) count until the first signed one.
        """
        link_id = self._link.signed_on(message)
        if self._lost or self._heartbeat_link_id is None:
            self._heartbeat_link_id = link_id
        return link_id == self._heartbeat_link_id

    def _log_conflict(self) -> None:
        conflict = self.conflict
        if conflict is not None and not self._conflict_logged:
            logger.error("%s: %s", self.name, conflict)
        self._conflict_logged = conflict is not None

    def _latch_on(self, message: mavlink.MAVLink_heartbeat_message) -> None:
        self.system_id, self.component_id = message.get_srcSystem(), message.get_srcComponent()
        self._link.join((self.system_id, self.component_id))
        self.kind = firmware_with(message.autopilot)
        self._wanted.add(mavlink.MAVLink_system_time_message, 1.0)
        self._wanted.add(mavlink.MAVLink_global_position_int_message, 1.0)
        self._wanted.add(mavlink.MAVLink_autopilot_version_message, None)
        self._tick()

    def _lose(self) -> None:
        self._lost = True
        self.found.clear()
        self._tell("lost")

    # --- requests

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if self._stalled(now_s):
            logger.warning("%s", message("program_stood_still", seconds=f"{now_s - self._tick_due_s:.1f}"))
            self._link.settled()  # messages that waited meanwhile are old
        self._tick_due_s = now_s + _TICK_S
        self._tick_timer = loop.call_at(self._tick_due_s, self._tick)
        if not self._lost:
            overdue = self._heartbeat_s is not None and now_s - self._heartbeat_s > _OVERDUE_S
            if overdue and self.kind.late_heartbeat_on_request:
                self.commands.request_message(_HEARTBEAT_ID)
            self._wanted.ask_for_missing(now_s, self.firmware)

    def _stalled(self, now_s: float) -> bool:
        """Return True if our event loop was stopped, so that messages may have waited unread."""
        return now_s - self._tick_due_s > _STALL_S

    def _ask_soon(self) -> None:
        # The streams have ended if the autopilot restarted while it was lost.
        self._wanted.forget_asking()
        self._wanted.ask_for_missing(asyncio.get_running_loop().time(), self.firmware)

    # --- other messages

    def _on_boot_ms(self, message: Any, t_s: float) -> None:
        if self.sent(message):
            self._follow(message.time_boot_ms * 1e-3, t_s)

    def _on_boot_us(self, message: Any, t_s: float) -> None:
        # Skip UTC, which the field may carry instead of the time since boot.
        if self.sent(message) and message.time_usec * 1e-6 < EARLIEST_S:
            self._follow(message.time_usec * 1e-6, t_s)

    def _follow(self, boot_s: float, t_s: float) -> None:
        restarted = self.boot.rebooted(boot_s, t_s)
        self._boot_heard.set()
        if restarted:
            self._restarted()

    def _restarted(self) -> None:
        self.boots += 1
        self._arming.restarted(asyncio.get_running_loop().time())
        self._log_conflict()
        self._armed_told = None
        self.place.restarted()
        self.version = self.capabilities = self.uid = None
        self._ask_soon()
        self._tell("rebooted")

    def _of_ours(self, handler: Handler[M]) -> Handler[M]:

        def hear(message: M, t_s: float) -> None:
            if self.sent(message):
                self._wanted.heard(message, t_s)
                handler(message, t_s)

        return hear

    def _on_timesync(self, message: mavlink.MAVLink_timesync_message, _t_s: float) -> None:
        if message.tc1 and self._link.signed_on(message) == self._heartbeat_link_id:
            self.disarmed.answered(message.ts1)

    def _on_version(self, message: mavlink.MAVLink_autopilot_version_message, _t_s: float) -> None:
        before = (self.version, self.capabilities, self.uid)
        self.version = version_text(message.flight_sw_version)
        self.capabilities = message.capabilities
        self.uid = unique_id(message)
        if before[0] is not None and before != (self.version, self.capabilities, self.uid):
            # The version cannot change within a boot, so one is forged: request it again for the true one.
            self.commands.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)


class VehicleTimer:
    """Timer on our clock and on the autopilot's, which is slower in a simulator on a busy machine.

    An autopilot does things "at most once a second" (docs/reference/autopilots 9.2) by its own clock. By our clock
    alone, a slow simulator that had no time to use a value would seem to have ignored it.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle, self._t_s = vehicle, asyncio.get_running_loop().time()
        self._boot, self._boots = vehicle.boot.latest, vehicle.boots

    def has_passed(self, seconds: float) -> bool:
        """Check that this time has passed on both clocks, or on ours if the autopilot's is unknown or far too slow."""
        gone_s = asyncio.get_running_loop().time() - self._t_s
        if gone_s < seconds:
            return False
        vehicle, boot = self._vehicle, self._vehicle.boot.latest
        if self._boot is None or boot is None or vehicle.boots != self._boots or not vehicle.alive:
            return True
        return boot[0] - self._boot[0] >= seconds or gone_s >= _SLOWEST * seconds

    async def let_pass(self, seconds: float) -> None:
        await asyncio.sleep(self._t_s + seconds - asyncio.get_running_loop().time())
        while not self.has_passed(seconds):
            await asyncio.sleep(_POLL_S)
