"""A heading that turns by what other gyros do not, and all that it must not be taken for."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.daemon.heading.health import HeadingDriftMonitor

HZ = 10.0


def strays_after_s(
    rate_deg_s: Callable[[float], float],
    wrong_deg: Callable[[float], float],
    *,
    sigma_deg: float = 1.0,
    scale: float = 1.0,
    noise_deg_s: float = 0.0,
    late_s: float = 0.0,
) -> float:
    """When a heading that is off by `wrong_deg` is found to stray from gyros sampled at 10 Hz; inf: never."""
    straying, dice = HeadingDriftMonitor(), np.random.default_rng(1)
    fine = np.arange(0.0, 61.0, 1e-3)
    turned = np.cumsum([rate_deg_s(t) for t in fine]) * 1e-3
    for t_s in np.arange(1.0, 60.0, 1.0 / HZ):
        heading = math.radians(float(np.interp(t_s - late_s, fine, turned)) + wrong_deg(t_s))
        rate = scale * rate_deg_s(t_s) + float(dice.normal(0.0, 1.0)) * noise_deg_s
        straying.add(float(t_s), math.remainder(heading, 2.0 * math.pi), math.radians(sigma_deg), math.radians(rate))
        if straying.is_too_far:
            return float(t_s)
    return math.inf


def swinging(t_s: float) -> float:
    """To and fro by 20 deg, at up to 63 deg/s."""
    return 20.0 * math.pi * math.cos(math.pi * t_s)


@pytest.mark.parametrize("rate", [lambda _t: 0.0, lambda _t: 30.0, swinging], ids=["straight", "turns", "swings"])
@pytest.mark.parametrize("drift_deg_s", [3.0, -3.0])
def test_a_drift_is_found_in_time(rate: Callable[[float], float], drift_deg_s: float) -> None:
    """3 deg/s, before the autopilot's estimator is off by ten: PX4's follows by 4 deg within 4 s, by 16 within 6."""
    found_s = strays_after_s(rate, lambda t: drift_deg_s * max(0.0, t - 20.0))
    assert 21.0 < found_s < 20.0 + 4.0


@pytest.mark.parametrize("options", [
    {"scale": 1.015}, {"noise_deg_s": 2.0}, {"late_s": 0.03}, {"sigma_deg": 4.0, "noise_deg_s": 2.0},
])  # fmt: skip
@pytest.mark.parametrize("rate", [lambda _t: 0.0, lambda _t: 200.0, swinging], ids=["straight", "spins", "swings"])
def test_gyros_that_differ_are_no_drift(rate: Callable[[float], float], options: dict[str, float]) -> None:
    """Scales, vibration, and the wire's delay."""
    assert strays_after_s(rate, lambda t: 0.3 * t, **options) == math.inf


def test_a_compass_may_set_right_what_was_not_well_known() -> None:
    step = lambda t: 10.0 if t > 20.0 else 0.0  # noqa: E731
    assert strays_after_s(lambda _t: 0.0, step, sigma_deg=5.0) == math.inf
    assert strays_after_s(lambda _t: 0.0, step, sigma_deg=1.0) == pytest.approx(20.1, abs=0.2)


def test_a_drift_is_found_on_a_line_that_loses_a_fifth() -> None:
    """Two lost in a row are a gap in which nothing is compared, and nothing is forgotten."""
    straying, dice = HeadingDriftMonitor(), np.random.default_rng(3)
    for seed in range(20):
        straying, found_s = HeadingDriftMonitor(), math.inf
        for t_s in np.arange(10.0, 30.0, 1.0 / HZ):
            if dice.random() > 0.2:
                straying.add(float(t_s), math.radians(3.0 * max(0.0, t_s - 20.0)), math.radians(1.0), 0.0)
            if straying.is_too_far:
                found_s = float(t_s)
                break
        assert 20.0 < found_s < 24.0, seed
