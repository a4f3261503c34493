"""The figures behind the plots."""

from __future__ import annotations

import msgspec
import pytest

from companion.lab.report.seconds import runs
from companion.physics.units import DEG_H
from companion.report.page import Point, clock_is_sound, history, unix_s
from tests.support.histories import PER_K_DEG_H, record, white_trace


def test_verdicts_are_joined_where_they_are_of_one_kind() -> None:
    trace = white_trace(record(state="failed"), 20, moved=True)
    fc = next(one for one in trace.verdicts if one.name == "fc")
    found = runs(trace, fc)
    assert [(run.first, run.last) for run in found if run.state == "moving"] == [(-2, -1), (7, 8), (16, 17)]
    assert {run.words for run in found if run.state == "moving"} == {"gyro fc moves 0.31 deg/s, max 0.10"}
    assert sum(run.last - run.first + 1 for run in found) == len(trace.second)
    gradienter = next(one for one in trace.verdicts if one.kind == "gradienter")
    assert [(run.first, run.last) for run in runs(trace, gradienter) if run.state == "fault"] == [(16, 20)]
    # A gap in the seconds is no neighbourhood.
    gap = msgspec.structs.replace(trace, second=(*trace.second[:-1], 100))
    assert runs(gap, fc)[-1].first == 100


def test_the_history_holds_what_finished_in_its_order() -> None:
    records = [
        (1, record(1)),
        (2, record(2, state="failed", reason="moved")),
        (3, record(3, temperature_degc=35.0)),
    ]
    points = history(records, "fc", "gyro")
    assert [point.number for point in points] == [1, 3]
    assert points[1].bias == records[2][1].imus[0].gyro_bias_rad_s
    warmer = (points[1].bias[0] - points[0].bias[0]) / DEG_H
    assert warmer == pytest.approx(10.0 * PER_K_DEG_H[0], abs=15.0)
    assert history(records, "another", "accel") == []
    assert clock_is_sound(points)


def test_a_clock_that_went_back_or_is_unreadable_is_not_sound() -> None:
    assert not clock_is_sound([Point(k, at_s, (0.0,) * 3, (1.0,) * 3) for k, at_s in enumerate((100.0, 50.0))])
    assert not clock_is_sound([Point(1, unix_s("yesterday"), (0.0,) * 3, (0.0,) * 3)])
    assert unix_s("2026-05-01T10:00:00+02:00") == unix_s("2026-05-01T08:00:00")
