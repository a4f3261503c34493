"""Who gets a message: ArduPilot's routing, with its trap.

A message addressed to the vehicle's system and to a component that has been heard only on the sender's own port, or
never, is executed by the autopilot itself (autopilots 5.4, rule 1e).
"""

from __future__ import annotations

from collections.abc import Sequence

from sim.firmware.channel import Channel, Message


class Router:
    """Learns where components are from every message, and never forgets until a reboot."""

    def __init__(self, system_id: int, channels: Sequence[Channel]) -> None:
        self._system_id = system_id
        self._channels = channels
        self._routes: dict[tuple[int, int], set[int]] = {}

    def forget(self) -> None:
        """A reboot."""
        self._routes.clear()

    def knows(self, component_id: int) -> bool:
        """Whether a component of our own system has been heard on any port."""
        return (self._system_id, component_id) in self._routes

    def route(self, came_by: Channel, message: Message) -> bool:
        """Learn, forward, and say whether the autopilot is to handle the message itself."""
        here = self._channels.index(came_by)
        source = (message.get_srcSystem(), message.get_srcComponent())
        if source == (self._system_id, 1):
            return False  # our own words came back
        self._routes.setdefault(source, set()).add(here)
        system = int(getattr(message, "target_system", 0))
        component = int(getattr(message, "target_component", 0))
        if system == 0:
            ports = set(range(len(self._channels)))
        elif system == self._system_id and component == 1:
            ports = set()
        else:
            ports = set()
            for (known_system, known_component), where in self._routes.items():
                if known_system == system and component in (0, known_component):
                    ports |= where
        ports.discard(here)
        for port in ports:
            self._channels[port].forward(bytes(message.get_msgbuf()))
        if system == 0:
            return True
        if system != self._system_id:
            return False
        return component in (0, 1) or not ports
