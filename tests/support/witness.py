"""Independent record of the traffic from the daemon to its autopilot, by a parser of its own."""

from __future__ import annotations

from typing import TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.rig import Rig

M = TypeVar("M", bound=mavlink.MAVLink_message)


class WriteWitness:
    """Stands before a rig's autopilot and keeps what comes; make it before the rig runs."""

    def __init__(self, rig: Rig) -> None:
        self.heard: list[tuple[float, mavlink.MAVLink_message]] = []
        """Times of arrival on the loop's clock, and messages."""
        codec = mavlink.MAVLink(None)
        codec.robust_parsing = True
        handle = rig.autopilot.receive

        def receive(data: bytes, t_s: float) -> None:
            self.heard += [(t_s, message) for message in codec.parse_buffer(data) or ()]
            handle(data, t_s)

        rig.autopilot.receive = receive  # type: ignore[method-assign]

    def of(self, kind: type[M], since_s: float = 0.0) -> list[M]:
        """All messages of a kind that came after a time."""
        return [message for t_s, message in self.heard if isinstance(message, kind) and t_s > since_s]

    def times(self, kind: type[mavlink.MAVLink_message], since_s: float = 0.0) -> list[float]:
        return [t_s for t_s, message in self.heard if isinstance(message, kind) and t_s > since_s]
