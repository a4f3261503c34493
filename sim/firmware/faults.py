"""Faults of an autopilot; every field can be changed at any time while the double runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase


@dataclass(slots=True)
class Faults:
    """Switches for faults. Sets of parameter names can contain patterns such as "INS_ACC*"."""

    echo_without_effect: bool = False
    """PARAM_SET is stored and echoed, but the telemetry uses the old value until the next reboot."""
    refuse: set[str] = field(default_factory=set)
    """PARAM_SET of these names is refused as in ArduPilot: "Param write denied", PARAM_ERROR (4.8), the old value."""
    ignore: set[str] = field(default_factory=set)
    """PARAM_SET and PARAM_REQUEST_READ of these names are neither answered nor obeyed."""
    wrong_echo: set[str] = field(default_factory=set)
    """The answer to PARAM_SET of these names carries a wrong value; the value that was set is stored."""
    silent: bool = False
    """No answers: no parameters, no acknowledgements; heartbeats and telemetry go on."""
    heartbeat_off: bool = False
    telemetry_off: bool = False
    """Only heartbeats and answers are sent."""
    frozen_imu: bool = False
    """IMU messages repeat the last values."""
    int_only: bool = False
    """A board with 1 MB of flash: HIGHRES_IMU is not in the firmware."""
    reboot_after_writes: int | None = None
    """Reboot at the n-th PARAM_SET from now, after storing it and before answering; then the field is None."""
    arm_after_writes: int | None = None
    """Arm at the n-th PARAM_SET from now, which is still obeyed and answered; then the field is None."""
    gyro_calibration_fails: bool = False
    """The autopilot's own gyro calibration does not converge."""
    reboot_while_calibrating: bool = False
    """Restart in the middle of the autopilot's next gyro calibration; then the field is False."""
    foreign_write_after: tuple[int, str, float] | None = None
    """(n, name, value): another ground station sets a parameter right after the n-th PARAM_SET from now."""


def names_match(patterns: Iterable[str], name: str) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)
