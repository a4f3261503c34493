"""PX4's console over MAVLink (SERIAL_CONTROL), as a ground station's "MAVLink console": one `listener` at a time.

`listener` prints what is published, in five decimals: 2 deg/h, 1 micro-g. Nothing else is typed there, and nothing
while the autopilot is not known to be disarmed. Each of PX4's MAVLink ports has its own console (autopilots 10.3).
"""

from __future__ import annotations

import asyncio
import re
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.waiting import comes

ID: Final = r"(\d+)[^\n]*\n\s*"
"""Pattern of a device id, to the start of the next line."""
VECTOR: Final = r"\[(-?\d+\.\d+), (-?\d+\.\d+), (-?\d+\.\d+)\]\s*"
_ANSWER_S: Final = 4.0
_BYTES: Final = 70
_SHELL: Final = mavlink.SERIAL_CONTROL_DEV_SHELL
_ASKING: Final = mavlink.SERIAL_CONTROL_FLAG_RESPOND | mavlink.SERIAL_CONTROL_FLAG_EXCLUSIVE
_LONGEST: Final = 8192
_PROMPT: Final = re.compile("(nsh|pxh)> ")


class Px4Console:
    """Has the console print topics."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.text = ""
        """Latest answer."""
        self._link, self._vehicle = link, vehicle
        self._asked, self._number = "", -1
        self._answered, self._lock = asyncio.Event(), asyncio.Lock()
        link.subscribe(mavlink.MAVLink_serial_control_message, self._on_text)

    async def listener(self, topic: str, pattern: re.Pattern[str], *which: str) -> re.Match[str] | None:
        """Have it print what is published; None: it did not in time, or something else."""
        async with self._lock:
            self.text, self._asked = "", topic
            self._answered.clear()
            line = " ".join(("listener", topic, *which, "\n")).encode()
            self._link.send(
                mavlink.MAVLink_serial_control_message(_SHELL, _ASKING, 0, 0, len(line), [*line.ljust(_BYTES, b"\0")])
            )
            await comes(self._answered, _ANSWER_S)
            self._asked = ""
            return pattern.search(self.text)

    def _on_text(self, message: mavlink.MAVLink_serial_control_message, _t_s: float) -> None:
        number, before = message.get_seq(), self._number
        if self._asked and message.device == _SHELL and self._vehicle.sent(message) and number != before:
            self._number = number  # the same again is a copy
            text = bytes(message.data[: message.count]).decode("ascii", "replace")
            self.text = (self.text + text)[-_LONGEST:]
            if _PROMPT.search(self.text, max(self.text.find(self._asked), 0)) and self._asked in self.text:
                self._answered.set()
