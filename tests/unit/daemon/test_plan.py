"""Residuals that are worth a write."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.daemon.offsets.plan import as_good
from companion.estimation.solution.solve import ImuSolution, Shared
from companion.physics.units import DEG_H

ESTIMATED_DEG_H, NEXT_MINUTES_DEG_H = 1.0, 17.0
CALIBRATION = ImuCalibration(
    instance=1,
    parameters=ArduPilotParameters(1),
    gyro_offset_rad_s=(1e-3, 1e-3, 1e-3),
    accel_offset_m_s2=(0.0, 0.0, 0.0),
    accel_scale=(1.0, 1.0, 1.0),
    gyro_id=1,
    accel_id=1,
    orientation=np.eye(3),
)


def is_left(residual_deg_h: float, estimated_deg_h: float = ESTIMATED_DEG_H, written_rad_s: float = 1e-3) -> bool:
    """Return True where gyros with this residual keep the offsets of an earlier calibration as good as this one."""
    sigma = NEXT_MINUTES_DEG_H * DEG_H
    found = ImuSolution(
        name="fc",
        samples=1000,
        temperature_degc=None,
        gyro_rad_s=np.array([residual_deg_h * DEG_H, 0.0, 0.0]),
        accel_m_s2=None,
        sigma_stat=np.full(6, estimated_deg_h * DEG_H),
        covariance=np.eye(6) * sigma**2,
        warnings=(),
    )
    shared = Shared(np.array([0.0, 0.0, -1.0]), 9.81, np.zeros((6, 6)), None, (0.0, 0.0), 0.0)
    earlier: Any = SimpleNamespace(
        sigma_in_force=lambda triad: (sigma,) * 3,
        of=lambda triad: SimpleNamespace(sigma_stat=(estimated_deg_h * DEG_H,) * 3),
        written={name: SimpleNamespace(after=written_rad_s) for name in ArduPilotParameters(1).gyro_offset},
    )
    return as_good(CALIBRATION, found, shared, earlier) == {"gyro"}


@pytest.mark.parametrize(("residual_deg_h", "left"), [(0.0, True), (12.0, True), (25.0, False), (33.0, False)])
def test_a_residual_is_judged_by_how_well_it_is_known(residual_deg_h: float, *, left: bool) -> None:
    """33 deg/h known to 1 is what the autopilot's calibration at a boot leaves; the next minutes may move it by 17."""
    assert is_left(residual_deg_h) is left


def test_what_is_known_no_better_than_the_next_minutes_is_left() -> None:
    assert is_left(33.0, estimated_deg_h=17.0)


def test_offsets_that_the_last_calibration_has_not_written_are_replaced() -> None:
    assert not is_left(0.0, written_rad_s=2e-3)
