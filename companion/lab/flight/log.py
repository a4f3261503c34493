"""The parts of an autopilot's log that a flight is judged by, whichever firmware wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot.parameters.reading import FirmwareName
from companion.lab.flight.inertial import Navigation
from companion.physics.frames import Floats


class FlownImu(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU in one log."""

    number: int
    """Number from 1, as in the configuration."""
    t_s: Floats
    readings: Floats
    """(n, 6) rad/s and m/s^2, corrected by the firmware, vehicle FRD."""
    means: bool
    """Each is the mean since the one before, not an instant."""
    gyro_id: int | None = None
    accel_id: int | None = None
    degc: Floats = np.zeros((0, 2))
    """Time and temperature."""
    vibration: Floats = np.zeros((0, 2))
    """Time and level, m/s^2."""
    estimated: Floats | None = None
    """Biases of an EKF, (n, 9): time in s, of the gyro's axes (rad/s) and the accelerometer's z (m/s^2), sigma of each.

    NaN where it says nothing.
    """
    failed_s: Floats = np.zeros(0)
    """Times at which the autopilot took it for failed; its readings then are left out."""

    @property
    def rate_hz(self) -> float:
        """Mean rate of the readings."""
        return (len(self.t_s) - 1) / float(self.t_s[-1] - self.t_s[0]) if len(self.t_s) > 1 else 0.0


class Boot(msgspec.Struct, frozen=True, kw_only=True):
    """Log of one start of the autopilot, whichever firmware wrote it; times in s on its clock."""

    firmware: FirmwareName
    imus: tuple[FlownImu, ...]
    solution: Navigation | None
    truth: Navigation | None = None
    """Truth of a simulator."""
    armed: tuple[tuple[float, bool], ...] = ()
    motors: tuple[tuple[float, bool], ...] = ()
    airborne: tuple[tuple[float, bool], ...] = ()
    parameters: tuple[tuple[float, str, float], ...] = ()
    unix_offset_s: float | None = None
    """UTC less its clock."""
    place: tuple[float, float] | None = None
    """Latitude in degrees, and height in m."""
    earth_turns: bool = True
    standard_gravity: bool = False
    notes: tuple[str, ...] = ()

    def parameters_at(self, t_s: float) -> dict[str, float]:
        """Return the parameters at a time; one that was logged only later has its first value."""
        found: dict[str, float] = {}
        for told_s, name, value in self.parameters:
            if told_s <= t_s or name not in found:
                found[name] = value
        return found


def changes(t_s: Sequence[float] | Floats, states: Sequence[bool] | NDArray[Any]) -> tuple[tuple[float, bool], ...]:
    """List the first state and each change after it."""
    found: list[tuple[float, bool]] = []
    for at_s, state in zip(t_s, states, strict=True):
        if not found or found[-1][1] != bool(state):
            found.append((float(at_s), bool(state)))
    return tuple(found)
