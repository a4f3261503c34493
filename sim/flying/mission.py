"""A mission over MAVLink: waypoints about the place of the start, flown round and round."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Site
from sim.sitl.ground import GroundStation

Item = mavlink.MAVLink_mission_item_int_message
WAYPOINT, JUMP = mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_DO_JUMP
RELATIVE = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
ROUNDS = 1000.0
UPLOADED_WITHIN_S = 10.0
CORNERS_M = ((0.0, 0.0), (60.0, 0.0), (60.0, 40.0), (0.0, 40.0))
"""North and east of the start."""


async def upload(
    ground: GroundStation, site: Site, height_m: float, corners_m: Sequence[tuple[float, float]] = CORNERS_M
) -> None:
    """Give the autopilot a mission that goes round these corners.

    Item 0 is the start: ArduPilot keeps its home there, PX4 flies to it once.

    Raises:
        TimeoutError: it does not take it.
        ValueError: it refuses it.
    """

    def item(number: int, command: int, frame: int, place: tuple[int, int, float], *params: float) -> Item:
        return mavlink.MAVLink_mission_item_int_message(
            ground.vehicle, 1, number, frame, command, 0, 1, params[0], params[1], params[2], params[3], *place
        )

    items = list[Item]()
    for north_m, east_m in [(0.0, 0.0), *corners_m]:
        latitude_deg, longitude_deg = site.place_deg(north_m, east_m)
        place = round(1e7 * latitude_deg), round(1e7 * longitude_deg), height_m
        items.append(item(len(items), WAYPOINT, RELATIVE, place, 0.0, 0.0, 0.0, math.nan))
    items.append(item(len(items), JUMP, mavlink.MAV_FRAME_MISSION, (0, 0, 0.0), 1.0, ROUNDS, 0.0, 0.0))
    since_s, answered = asyncio.get_running_loop().time(), len(ground.heard)
    ground.send(mavlink.MAVLink_mission_count_message(ground.vehicle, 1, len(items)))

    def acknowledged() -> bool:
        nonlocal answered
        for _, message in ground.heard[answered:]:
            if isinstance(
                message, mavlink.MAVLink_mission_request_int_message | mavlink.MAVLink_mission_request_message
            ):
                ground.send(items[message.seq])
        answered = len(ground.heard)
        return bool(ground.all(mavlink.MAVLink_mission_ack_message, since_s=since_s))

    await ground.wait_for(acknowledged, UPLOADED_WITHIN_S, "a mission that is taken")
    result = ground.all(mavlink.MAVLink_mission_ack_message, since_s=since_s)[-1].type
    if result != mavlink.MAV_MISSION_ACCEPTED:
        raise ValueError(f"the mission is refused: MAV_MISSION_RESULT {result}")
