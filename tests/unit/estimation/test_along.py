"""Along the curve through a window that warms, to its end and to when it is warm: against a bias made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.means.warming import temperature_path
from companion.estimation.temperature.curve import Along, Curve, Settling, Warm, fit, settling
from sim.accuracy.mid_warm_up import RATES_K_MIN, SPANS_S, mid_warm_up
from sim.imu_model import DEG_H
from tests.unit.estimation.test_temperature import PER_K, power_up
from tests.unit.estimation.test_warming import seconds


def bent(degc: float | np.ndarray) -> np.ndarray:
    """Deg/h."""
    return np.asarray(12.0 * (np.asarray(degc) - 35.0) + 0.4 * (np.asarray(degc) - 35.0) ** 2)


@pytest.fixture(scope="module")
def curve() -> Curve:
    random = np.random.default_rng(5)
    days = []
    for _ in range(12):
        degc = random.uniform(10.0, 25.0) + np.arange(0.0, 20.0, 2.0)
        bias = random.normal(0.0, 30.0, 3) + bent(degc)[:, None] + random.normal(0.0, 0.5, (10, 3))
        days.append(power_up(bias, degc, noise=0.5))
    found = fit(days, 0.1, PER_K, may_be_mean=False)
    assert found is not None
    return found


def exponential(t_s: np.ndarray, warm_degc: float = 40.0, left_k: float = 15.0, tau_s: float = 240.0) -> np.ndarray:
    return warm_degc - left_k * np.exp(-t_s / tau_s)


def test_a_path_is_bent_where_the_thermometer_says_so_and_none_where_it_stands_still() -> None:
    random = np.random.default_rng(6)
    degc = exponential(np.arange(60.0) + 0.5, tau_s=60.0)
    path = temperature_path(seconds((degc + random.normal(0.0, 0.02, 60)).tolist()))
    assert path is not None
    np.testing.assert_allclose(path.degc, exponential(np.array([0.0, 30.0, 60.0]), tau_s=60.0), atol=0.35)
    assert path.mean_degc == pytest.approx(degc.mean(), abs=0.02)
    (_, first), (_, middle), (_, last) = path.states
    assert first > middle > last > 0.0
    assert temperature_path(seconds((25.0 + random.normal(0.0, 0.02, 60)).tolist())) is None
    straight = temperature_path(seconds((25.0 + 0.01 * np.arange(20.0) + random.normal(0.0, 0.02, 20)).tolist()))
    assert straight is not None
    start, middle_degc, end = straight.degc
    assert middle_degc - start == pytest.approx(end - middle_degc)


def test_the_end_of_a_window_and_when_it_is_warm(curve: Curve) -> None:
    seconds_of = np.arange(60.0) + 0.5
    path = temperature_path(seconds(exponential(seconds_of).tolist()))
    assert path is not None
    found = curve.along(path.states, path.span_s, path.variance, Settling(240.0, 12.0))
    bias = bent(exponential(seconds_of))
    end = float(bent(exponential(np.array([60.0])))[0])
    assert found.shift == pytest.approx((end - bias.mean(),) * 3, abs=3.0 * math.sqrt(max(found.shift_variance)) + 0.5)
    assert found.slope == pytest.approx((np.polyfit(seconds_of, bias, 1)[0],) * 3, rel=0.05)
    warm = found.warm
    assert isinstance(warm, Warm)
    assert warm.degc == pytest.approx(40.0, abs=1.0)
    change = float(bent(40.0)) - end
    assert np.abs(np.subtract(warm.change, change)).max() < 3.0 * math.sqrt(max(warm.variance))
    assert math.sqrt(max(warm.variance)) < 0.25 * change
    # Where no power-up has been, and where nobody knows how it settles, nothing is foretold.
    assert curve.along(path.states, path.span_s, path.variance, Settling(1200.0, 60.0)).warm is None
    assert curve.along(path.states, path.span_s, path.variance, None).warm is None
    # What somebody takes off by temperature the readings do not show.
    none = found.less(np.array(found.shift), np.array(found.slope))
    assert (none.shift, none.slope, none.warm) == ((0.0,) * 3, (0.0,) * 3, None)
    assert isinstance(none, Along)


def test_how_slowly_a_board_warms_up_is_told_by_power_ups_that_ended_anywhere() -> None:
    days = []
    for k, air in enumerate((5.0, 12.0, 20.0, 31.0)):
        t_s = np.array([20.0, 90.0, 200.0 + 60.0 * k])
        degc = exponential(t_s, air + 15.0, tau_s=300.0)
        days.append(list(zip(degc.tolist(), ((air + 15.0 - degc) / 300.0).tolist(), strict=True)))
    found = settling(days)
    assert found is not None
    assert found.tau_s == pytest.approx(300.0)
    assert 0.0 < found.sigma_s < 30.0
    assert settling(days[:2]) is None
    # One that was warm already tells nothing.
    assert settling([*days[:2], [(30.0, 0.0), (30.1, 0.0)]]) is None


def test_the_curve_betters_what_the_readings_say_while_it_warms_and_says_what_comes() -> None:
    """Three pieces of a BMI088, 2 K a minute: 15 s and 60 s."""
    runs = [mid_warm_up("bmi088", RATES_K_MIN[1], 3, number) for number in range(3)]
    error, plain, warm, of_warm, later = (
        np.array([getattr(run, name) for run in runs]) / DEG_H
        for name in ("error", "plain_error", "warm_error", "warm_sigma", "plain_warm_error")
    )
    assert error.shape == (3, len(SPANS_S), 3)
    assert np.sqrt(np.mean(np.square(error))) < 0.7 * np.sqrt(np.mean(np.square(plain)))
    told = np.isfinite(of_warm)
    assert told.mean() > 0.5
    assert (np.abs(warm[told]) < 3.5 * of_warm[told]).all()
    assert np.sqrt(np.mean(np.square(warm[told]))) < 0.3 * np.sqrt(np.mean(np.square(later)))
