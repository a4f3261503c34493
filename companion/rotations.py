"""Angles of MAVLink's sensor orientations, by name and number.

The angles turn the vehicle's axes (FRD) into the sensor's axes: first yaw, then pitch, then roll, each about the axes
already turned (aerospace 3-2-1). The numbers are MAV_SENSOR_ORIENTATION's, and ArduPilot's for AHRS_ORIENTATION.
"""

from __future__ import annotations

# `_FINE_DEG` has two angles that a name rounds: number 38 is pitch 68.8, yaw 293.3 degrees in ArduPilot and PX4.
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
"""Roll, pitch and yaw in degrees of each orientation, by name, in the order of MAV_SENSOR_ORIENTATION (0 to 40)."""

ROTATION_NAMES: tuple[str, ...] = tuple(ROTATIONS_DEG)
"""Names of the orientations by their number in MAV_SENSOR_ORIENTATION: number 2 is "ROTATION_YAW_90"."""
