"""Prediction of today's bias from earlier calibrations, against scipy's own figures and simulated truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.align_record import Determined, ImuAlignmentRecord
from companion.estimation.records.history import MeasuredBias, Point, PowerUp, believed, by_power_up
from companion.estimation.solution.prior import (
    Prediction,
    curve_of,
    expect,
    expect_today,
    pose_effect,
)
from companion.samples import Triad
from tests.prior_study import CASES, STEADY, Case, study
from tests.support.windows import ned_from_body

Array = NDArray[np.float64]
DEG_H = np.pi / 180.0 / 3600.0
MG = 9.80665e-3
G = 9.8
LEVEL = (0.0, 0.0, -1.0)
ASSUMED = pose_effect(None)


def point(
    bias: Sequence[float] | Array,
    run: str,
    *,
    triad: Triad = "gyro",
    temperature: float | None = 25.0,
    suspect: bool = False,
    since: float | None = None,
    up: Sequence[float] | Array = LEVEL,
    zero: str = "zero",
    sigma: float = 0.0,
) -> Point:
    x, y, z = (float(value) for value in bias)
    one = MeasuredBias(
        bias=(x, y, z),
        sigma_stat=(sigma, sigma, sigma),
        sigma_use=(1e-5, 1e-5, 1e-5),
        sigma_shared=(0.0, 0.0, 0.0),
        suspect=suspect,
    )
    return Point(
        started_at=run,
        unix_s=0.0,
        power_up=PowerUp(host=run, since_unix_s=since),
        temperature_degc=temperature,
        up=(up[0], up[1], up[2]),
        zero=zero,
        zero_sigma_rad=1e-3,
        gyro=one if triad == "gyro" else None,
        accel=one if triad == "accel" else None,
    )


def now(temperature: float | None = 25.0, up: Sequence[float] | Array = LEVEL, run: str = "today") -> Point:
    return Point(
        started_at="",
        unix_s=1e6,
        power_up=PowerUp(host=run, since_unix_s=None),
        temperature_degc=temperature,
        up=(up[0], up[1], up[2]),
        zero="zero",
    )


def some(count: int, seed: int = 1, scale: float = 50.0 * DEG_H) -> Array:
    return np.random.default_rng(seed).normal(0.0, scale, (count, 3))


def found(points: Sequence[Point], at: Point | None = None, triad: Triad = "gyro") -> Prediction:
    result = expect(points, triad, at or now(), ASSUMED, STEADY)
    assert result is not None
    return result


# --- which points


def test_several_calibrations_of_one_power_up_are_one_point() -> None:
    biases = some(3)
    once = [point(bias, str(k)) for k, bias in enumerate(biases)]
    often = [*once[:2], *[point(biases[2], "2") for _ in range(20)]]
    many, few = found(often), found(once)
    np.testing.assert_allclose([many.value, many.variance], [few.value, few.variance], rtol=1e-5)
    assert (many.power_ups, many.limit, many.weighs) == (few.power_ups, few.limit, few.weighs)
    assert expect(often[1:], "gyro", now(), ASSUMED, STEADY) is None
    assert found([*once, point([1.0, 1.0, 1.0], "today")]) == few, "today's own power-up is not among them"
    # The companion restarted, the autopilot did not, or the other way round: it may be the same power-up.
    kept_on = [
        point([0, 0, 0], "a", since=1000.0),
        point([0, 0, 0], "b", since=1020.0),
        point([0, 0, 0], "b", since=5e3),
    ]
    assert len(by_power_up(kept_on)) == 1
    assert len(by_power_up([kept_on[0], point([0, 0, 0], "b", since=5e3)])) == 2


def test_outliers_are_left_out_until_they_are_the_rule() -> None:
    good = [point(bias, f"good{k}") for k, bias in enumerate(some(5))]
    other = [point(bias + 1.0, f"other{k}", suspect=True) for k, bias in enumerate(some(3, seed=2))]

    def names(points: Sequence[Point]) -> list[str]:
        return [group[0].started_at for group in believed(points, "gyro")]

    assert names([*good, *other[:2]]) == [f"good{k}" for k in range(5)]
    # One good one in between: they are no row.
    assert names([*good, *other[:2], point([0, 0, 0], "again"), other[2]]) == [*(f"good{k}" for k in range(5)), "again"]
    assert names([*good, *other]) == ["other0", "other1", "other2"]
    later = [point([1, 1, 1], "later"), point([5, 5, 5], "odd", suspect=True)]
    assert names([*good, *other, *later]) == ["other0", "other1", "other2", "later"]
    assert believed(good, "accel") == []


# --- the mean and its scatter


def test_two_power_ups_say_nothing_three_guard_five_weigh() -> None:
    points = [point(bias, str(k)) for k, bias in enumerate(some(9))]
    assert expect(points[:2], "gyro", now(), ASSUMED, STEADY) is None
    assert [found(points[:count]).weighs for count in (3, 4, 5, 9)] == [False, False, True, True]
    assert found(points[:9]).power_ups == 9


def test_mean_and_sigma_are_those_of_one_more_power_up() -> None:
    from scipy import stats

    biases = some(12, seed=3)
    expected = found([point(bias, str(k)) for k, bias in enumerate(biases)])
    np.testing.assert_allclose(expected.value, biases.mean(axis=0), rtol=1e-9)
    own = biases.var(axis=0, ddof=1)
    freedom = 3 * 11
    widened = np.maximum(own, own.mean()) * stats.t(freedom).var()
    np.testing.assert_allclose(expected.variance, widened * (1.0 + 1.0 / 12.0), rtol=1e-6)
    assert not expected.by_temperature


# --- temperature


def test_three_kelvin_beyond_it_guards_wider_and_takes_no_part() -> None:
    temperatures = [10.0, 15.0, 20.0, 25.0, 30.0]
    slope = np.array([18.0, -30.0, 5.0]) * DEG_H
    points = [point(slope * t, str(k), temperature=t) for k, t in enumerate(temperatures)]
    near, edge, far = (found(points, now(t)) for t in (32.9, 33.0, 53.0))
    assert near.weighs
    assert edge.weighs
    assert not far.weighs
    assert near.by_temperature
    assert not found(points, now(None)).by_temperature
    assert not found([*points, point(slope * 20.0, "unknown", temperature=None)], now(22.0)).by_temperature


# --- attitude and the gradienter's zero


def test_a_bias_of_another_attitude_is_known_as_well_as_the_scale() -> None:
    """f = (I + S) (I - [m x]) g u + b, from the definition."""
    random = np.random.default_rng(4)
    scale, shear, turn = random.normal(0, 0.003, 3), random.normal(0, 0.001, 3), random.normal(0, 0.01, 3)
    known = (True, True, True)
    record = ImuAlignmentRecord(
        name="fc",
        temperature_degc=None,
        level_bias_mg=(0, 0, 0),
        level_sigma_mg=(0, 0, 0),
        accel_bias_mg=Determined(value=(0, 0, 0), sigma=(0, 0, 0), known=known),
        accel_scale=Determined(value=tuple(scale), sigma=(1e-4,) * 3, known=known),
        accel_shear=Determined(value=tuple(shear), sigma=(1e-4,) * 3, known=known),
        misalignment_deg=Determined(value=tuple(np.degrees(turn)), sigma=(0.01,) * 3, known=known),
        gyro_bias_deg_h=Determined(value=(0, 0, 0), sigma=(0, 0, 0), known=known),
    )
    errors = np.diag(scale) + np.array([[0, shear[0], shear[1]], [shear[0], 0, shear[2]], [shear[1], shear[2], 0]])
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    ups = [ned_from_body(pitch, roll, 0.0).T @ np.array(LEVEL) for pitch, roll in ((0, 0), (20, -10), (-5, 40))]
    effective = [(np.eye(3) + errors) @ (np.eye(3) - cross) @ (G * up) - G * up for up in ups]
    effect = pose_effect(record)
    for one, up in zip(effective, ups, strict=True):
        change, sigma = effect.change(G, up, ups[0])
        np.testing.assert_allclose(change, one - effective[0], atol=G * 1e-4)  # the product of two small ones
        assert sigma.max() < 0.3 * MG
    assert effect.effective(G, ups[1], np.zeros(3)).scale_from == "alignment"
    _, assumed = ASSUMED.change(G, ups[1], ups[0])
    assert assumed.max() > 5 * MG  # a misalignment of 1 degree and a scale of 0.5 % are possible


def test_the_vertical_scale_is_said_and_only_a_tilted_aircraft_is_warned_about() -> None:
    sigma = np.full(3, 0.2 * MG)
    level = ASSUMED.effective(G, np.array(LEVEL), sigma)
    assert level.scale_from == "assumed"
    np.testing.assert_allclose(level.scale_sigma_m_s2, 0.005 * G)
    np.testing.assert_allclose(level.level_sigma_m_s2, sigma)
    assert level.sensor_sigma_m_s2[2] == pytest.approx(np.hypot(0.005 * G, 0.2 * MG))
    for tilt, warned in ((0.0, False), (8.0, False), (30.0, True)):
        up = ned_from_body(tilt, 0.0, 0.0).T @ np.array(LEVEL)
        assert (ASSUMED.warning("fc", G, up, sigma) is not None) is warned
    # By definition: the vertical one moves by scale * g * (1 - cos tilt).
    straight = dataclasses.replace(ASSUMED, sigma=np.diag([0.0, 0.0, 0.005]), misalignment_sigma=np.zeros((3, 3)))
    tilted = straight.effective(G, up, np.zeros(3))
    assert tilted.level_sigma_m_s2[2] == pytest.approx(0.005 * G * (1 - np.cos(np.radians(30.0))))


# --- in the same power-up


def test_in_one_power_up_it_is_where_it_was_but_for_temperature_and_drift() -> None:
    last = point([1e-4, 2e-4, 3e-4], "today", temperature=20.0)
    gyro = noise_profile("icm42688p").gyro
    soon = expect_today(last, "gyro", now(20.0), ASSUMED, gyro)
    warm = expect_today(last, "gyro", now(30.0), ASSUMED, gyro)
    blind = expect_today(last, "gyro", now(None), ASSUMED, gyro)
    assert soon is not None
    assert warm is not None
    assert blind is not None
    assert soon.value == last.gyro.bias if last.gyro is not None else False
    np.testing.assert_allclose(np.subtract(warm.variance, soon.variance), (540.0 * DEG_H) ** 2)
    assert blind.variance == warm.variance
    assert not soon.weighs
    assert soon.limit == 4.0
    assert expect_today(last, "accel", now(), ASSUMED, gyro) is None
    later = expect_today(msgspec.structs.replace(last, unix_s=-1e6), "gyro", now(20.0), ASSUMED, gyro)
    assert later is not None
    assert later.variance > soon.variance


def test_in_one_power_up_a_curve_moves_it_and_says_how_well_that_is_known() -> None:
    """30 deg/h a kelvin, seen over eight days of five points each."""
    random, gyro = np.random.default_rng(7), noise_profile("icm42688p").gyro
    days = []
    for day in range(8):
        offset = random.normal(0.0, 40.0, 3)
        for degc in 15.0 + day + np.arange(0.0, 20.0, 4.0):
            bias = (offset + 30.0 * degc + random.normal(0.0, 1.0, 3)) * DEG_H
            days.append(point(bias.tolist(), f"day {day}", temperature=float(degc)))
    curve = curve_of(days, "gyro", gyro)
    last = msgspec.structs.replace(point([1e-4, 2e-4, 3e-4], "today", temperature=20.0), unix_s=1e6)
    warm = expect_today(last, "gyro", now(30.0), ASSUMED, gyro, curve)
    blind = expect_today(last, "gyro", now(30.0), ASSUMED, gyro)
    assert warm is not None
    assert blind is not None
    assert last.gyro is not None
    off = np.subtract(warm.value, last.gyro.bias) - 300.0 * DEG_H
    assert np.abs(off).max() < 3.0 * np.sqrt(max(warm.variance))
    assert np.sqrt(max(warm.variance)) < 60.0 * DEG_H < 540.0 * DEG_H < np.sqrt(min(blind.variance))
    # Beyond what was seen nobody knows.
    hot = expect_today(last, "gyro", now(60.0), ASSUMED, gyro, curve)
    assert hot is not None
    assert np.sqrt(min(hot.variance)) > 10.0 * 54.0 * DEG_H


# --- over many histories


def cases(*parts: str) -> list[Case]:
    return [case for case in CASES if any(part in case.name for part in parts)]


@pytest.mark.parametrize(
    "case",
    cases("good gyro, scatter 70", "scatter 0, 5 power", "2 accels", "ages"),
    ids=lambda case: case.name,
)
def test_it_never_makes_it_worse_and_sigmas_hold(case: Case) -> None:
    outcome = study(case, 150)
    assert outcome.ratio < 1.02
    # 95.4 % with what 450 axes that are not independent may miss by chance.
    assert 0.93 < outcome.coverage < 0.985
    assert outcome.doubted < 0.01


def test_another_sensor_is_doubted_and_not_drawn_to_the_old_one() -> None:
    for case in cases("another good gyro today", "another old gyro today"):
        outcome = study(case, 100)
        assert outcome.doubted > 0.95
        assert outcome.ratio < 1.02
