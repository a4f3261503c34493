"""Flights as `companion log flight` keeps them, of made-up figures."""

from __future__ import annotations

from companion.estimation.records.flight_record import (
    AXES,
    Drift,
    Flight,
    ImuFlight,
    KeptFlight,
    Split,
    Stages,
    Term,
)
from companion.physics.units import DEG_H, MG

UNITS = (DEG_H, DEG_H, DEG_H, MG)
LEFT = (12.0, -30.0, 8.0, 0.5)
"""Before the motors; deg/h and mg."""
STEP = (-5.0, 4.0, 30.0, 5.1)
SIGMA = (12.0, 12.0, 12.0, 0.6)
"""Sigma of the step."""
DRIFTS = {"flown": (0.4, 2.1, 9.5), "before": (6.0, 31.0, 160.0)}


def _imu_flight() -> ImuFlight:
    """Make the flight of an IMU that stood for 30 s and then flew."""
    figures = list(zip(LEFT, STEP, UNITS, strict=True))

    axes = tuple(
        Split(
            axis=axis,
            in_flight=Term((before + by) * unit, sigma * unit),
            ekf=Term(0.8 * (before + by) * unit, unit),
            turn_on=Term(before * unit, 0.3 * unit),
            temperature=None,
            motors=Term(by * unit, sigma * unit),
            vibration=None,
            trend=Term(0.1 * unit, 0.5 * unit),
        )
        for axis, sigma, (before, by, unit) in zip(AXES, SIGMA, figures, strict=True)
    )
    drift = {
        name: [Drift(seconds, 150, m, 2.4 * m) for seconds, m in zip((10.0, 30.0, 60.0), each, strict=False)]
        for name, each in DRIFTS.items()
    }
    return ImuFlight(
        imu=1, rate_hz=400.0, calibration="2026-11-23T06:12:13.000+00:00", gyro_id=2752772, accel_id=2753028,
        set_gyro_rad_s=(0.001,) * 3, set_accel_m_s2=(0.02,) * 3, axes=axes, drift=drift, notes=(),
    )  # fmt: skip


def kept_flight(key: str = "1") -> KeptFlight:
    flight = Flight(
        key=key, system_id=1, began_at="2026-11-23T08:00:46+00:00", stages=Stages(64.0, 65.0, 67.0, 240.0, 242.0),
        reference="ekf", notes=(), imus=(_imu_flight(),),
    )  # fmt: skip
    return KeptFlight(log="00000012.BIN", read_at="2026-11-23T09:10:11+00:00", flight=flight)
