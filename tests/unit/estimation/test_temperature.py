"""The curve over temperature: against a mixed model written out in full, and against simulated parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import kept
from companion.estimation.solution.curve import Curve, PowerUpNodes, fit, settling
from companion.estimation.solution.prior import curve_of
from sim.accuracy.temperature import RATES_K_MIN, SPANS_S, AgingAircraft, mid_warm_up
from sim.imu_model import DEG_H, PARTS

Array = NDArray[np.float64]
PER_K = 54.0
"""Everything here is in deg/h."""


def power_up(bias: Array, degc: Array, *, noise: float = 1.0, k_s: Array | None = None) -> PowerUpNodes:
    rates = np.zeros(len(degc)) if k_s is None else k_s
    return PowerUpNodes(np.column_stack([degc, rates]), bias, np.full(len(degc), noise**2))


def part(
    random: np.random.Generator, scatter: float, curve: Sequence[float], count: int, per: int = 6
) -> tuple[list[PowerUpNodes], Array]:
    """Power-ups of a few kelvin each, somewhere between 5 and 45 degC, and their offsets."""
    offsets = random.normal(0.0, scatter, (count, 3))
    found = []
    for offset in offsets:
        degc = random.uniform(5.0, 35.0) + np.arange(float(per))
        shape = np.polyval([*curve[::-1], 0.0], degc - 35.0)
        found.append(power_up(offset + shape[:, None] + random.normal(0.0, 1.0, (per, 3)), degc))
    return found, offsets


def test_it_is_the_generalised_least_squares_of_all_nodes_with_an_offset_a_power_up() -> None:
    random = np.random.default_rng(4)
    nodes, _ = part(random, 30.0, (8.0, 0.5), 7)
    curve = fit(nodes, 4.0, PER_K)
    assert curve is not None
    assert curve.order == 3
    degc, bias = (np.concatenate(each) for each in zip(*((one.states[:, 0], one.bias) for one in nodes), strict=True))
    of = np.repeat(np.arange(len(nodes)), [len(one.bias) for one in nodes])
    # One more power-up scatters by `scatter`: what it wanders by and Student's factor are in that.
    freedom = 3.0 * 5.0
    tau2 = curve.scatter.min() / (freedom / (freedom - 2.0)) - 4.0
    whole = np.where(of[:, None] == of, tau2, 0.0) + np.diag(np.full(len(of), 1.0 + 4.0))
    x = ((degc - 35.0) / 20.0)[:, None] ** np.arange(4)
    prior = np.diag([0.0, *np.square(PER_K * np.array([20.0, 10.0, 5.0])) ** -1.0])
    inverse = np.linalg.inv(whole)
    expected = np.linalg.solve(x.T @ inverse @ x + prior, x.T @ inverse @ bias)
    said, _ = curve.at(21.0)
    np.testing.assert_allclose(said, (-0.7) ** np.arange(4.0) @ expected, rtol=1e-5)


@pytest.mark.parametrize(("curve", "order"), [((), 0), ((20.0,), 3), ((20.0, 0.5), 3), ((9.0, 0.0, 0.05), 3)])
def test_a_mean_where_that_foretells_as_well(curve: tuple[float, ...], order: int) -> None:
    found = []
    for seed in range(20):
        nodes, _ = part(np.random.default_rng(seed), 20.0, curve, 12, per=4)
        one = fit(nodes, 1.0, PER_K)
        assert one is not None
        found.append(one.order)
    assert found.count(order) >= 16


@pytest.mark.parametrize("count", [6, 16, 40])
@pytest.mark.parametrize("per", [1, 4])
def test_a_change_of_one_power_up_lies_where_it_says(count: int, per: int) -> None:
    """Also where each was measured at one temperature only, and wherever the curve was seen."""
    off = []
    for seed in range(60):
        random = np.random.default_rng([count, per, seed])
        shape = random.normal(0.0, (20.0, 0.5, 0.02)).tolist()
        nodes, _ = part(random, 30.0, shape, count, per)
        curve = fit(nodes, 1.0, PER_K, may_be_mean=False)
        assert curve is not None
        then, now = np.sort(random.uniform(*curve.span_degc, 2)).tolist()
        said, variance = curve.change((then, 0.0), (now, 0.0))
        true = np.polyval([*shape[::-1], 0.0], now - 35.0) - np.polyval([*shape[::-1], 0.0], then - 35.0)
        off.append((true - said) / np.sqrt(variance))
    assert np.mean(np.abs(off) < 2.0) > 0.92
    assert np.sqrt(np.mean(np.square(off))) > 0.6


@pytest.mark.parametrize("count", [4, 8, 20])
def test_one_more_power_up_lies_where_it_says(count: int) -> None:
    inside, errors = [], []
    for seed in range(60):
        random = np.random.default_rng([count, seed])
        shape = random.normal(0.0, (20.0, 0.5, 0.01)).tolist()
        nodes, offsets = part(random, 30.0, shape, count + 1)
        curve = fit(nodes[:-1], 1.0, PER_K)
        assert curve is not None
        degc = float(nodes[-1].states[0, 0])
        truth = offsets[-1] + np.polyval([*shape[::-1], 0.0], degc - 35.0)
        said, variance = curve.at(degc)
        errors.append(truth - said)
        inside.append(np.abs(truth - said) < 2.0 * np.sqrt(variance))
    assert 0.92 < np.mean(inside) < 0.99
    if count == 20:
        assert np.sqrt(np.mean(np.square(errors))) < 1.3 * 30.0


def test_beyond_what_was_seen_it_goes_straight_on_and_says_so() -> None:
    nodes, _ = part(np.random.default_rng(2), 10.0, (20.0,), 8)
    curve = fit(nodes, 1.0, PER_K)
    assert curve is not None
    low, high = curve.span_degc
    assert curve.beyond_k(high + 3.0) == curve.beyond_k(low - 3.0) == 0.0
    assert curve.beyond_k(high + 10.0) == pytest.approx(7.0)
    steps = np.diff([curve.at(high + 3.0 + k)[0] for k in range(4)], axis=0)
    np.testing.assert_allclose(steps, 20.0, atol=2.0)
    np.testing.assert_allclose(steps[0], steps[2], rtol=1e-6)
    assert np.sqrt(curve.at(high + 10.0)[1]).min() > 7.0 * PER_K


def of_the_air(board_degc: Array, air_degc: float) -> Array:
    return np.asarray(air_degc + 2.0 * np.sin(np.arange(len(board_degc)) / 150.0 + air_degc))


def of_a_processor(board_degc: Array, air_degc: float) -> Array:
    """Warmer by 35 K in no time."""
    return air_degc + 35.0 * (1.0 - np.exp(-np.arange(len(board_degc)) / 60.0))


def of_a_heater(board_degc: Array, air_degc: float) -> Array:
    """It switches itself on and off."""
    return np.asarray(25.0 + 5.0 * np.sin(np.arange(len(board_degc)) / 100.0 + air_degc))


def in_degf(board_degc: Array, air_degc: float) -> Array:
    return 1.8 * board_degc + 32.0


@pytest.mark.parametrize("shown", [of_the_air, of_a_processor, of_a_heater])
@pytest.mark.parametrize("part", ["bmi088", "icm42688p"])
def test_a_foreign_thermometer_tells_of_no_change(part: str, shown: Callable[[Array, float], Array]) -> None:
    assert sum(learned(part, number, shown)[1] is not None for number in range(6)) <= 1


@pytest.mark.parametrize("shown", [None, in_degf])
@pytest.mark.parametrize("part", ["bmi088", "icm42688p"])
def test_its_own_tells_of_changes_as_well_as_it_says(part: str, shown: Callable[[Array, float], Array] | None) -> None:
    inside, left, moved = [], [], []
    for number in range(6):
        aircraft, curve = learned(part, number, shown)
        assert curve is not None
        first, *_, last = aircraft.seen(aircraft.day(), 99)
        assert first.gyro is not None
        assert first.temperature_degc is not None
        assert last.gyro is not None
        assert last.temperature_degc is not None
        said, variance = curve.change((first.temperature_degc, first.k_s), (last.temperature_degc, last.k_s))
        noise = 2.0 * PARTS[part].gyro.flicker ** 2 + first.gyro.sigma_stat[0] ** 2 + last.gyro.sigma_stat[0] ** 2
        change = np.subtract(last.gyro.bias, first.gyro.bias)
        moved.append(change)
        left.append(change - said)
        inside.append(np.abs(change - said) < 2.0 * np.sqrt(variance + noise))
    assert np.mean(inside) > 0.8
    assert np.square(left).mean() < 0.05 * np.square(moved).mean()


def learned(
    part: str, number: int, shown: Callable[[Array, float], Array] | None
) -> tuple[AgingAircraft, Curve | None]:
    """An aircraft after ten days, and its curve."""
    aircraft = AgingAircraft(PARTS[part].gyro, np.random.default_rng([9, number]), shown)
    known = [point for day in range(10) for point in aircraft.seen(aircraft.day(), day)]
    return aircraft, curve_of(kept(known), "gyro", noise_profile(part).gyro)


# --- within a window that warms


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


def test_how_slowly_a_board_warms_up_is_told_by_power_ups_that_ended_anywhere() -> None:
    days = []
    for k, air in enumerate((5.0, 12.0, 20.0, 31.0)):
        t_s = np.array([20.0, 90.0, 200.0 + 60.0 * k])
        degc = exponential(t_s, air + 15.0, tau_s=300.0)
        days.append(list(zip(degc.tolist(), ((air + 15.0 - degc) / 300.0).tolist(), strict=True)))
    found = settling(days)
    assert found is not None
    assert found[0] == pytest.approx(300.0)
    assert 0.0 < found[1] < 30.0
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
