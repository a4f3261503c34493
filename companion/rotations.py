"""MAVLink's sensor orientations by name and number.

The angles are intrinsic yaw, then pitch, then roll (aerospace 3-2-1) of the sensor's axes seen from the vehicle's
FRD axes. The numbers are those of MAV_SENSOR_ORIENTATION and of ArduPilot's AHRS_ORIENTATION.
"""

from __future__ import annotations

# `_FINE_DEG` has the two angles that names round: number 38 is pitch 68.8, yaw 293.3 degrees in both firmwares.
_NAMES = (
    "NONE", "YAW_45", "YAW_90", "YAW_135", "YAW_180", "YAW_225", "YAW_270", "YAW_315", "ROLL_180", "ROLL_180_YAW_45",
    "ROLL_180_YAW_90", "ROLL_180_YAW_135", "PITCH_180", "ROLL_180_YAW_225", "ROLL_180_YAW_270", "ROLL_180_YAW_315",
    "ROLL_90", "ROLL_90_YAW_45", "ROLL_90_YAW_90", "ROLL_90_YAW_135", "ROLL_270", "ROLL_270_YAW_45",
    "ROLL_270_YAW_90", "ROLL_270_YAW_135", "PITCH_90", "PITCH_270", "PITCH_180_YAW_90", "PITCH_180_YAW_270",
    "ROLL_90_PITCH_90", "ROLL_180_PITCH_90", "ROLL_270_PITCH_90", "ROLL_90_PITCH_180", "ROLL_270_PITCH_180",
    "ROLL_90_PITCH_270", "ROLL_180_PITCH_270", "ROLL_270_PITCH_270", "ROLL_90_PITCH_180_YAW_90", "ROLL_90_YAW_270",
    "ROLL_90_PITCH_68_YAW_293", "PITCH_315", "ROLL_90_PITCH_315",
)  # fmt: skip
_FINE_DEG = {68.0: 68.8, 293.0: 293.3}


def _angles_of(name: str) -> tuple[float, float, float]:
    words = name.split("_")
    angle_of = dict(zip(words[0::2], words[1::2], strict=False))
    roll, pitch, yaw = (float(angle_of.get(axis, 0)) for axis in ("ROLL", "PITCH", "YAW"))
    return roll, _FINE_DEG.get(pitch, pitch), _FINE_DEG.get(yaw, yaw)


ROTATIONS_DEG: dict[str, tuple[float, float, float]] = {f"ROTATION_{name}": _angles_of(name) for name in _NAMES}
"""Name to (roll, pitch, yaw) in degrees, in the order of MAV_SENSOR_ORIENTATION's numbers 0 to 40."""

ROTATION_NAMES: tuple[str, ...] = tuple(ROTATIONS_DEG)
"""Names by number: `ROTATION_NAMES[2] == "ROTATION_YAW_90"`."""
