"""How ArduPilot turns its board's axes into the vehicle's: AHRS_ORIENTATION and the custom rotations."""

from __future__ import annotations

import math
from typing import Final

from companion.autopilot.parameters.client import ParameterClient
from companion.errors import AutopilotError
from companion.physics.frames import Matrix, rotation_matrix
from companion.rotations import ROTATION_NAMES

_ARDUPILOT_ONLY_DEG: Final = {41: (0.0, 7.0, 0.0), 42: (45.0, 0.0, 0.0), 43: (315.0, 0.0, 0.0)}
"""PITCH_7, ROLL_45, ROLL_315 (ArduPilot's rotations.h)."""

_CUSTOM_NAMES: Final = {
    100: ("AHRS_CUSTOM_ROLL", "AHRS_CUSTOM_PIT", "AHRS_CUSTOM_YAW"),  # up to 4.1
    101: ("CUST_ROT1_ROLL", "CUST_ROT1_PITCH", "CUST_ROT1_YAW"),
    102: ("CUST_ROT2_ROLL", "CUST_ROT2_PITCH", "CUST_ROT2_YAW"),
}


async def read_board_rotation(parameters: ParameterClient) -> Matrix:
    """The 3x3 matrix from the board's axes to the vehicle's FRD."""
    value = await parameters.read("AHRS_ORIENTATION")
    number = round(value) if math.isfinite(value) else -1
    if 0 <= number < len(ROTATION_NAMES):
        return rotation_matrix(ROTATION_NAMES[number])
    if number in _ARDUPILOT_ONLY_DEG:
        return rotation_matrix(_ARDUPILOT_ONLY_DEG[number])
    if number not in _CUSTOM_NAMES:
        raise AutopilotError(f"AHRS_ORIENTATION = {value:g} is not known")
    # A custom rotation that is set but switched off is an internal error to ArduPilot: nobody knows what it does.
    if number > 100 and not await parameters.read_optional("CUST_ROT_ENABLE"):
        raise AutopilotError(f"AHRS_ORIENTATION = {number} needs CUST_ROT_ENABLE = 1")
    roll_deg, pitch_deg, yaw_deg = [await parameters.read(name) for name in _CUSTOM_NAMES[number]]
    if not all(map(math.isfinite, (roll_deg, pitch_deg, yaw_deg))):
        raise AutopilotError(f"AHRS_ORIENTATION = {number}: its angles are {roll_deg}, {pitch_deg}, {yaw_deg}")
    return rotation_matrix((roll_deg, pitch_deg, yaw_deg))
