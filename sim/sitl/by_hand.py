"""A real firmware's accelerometers on all sides: held by hand, judged by its telemetry beside the truth."""

from __future__ import annotations

import asyncio
import math
import re
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array, body_from_ned
from sim.hands import AHEAD_S, SIDES, Hands
from sim.imu_model import MG
from sim.sitl.ground import GroundStation
from sim.sitl.observe import mean_reading
from sim.sitl.vehicle import SitlVehicle

LOOK_S = 4.0
SETTLE_S = 40.0
"""After a start: the estimator has its position, and gravity."""
STANDS_S = 1.5
"""From the end of a movement until every filter has forgotten it."""
STORED_S = 4.0
"""By then PX4 has stored what was set."""
SIX_WITHIN_S = 240.0
_POSITIONS = {
    mavlink.ACCELCAL_VEHICLE_POS_LEVEL: "level",
    mavlink.ACCELCAL_VEHICLE_POS_LEFT: "left side down",
    mavlink.ACCELCAL_VEHICLE_POS_RIGHT: "right side down",
    mavlink.ACCELCAL_VEHICLE_POS_NOSEDOWN: "nose down",
    mavlink.ACCELCAL_VEHICLE_POS_NOSEUP: "nose up",
    mavlink.ACCELCAL_VEHICLE_POS_BACK: "on its back",
}
_PX4_SIDES = {
    "down": "level", "up": "on its back", "front": "nose down", "back": "nose up", "left": "left side down",
    "right": "right side down",
}  # fmt: skip
"""PX4 names the side that looks down."""


class Accelerometer(NamedTuple):
    """What is wrong with the output of one, in its own axes."""

    bias_mg: Array
    scale_percent: Array

    @property
    def level_mg(self) -> Array:
        """What it reads too much when level: up is -1 g on z."""
        return self.bias_mg + np.array([0.0, 0.0, -10.0]) * self.scale_percent

    def __str__(self) -> str:
        bias, scale, level = (
            " ".join(f"{value:+8.3f}" for value in part) for part in (self.bias_mg, self.scale_percent, self.level_mg)
        )
        return f"bias {bias} mg, scale {scale} %; when level {level} mg"


async def judged(vehicle: SitlVehicle, ground: GroundStation, hands: Hands, instance: int = 1) -> Accelerometer:
    """What telemetry on six sides and the truth of the aircraft tell: output = A force + bias.

    A holds scale, shear and how the board sits; the length of its rows is the scale. The aircraft ends on its spot.

    Raises:
        RuntimeError: the telemetry does not come.
    """
    outputs, forces = [], []
    for pitch, roll in SIDES.values():
        await stand(vehicle, hands.hold(vehicle.now_s + AHEAD_S, pitch, roll))
        begun_s = vehicle.now_s
        outputs.append((await mean_reading(vehicle, ground, instance, LOOK_S))[3:])
        forces.append(vehicle.aircraft.truth_at(begun_s).force_m_s2)
    await stand(vehicle, hands.back(vehicle.now_s + AHEAD_S))
    both = np.column_stack([np.array(forces), np.ones(len(forces))])
    found, *_ = np.linalg.lstsq(both, np.array(outputs), rcond=None)
    return Accelerometer(found[3] / MG, 100.0 * (np.linalg.norm(found[:3], axis=0) - 1.0))


async def attitude_error_deg(vehicle: SitlVehicle, ground: GroundStation) -> Array:
    """What ATTITUDE says too much after a restart, where the aircraft stands: roll, pitch.

    Raises:
        RuntimeError: ATTITUDE does not come.
    """
    await vehicle.sleep(STORED_S)
    await vehicle.power_cycle()
    await vehicle.sleep(SETTLE_S)
    await ground.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 20.0)
    seen = await ground.collect(mavlink.MAVLink_attitude_message, LOOK_S)
    if not seen:
        raise RuntimeError("no ATTITUDE came")
    return _off_deg(vehicle, np.mean([(message.roll, message.pitch) for message in seen], axis=0))


