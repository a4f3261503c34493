"""The integration alone: coning, where rates that are integrated one by one run away, and a wild ride."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.attitude.strapdown import STEP_S, Strapdown
from companion.samples import ImuSample


def mean_rates(angles: Rotation, step_s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Mean body rates between attitudes a tenth of a step apart, summed as an integrating sensor does."""
    fine = (angles[:-1].inv() * angles[1:]).as_rotvec() / (step_s / 10)
    return np.asarray(fine.reshape(-1, 10, 3).mean(axis=1))


def ride(angles: Rotation, step_s: float) -> tuple[Strapdown, Rotation]:
    strapdown = Strapdown()
    x, y, z, w = angles[0].as_quat()
    strapdown.restart((w, x, y, z), 0.0)
    rates = mean_rates(angles, step_s)
    strapdown.integrate(
        [ImuSample((n + 1) * step_s, (a, b, c), (0.0, 0.0, 0.0)) for n, (a, b, c) in enumerate(rates.tolist())]
    )
    w, x, y, z = strapdown.orientation
    return strapdown, Rotation.from_quat([x, y, z, w])


def test_coning_does_not_run_away() -> None:
    step_s, seconds, frequency_hz, half_angle = 0.005, 20.0, 10.0, math.radians(2.0)
    times = np.arange(0.0, seconds + 1e-9, step_s / 10)
    phase = 2.0 * math.pi * frequency_hz * times
    cone = np.column_stack([np.cos(phase), np.sin(phase), np.zeros_like(phase)]) * half_angle
    angles = Rotation.from_rotvec(cone)
    _, found = ride(angles, step_s)
    error_deg = math.degrees((found * angles[-1].inv()).magnitude())
    # Without the coning term: (half angle)^2 / 2 * 2 pi f * (1 - sin x / x), x the phase of a step: 12 degrees in 20 s.
    x = 2.0 * math.pi * frequency_hz * step_s
    naive_deg = math.degrees(half_angle**2 / 2.0 * 2.0 * math.pi * frequency_hz * (1.0 - math.sin(x) / x) * seconds)
    assert naive_deg > 0.5
    assert error_deg < 0.05 * naive_deg


@pytest.mark.parametrize("step_s", [0.001, 0.005])
def test_a_wild_ride(step_s: float) -> None:
    times = np.arange(0.0, 10.0 + 1e-9, step_s / 10)
    euler = np.column_stack([3.0 * np.sin(3 * times), 0.8 * np.sin(2 * times), 5.0 * np.sin(times)])
    angles = Rotation.from_euler("ZYX", euler[:, ::-1])
    _, found = ride(angles, step_s)
    assert math.degrees((found * angles[-1].inv()).magnitude()) < 0.02


def test_stretches_cover_the_time_and_hold_the_mean_force() -> None:
    strapdown = Strapdown()
    strapdown.restart((math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)), 0.0)
    strapdown.force_bias_m_s2 = (0.5, 0.0, 0.0)
    stretches = strapdown.integrate([ImuSample(n / 100, (0.0, 0.0, 0.0), (1.5, 0.0, -9.8)) for n in range(1, 101)])
    assert len(stretches) == round(1.0 / STEP_S)
    assert sum(stretch.span_s for stretch in stretches) == pytest.approx(1.0)
    # The sensor's x looks east.
    assert stretches[-1].force_m_s2 == pytest.approx((0.0, 1.0, -9.8))
