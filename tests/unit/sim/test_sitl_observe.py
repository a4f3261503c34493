"""Excess of a swaying aircraft's delayed telemetry."""

from __future__ import annotations

import numpy as np

from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import motions_of
from sim.scenario import demo
from sim.sitl.residuals import STEP, excess

LATE_S = 0.035
GYRO_DEG_H, ACCEL_MG = (100.0, -60.0, 170.0), (1.0, -2.0, 3.0)


def left_of(step: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """deg/h and mg that are found too much beside the truth; integers of so many of their steps, 0: floats."""
    aircraft = demo(motions=motions_of("sea", seed=2)).aircraft
    imu = ImuModel(
        aircraft,
        "white_only",
        gyro_bias_rad_s=[value * DEG_H for value in GYRO_DEG_H],
        accel_bias_m_s2=[value * MG for value in ACCEL_MG],
    )
    made_s = 50.0 + np.arange(6000) / 100.0
    rows = imu.read(made_s, 0.01)
    if step:
        rows = np.trunc(rows / STEP) * STEP
        rows += np.sign(rows) * STEP / 2.0
    found = excess(aircraft, rows, made_s + LATE_S)
    return np.asarray(found / np.array([DEG_H] * 3 + [MG] * 3) - [*GYRO_DEG_H, *ACCEL_MG])


def test_biases_are_seen_through_waves_and_delay() -> None:
    left = left_of(0.0)
    assert np.abs(left[:3]).max() < 6.0, left
    assert np.abs(left[3:]).max() < 0.05, left


def test_and_through_integers() -> None:
    left = left_of(1.0)
    assert np.abs(left[:3]).max() < 12.0, left
    assert np.abs(left[3:]).max() < 0.1, left
