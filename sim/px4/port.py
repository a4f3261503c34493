"""PX4's ports: streams checked once per sensor sample, texts only for ground stations, routes learned per port.

Facts: PX4 `mavlink_stream.cpp`, `mavlink_main.cpp`, `STATUSTEXT.hpp` (2026-08), autopilots 4.5, 5.4, 9.2, 9.3.2.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Channel, Message, Stream

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
MAIN_LOOP_S = 0.0015
"""Pause between the loops of a port on a fast link."""
GCS_TIMEOUT_S = 2.5
TEXT_QUEUE = 8


@dataclass(slots=True)
class PacedStream(Stream):
    """A stream, and the nominal time of its last message."""

    last_s: float = 0.0


# Streams that run by themselves, in Hz: the modes "onboard" (TELEM2, the companion) and "normal" (TELEM1). GPS_RAW_INT
# goes out as often as the receiver speaks.
ONBOARD_RATES: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 10.0,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 100.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 10.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}
NORMAL_RATES: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 15.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}


class PX4Port(Channel):
    """One MAVLink instance.

    Args:
        defaults: rates in Hz of the streams that run by themselves.
        period_s: period of the sensor samples: streams are checked once per sample, so rates are quantised by it.
    """

    # PX4's documents, MAVLink Message Signing (main, 2026): its "unsigned message allowlist".
    UNSIGNED = (
        HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_RADIO_STATUS,
        mavlink.MAVLINK_MSG_ID_ADSB_VEHICLE,
        mavlink.MAVLINK_MSG_ID_COLLISION,
    )

    def __init__(
        self,
        system_id: int,
        handle: Callable[[Channel, Message, float], None],
        *,
        defaults: Mapping[int, float],
        period_s: float,
    ) -> None:
        super().__init__(system_id, handle)
        self.defaults, self.period_s = dict(defaults), period_s
        self.forwards = False
        """True: MAV_n_FORWARD was 1 at the last boot."""
        self.seen: set[tuple[int, int]] = set()
        """System and component of every sender heard since the boot."""
        self.gcs_heard_s = -math.inf
        """Time of the last HEARTBEAT with type GCS."""
        self.texts: deque[tuple[float, int, str]] = deque(maxlen=TEXT_QUEUE)
        """Waiting texts with time and severity; if there are too many, the oldest is lost."""
        self.text_number = 0
        self.text_next_s = 0.0

    def restart(self, now_s: float) -> None:
        """Handle a boot: default streams, no senders heard."""
        self.streams.clear()
        self.seen.clear()
        self.texts.clear()
        self.gcs_heard_s, self.text_number, self.listing = -math.inf, 0, False
        for message_id in self.defaults:
            self.set_stream(message_id, 0.0, now_s)
        self.streams[HEARTBEAT].next_s = now_s

    def has_seen(self, system: int, component: int) -> bool:
        """Return True if a target was heard on this port; system 0 stands for anybody."""
        if system == 0:
            return bool(self.seen)
        return any(s == system and component in (0, c) for s, c in self.seen)

    def has_ground_station(self, now_s: float) -> bool:
        """Return True if texts are sent on this port."""
        return now_s - self.gcs_heard_s <= GCS_TIMEOUT_S

    def set_stream(self, message_id: int, interval_s: float | None, now_s: float) -> None:
        """Start, change or (None) stop a stream; 0: this port's default rate, which can be none."""
        if interval_s == 0.0:
            rate = self.defaults.get(message_id, 0.0)
            interval_s = 1.0 / rate if rate else None
        if interval_s is None:
            self.streams.pop(message_id, None)
        else:
            stream = self.streams[message_id] = PacedStream(interval_s, 0.0, now_s)
            self._plan(stream)

    def due(self, now_s: float) -> list[int]:
        due = []
        for message_id, stream in self.streams.items():
            if stream.next_s <= now_s + 1e-9:
                due.append(message_id)
                assert isinstance(stream, PacedStream)
                interval = stream.interval_s
                late = now_s - stream.last_s
                # A little late: the next one is reckoned from when this one was due. Very late: from now.
                stream.last_s = stream.last_s + interval if 1.5 * interval > late else now_s
                self._plan(stream)
        return due

    def _plan(self, stream: PacedStream) -> None:
        """Plan the first sample at which a stream is due: 0.3 of a loop's pause before its interval is over."""
        wanted_s = stream.last_s + stream.interval_s - 0.3 * MAIN_LOOP_S
        stream.next_s = (math.floor(wanted_s / self.period_s) + 1) * self.period_s
