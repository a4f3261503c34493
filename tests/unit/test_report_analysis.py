"""The figures behind the plots, against known noise and against allantools."""

from __future__ import annotations

import math
import warnings
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.physics.units import DEG_H
from companion.report import analysis
from companion.report.analysis import Point, allan, clock_is_sound, history, runs, slope
from companion.samples import Triad
from tests.support.histories import PER_K_DEG_H, record, white_trace


def _allantools() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import allantools
    return allantools


def test_the_deviation_of_white_noise_falls_with_the_root_of_time() -> None:
    one = record()
    trace = white_trace(one, 570, gyro_deg_h=7.0)
    found = allan(trace, trace.imus[0], "gyro")
    assert found is not None
    assert found.of_result
    assert found.seconds == 574
    assert [point.tau_s for point in found.points] == [1, 2, 4, 8, 16, 32, 64, 128]
    for point in found.points[:6]:
        expected = 7.0 * DEG_H / math.sqrt(point.tau_s)
        # Four sigmas of its own uncertainty, which is that of about 570 / tau independent pairs.
        tolerance = 4.0 / math.sqrt(2.0 * 570 / point.tau_s)
        assert np.asarray(point.deviation) == pytest.approx(expected, rel=max(tolerance, 0.1))


def test_the_interval_holds_the_truth_about_two_times_in_three() -> None:
    inside = total = 0
    for seed in range(40):
        trace = white_trace(record(), 60, gyro_deg_h=7.0, seed=seed)
        found = allan(trace, trace.imus[0], "gyro")
        assert found is not None
        for point in found.points[:4]:
            truth = 7.0 * DEG_H / math.sqrt(point.tau_s)
            held = [low <= truth <= high for low, high in zip(point.low, point.high, strict=True)]
            inside, total = inside + sum(held), total + 3
    assert 0.60 < inside / total < 0.76


@pytest.mark.parametrize("triad", ["gyro", "accel"])
def test_it_is_the_overlapping_deviation_of_allantools(triad: Triad) -> None:
    trace = white_trace(record(), 200)
    imu = trace.imus[1]
    found = allan(trace, imu, triad)
    assert found is not None
    values = np.array(imu.gyro_rad_s if triad == "gyro" else imu.accel_m_s2, dtype=np.float64)[1:205]
    assert found.seconds == len(values)
    taus = [float(point.tau_s) for point in found.points]
    for axis in range(3):
        _, theirs, _, _ = _allantools().oadev(values[:, axis], rate=1.0, data_type="freq", taus=taus)
        assert [point.deviation[axis] for point in found.points] == pytest.approx(theirs, rel=1e-6)


def test_a_hole_in_the_seconds_costs_pairs_and_changes_little() -> None:
    whole = white_trace(record(), 300)
    good = tuple(one and not 100 <= k < 110 for k, one in enumerate(whole.good))
    holed = msgspec.structs.replace(whole, good=good)
    full, less = allan(whole, whole.imus[0], "gyro"), allan(holed, holed.imus[0], "gyro")
    assert full is not None
    assert less is not None
    assert less.seconds == full.seconds - 10
    assert less.points[0].deviation == pytest.approx(full.points[0].deviation, rel=0.1)
    assert less.points[0].deviation != full.points[0].deviation


def test_without_a_result_the_longest_still_stretch_counts() -> None:
    trace = white_trace(record(state="failed"), 60)
    good = tuple(k not in (10, 11, 40) for k in range(len(trace.second)))
    trace = msgspec.structs.replace(trace, measured=None, good=good)
    found = allan(trace, trace.imus[0], "gyro")
    assert found is not None
    assert not found.of_result
    assert found.seconds == len(trace.second) - 41  # after the second knock
    assert allan(msgspec.structs.replace(trace, good=(False,) * len(good)), trace.imus[0], "gyro") is None


def test_verdicts_are_joined_where_they_are_of_one_kind() -> None:
    trace = white_trace(record(state="failed"), 20, moved=True)
    fc = next(one for one in trace.verdicts if one.name == "fc")
    found = runs(trace, fc)
    assert [(run.first, run.last) for run in found if run.state == "moving"] == [(-2, -1), (7, 8), (16, 17)]
    assert {run.words for run in found if run.state == "moving"} == {"gyro fc 0.31 deg/s > 0.10"}
    assert sum(run.last - run.first + 1 for run in found) == len(trace.second)
    gradienter = next(one for one in trace.verdicts if one.kind == "gradienter")
    assert [(run.first, run.last) for run in runs(trace, gradienter) if run.state == "fault"] == [(16, 20)]
    # A gap in the seconds is no neighbourhood.
    gap = msgspec.structs.replace(trace, second=(*trace.second[:-1], 100))
    assert runs(gap, fc)[-1].first == 100


def _point(number: int, temperature_degc: float | None, bias: float, unix_s: float | None = None) -> Point:
    return Point(number, float(number) if unix_s is None else unix_s, temperature_degc, (bias,) * 3, (1.0,) * 3)


def test_the_slope_against_temperature_is_that_of_the_line() -> None:
    line = [_point(k, 10.0 + 2 * k, 3.0 - 0.5 * (10.0 + 2 * k)) for k in range(6)]
    found = slope(line, 1)
    assert found is not None
    assert found.per_k == pytest.approx(-0.5)
    assert found.sigma_per_k == pytest.approx(0.0, abs=1e-9)
    assert found.at_mean + found.per_k * (20.0 - found.mean_degc) == pytest.approx(3.0 - 10.0)
    # numpy's own fit and covariance as the judge of a noisy one.
    rng = np.random.default_rng(5)
    noisy = [_point(k, float(t), float(v)) for k, (t, v) in enumerate(rng.normal(20.0, 6.0, (30, 2)))]
    (a, _), covariance = np.polyfit([p.temperature_degc or 0.0 for p in noisy], [p.bias[0] for p in noisy], 1, cov=True)
    found = slope(noisy, 0)
    assert found is not None
    assert found.per_k == pytest.approx(a)
    assert found.sigma_per_k == pytest.approx(math.sqrt(covariance[0, 0]))


def test_too_few_or_too_close_temperatures_give_no_line() -> None:
    assert slope([_point(k, 10.0 * k, 1.0) for k in range(4)], 0) is None
    assert slope([_point(k, 10.0 + k, 1.0) for k in range(5)], 0) is None
    assert slope([_point(k, 10.0 * k if k < 4 else None, 1.0) for k in range(9)], 0) is None


def test_the_history_holds_what_finished_in_its_order() -> None:
    records = [
        (1, record(1)),
        (2, record(2, state="failed", reason="moved")),
        (3, record(3, temperature_degc=35.0)),
    ]
    points = history(records, "fc", "gyro")
    assert [point.number for point in points] == [1, 3]
    assert points[1].bias == records[2][1].imus[0].gyro_bias_rad_s
    assert points[1].temperature_degc == 35.0
    warmer = (points[1].bias[0] - points[0].bias[0]) / DEG_H
    assert warmer == pytest.approx(10.0 * PER_K_DEG_H[0], abs=15.0)
    assert history(records, "another", "accel") == []
    assert clock_is_sound(points)


def test_a_clock_that_went_back_or_is_unreadable_is_not_sound() -> None:
    assert not clock_is_sound([_point(1, None, 0.0, 100.0), _point(2, None, 0.0, 50.0)])
    assert not clock_is_sound([Point(1, analysis.unix_s("yesterday"), None, (0.0,) * 3, (0.0,) * 3)])
    assert analysis.unix_s("2026-05-01T10:00:00+02:00") == analysis.unix_s("2026-05-01T08:00:00")