async def level_error_deg(vehicle: SitlVehicle, ground: GroundStation) -> Array:
    """What accelerometers and level make of where it stands, too much, without the estimator: roll, pitch.

    Raises:
        RuntimeError: the telemetry does not come.
    """
    up = (await mean_reading(vehicle, ground, 1, LOOK_S))[3:]
    if vehicle.firmware == "ardupilot":  # PX4's telemetry is turned already
        up = body_from_ned(await ground.get("AHRS_TRIM_X"), await ground.get("AHRS_TRIM_Y"), 0.0).T @ up
    return _off_deg(vehicle, np.array([math.atan2(-up[1], -up[2]), math.atan2(up[0], math.hypot(up[1], up[2]))]))


def _off_deg(vehicle: SitlVehicle, told_rad: Array) -> Array:
    off = told_rad - np.array(vehicle.aircraft.angles_rad(vehicle.now_s)[:2])
    wrapped: Array = np.degrees((off + np.pi) % (2.0 * np.pi) - np.pi)
    return wrapped


async def own_six_positions(vehicle: SitlVehicle, ground: GroundStation, hands: Hands) -> list[str]:
    """The firmware's own calibration on six sides (param5 = 1), each held as it asks, level on its spot; what it said.

    Raises:
        TimeoutError: it does not end.
    """
    said, at = list[str](), len(ground.heard)
    ground.send(
        mavlink.MAVLink_command_long_message(
            ground.vehicle, 1, mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0
        )
    )
    placed = 0
    async with asyncio.timeout(SIX_WITHIN_S):
        while not any(re.search(r"Calibration (successful|FAILED)|calibration (done|failed)", one) for one in said):
            await asyncio.sleep(0.05)
            new, at = [message for _, message in ground.heard[at:]], len(ground.heard)
            for message in new:
                if isinstance(message, mavlink.MAVLink_statustext_message) and message.get_srcComponent() == 1:
                    said.append(message.text.strip())
                    if (side := _px4_side(said)) is not None:
                        await _hold(vehicle, hands, side)
                asked = _asked(message)
                if asked is not None and asked > placed:  # it repeats itself while we hold it
                    placed = asked
                    await _hold(vehicle, hands, _POSITIONS[asked])
                    ground.send(
                        mavlink.MAVLink_command_long_message(
                            ground.vehicle, 1, mavlink.MAV_CMD_ACCELCAL_VEHICLE_POS, 0, float(asked), *[0.0] * 6
                        )
                    )
    await stand(vehicle, hands.back(vehicle.now_s + AHEAD_S))
    return said


async def _hold(vehicle: SitlVehicle, hands: Hands, side: str) -> None:
    at_s = vehicle.now_s + AHEAD_S
    await stand(vehicle, hands.back(at_s) if side == "level" else hands.hold(at_s, *SIDES[side]))


def _asked(message: mavlink.MAVLink_message) -> int | None:
    """The position that ArduPilot asks for."""
    if (
        isinstance(message, mavlink.MAVLink_command_long_message)
        and message.command == mavlink.MAV_CMD_ACCELCAL_VEHICLE_POS
        and int(message.param1) in _POSITIONS
    ):
        return int(message.param1)
    return None


def _px4_side(said: list[str]) -> str | None:
    """The side to hold next, where PX4 has just listed those that are missing."""
    if not said[-1].startswith("[cal] pending:"):
        return None
    pending = said[-1].removeprefix("[cal] pending:").split()
    return _PX4_SIDES[pending[0]] if pending else None


async def stand(vehicle: SitlVehicle, until_s: float) -> None:
    """Wait until it stands, in aircraft time, and a little longer."""
    await vehicle.sleep(max(until_s - vehicle.now_s, 0.0) + STANDS_S)
