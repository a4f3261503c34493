"""Invariants for any input: no exception, bounded memory, equivariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import CollectorStatus
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.noise.lines import huber_mean
from companion.estimation.seconds.batch import BatchSource
from companion.samples import CompassSample, ImuSample, TiltSample
from tests.support import still_aircraft as still

FLOATS = st.floats(allow_nan=True, allow_infinity=True)
TIMES = st.one_of(st.floats(0.0, 40.0), FLOATS)
VECTORS = st.tuples(FLOATS, FLOATS, FLOATS)
EVENTS = st.one_of(
    st.builds(ImuSample, TIMES, VECTORS, VECTORS, st.none() | FLOATS, st.none() | st.integers(0, 255)),
    st.builds(TiltSample, TIMES, FLOATS, FLOATS, st.none() | FLOATS),
    st.builds(CompassSample, TIMES, FLOATS),
    st.tuples(st.just("run"), st.integers(1, 12)),
    st.tuples(st.just("jump"), st.floats(-100.0, 100.0)),
    st.tuples(st.just("ask"), FLOATS | st.floats(0.0, 100.0)),
    st.tuples(st.just("reset"), st.sampled_from([None, "fc", "nobody"])),
    st.tuples(st.just("again"), st.booleans()),
)


@settings(max_examples=150)
@given(st.lists(EVENTS, max_size=25))
def test_nothing_that_arrives_raises(events: list[object]) -> None:
    collector = RollingCollector(still.settings(max_s=20.0), [still.imu()], still.TILT, still.HEADING)
    feed = still.Feeder(collector, rate_hz=8)
    feed.tilt = lambda _t: (1.0, -1.0)
    feed.heading = lambda _t: 0.1
    for event in events:
        match event:
            case ImuSample():
                collector.add_imu("fc", event)
            case TiltSample():
                collector.add_tilt(event)
            case CompassSample():
                collector.add_compass(event)
            case ("run", int(seconds)):
                feed.run(seconds)
            case ("jump", float(by)):
                feed.now_s += by
            case ("ask", float(when)):
                check(collector, when)
            case ("reset", name):
                collector.reset("property", name)  # type: ignore[arg-type]
            case ("again", bool(known)):
                step = 1e-3 if known else 0.0
                collector.set_imu(still.imu(gyro_step_rad_s=step, accel_step_m_s2=step))
        check(collector, feed.now_s)
        assert sum(len(source.batches.batches) for source in collector.sources()) <= 3 * 30


def check(collector: RollingCollector, now_s: float) -> None:
    collector.tick(now_s)
    status = collector.status(now_s)
    assert isinstance(status, CollectorStatus)
    assert 0.0 <= status.progress <= 1.0
    assert status.waiting_for is None or (status.waiting_for and "\n" not in status.waiting_for)
    assert not status.enough or status.waiting_for is None
    try:
        window = collector.window(now_s)
    except CalibrationRefusedError:
        window = None
    assert window is not None or not status.enough
    if window is not None:
        for imu in window.imus:
            assert all(math.isfinite(value) for value in imu.gyro_rad_s + imu.accel_m_s2)
            assert all(sigma >= 0.0 for sigma in imu.gyro_sigma_stat_rad_s + imu.gyro_sigma_use_rad_s)


@settings(max_examples=100)
@given(st.lists(st.tuples(TIMES, FLOATS, st.none() | FLOATS), max_size=60), FLOATS)
def test_a_source_survives_any_stream(stream: list[tuple[float, float, float | None]], now_s: float) -> None:
    for circle in (False, True):
        source = BatchSource((1e3,), 5, circle=circle)
        for time, value, stamp in stream:
            source.add(time, (value,), None, stamp)
        source.close_before(now_s)
        assert len(source.batches) <= 5
        for batch in source.batches.values():
            assert (batch.low <= batch.high).all()
            assert batch.n >= 1
            assert 0.0 <= batch.largest_gap_s <= 1.0


VALUES = st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=40)


@settings(max_examples=150)
@given(VALUES, st.floats(-1e4, 1e4), st.floats(0.01, 100.0))
def test_huber_moves_with_its_values(values: list[float], shift: float, scale: float) -> None:
    column = np.array(values)[:, None]
    there = huber_mean(column * scale + shift)
    here = huber_mean(column)
    size = float(np.ptp(column)) * scale + abs(shift)
    assert there[0] == pytest.approx(float(here[0]) * scale + shift, abs=1e-3 * size + 1e-9)
    assert column.min() - 1e-9 <= here[0] <= column.max() + 1e-9
