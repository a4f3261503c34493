"""STATUSTEXT: one text at a time, and only where a ground station's HEARTBEAT is heard (autopilots 9.3.2)."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.px4.board import Board
from sim.px4.port import PX4Port

TEXT_PERIOD_S = 0.05
STALE_S = 5.0
_CHUNK = 50


class Voice:
    """Says texts on all ports; where nobody listens they wait, and are dropped when they are 5 s old."""

    def __init__(self, double: Board) -> None:
        self._double = double

    def say(self, severity: int, text: str) -> None:
        """Queue on every port; of more than eight that wait the oldest is lost."""
        now_s = self._double.now_s()
        for port in self._double.ports:
            port.texts.append((now_s, severity, text))
            self.go_on(port)

    def go_on(self, port: PX4Port) -> None:
        """Send the next text if its time has come: 20 a second."""
        now_s = self._double.now_s()
        while port.texts and now_s - port.texts[0][0] >= STALE_S:
            port.texts.popleft()
        if not port.texts or port.text_next_s > now_s or not port.has_ground_station(now_s):
            return
        _, severity, text = port.texts.popleft()
        data = text.encode()
        for number, start in enumerate(range(0, len(data), _CHUNK)):
            chunk = data[start : start + _CHUNK]
            self._double.answer(port, mavlink.MAVLink_statustext_message(severity, chunk, port.text_number, number))
        port.text_number = (port.text_number + 1) % 65536
        port.text_next_s = now_s + TEXT_PERIOD_S
        self._double.later(TEXT_PERIOD_S, lambda: self.go_on(port))
