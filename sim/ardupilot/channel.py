"""ArduPilot's streams on a port: ten intervals, and a quarter of the rate while parameters are listed."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Channel, Stream

MAX_INTERVALS = 10
"""Different intervals that one port can keep, beside the heartbeat's; the next one gets the nearest of these."""


class ArduPilotChannel(Channel):
    """A port of the ArduPilot double."""

    def set_stream(self, message_id: int, interval_s: float | None, now_s: float) -> None:
        """Start, change or (None) stop a stream; an interval beyond the ten kept becomes the nearest of them."""
        if interval_s is None:
            self.streams.pop(message_id, None)
            return
        apart = (message_id, mavlink.MAVLINK_MSG_ID_HEARTBEAT)
        kept = {stream.interval_s for other, stream in self.streams.items() if other not in apart}
        if message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT and interval_s not in kept and len(kept) >= MAX_INTERVALS:
            wanted_s = interval_s
            interval_s = min(kept, key=lambda value: abs(value - wanted_s))
        self.streams[message_id] = Stream(interval_s, now_s + interval_s)

    def due(self, now_s: float) -> list[int]:
        """Message ids whose time has come; a stream that fell behind skips, it never bursts."""
        due = []
        for message_id, stream in self.streams.items():
            if stream.next_s <= now_s + 1e-9:
                due.append(message_id)
                slow = self.listing and message_id != mavlink.MAVLINK_MSG_ID_HEARTBEAT
                interval = stream.interval_s * (4.0 if slow else 1.0)
                stream.next_s += interval
                if stream.next_s <= now_s:
                    stream.next_s = now_s + interval
        return due
