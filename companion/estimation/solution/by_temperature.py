"""Biases of one IMU over temperature, as the terminal, the page and reports show them.

Built by `temperature_summary`. Without numpy: the page's process reads them.
"""

from __future__ import annotations

import msgspec

from companion.samples import Vector


class Seen(msgspec.Struct, frozen=True, kw_only=True):
    """One still window; vehicle FRD."""

    at_unix_s: float
    started_at: str
    """Start of the calibration that used the window; empty: none did."""
    power_up: int
    """Number of the power-up, from 0."""
    degc: float
    gyro_deg_h: Vector
    sigma_deg_h: Vector
    accel_mg: Vector | None
    """Known where the tilt was known."""
    accel_sigma_mg: Vector | None


class Expected(msgspec.Struct, frozen=True, kw_only=True):
    """Expected gyro biases at a temperature; one sigma."""

    degc: float
    gyro_deg_h: Vector
    sigma_deg_h: Vector


class ExpectedForces(msgspec.Struct, frozen=True, kw_only=True):
    """Expected accelerometer biases at a temperature; one sigma."""

    degc: float
    accel_mg: Vector
    sigma_mg: Vector


class ByTemperature(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU."""

    imu: str
    summary: str = ""
    """Amount of data, in words."""
    power_ups: int = 0
    days: int = 0
    points: tuple[Seen, ...] = ()
    curve: tuple[Expected, ...]
    """Expected gyro biases of the next power-up; empty: not known yet."""
    accel_curve: tuple[ExpectedForces, ...] = ()
    """Expected accelerometer biases of the next power-up; empty: not known yet."""
    needs: str | None = None
    """Reason why there is no curve, and what will make one; None: there is one."""
    today: int | None = None
    """Number of the present power-up; None: nothing is known of it yet."""
    now: Expected | None = None
    """Bias now: as last measured in this power-up, moved along the curve since."""
    at_power_up: Expected | None = None
    """Bias that the curve expects of a power-up at the temperature now."""
