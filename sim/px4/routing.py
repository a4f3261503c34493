"""Who gets a message: PX4 obeys only what is addressed to it or to all, and passes on only between willing ports.

Autopilots 5.4: both ports need MAV_n_FORWARD = 1, and the target must have been heard there. Nothing that is addressed
to another component is carried out by the autopilot.
"""

from __future__ import annotations

from collections.abc import Sequence

from sim.firmware.channel import Message
from sim.px4.port import PX4Port

COMPONENT = 1


def forward(system_id: int, ports: Sequence[PX4Port], came_by: PX4Port, message: Message, *, heartbeats: bool) -> None:
    """Pass a packet on to the other ports that it concerns."""
    system = int(getattr(message, "target_system", 0))
    component = int(getattr(message, "target_component", 0))
    if not came_by.forwards or (system, component) == (system_id, COMPONENT):
        return
    if message.get_type() == "HEARTBEAT" and not heartbeats:
        return
    for port in ports:
        if port is not came_by and port.forwards and port.has_seen(system, component):
            port.forward(bytes(message.get_msgbuf()))


def is_for_us(system_id: int, message: Message, *, broadcast: bool) -> bool:
    """Whether the target is this autopilot; `broadcast`: or every system."""
    system, component = int(getattr(message, "target_system", 0)), int(getattr(message, "target_component", 0))
    return (system == system_id or (broadcast and system == 0)) and component in (0, COMPONENT)
