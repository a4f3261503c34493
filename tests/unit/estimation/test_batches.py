"""Batches: what a second of samples is summed up to, and what is dropped by which name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from companion.estimation.means.windows import lost
from companion.estimation.seconds.batch import Batch, BatchSource


def fill(source: BatchSource, rows: list[tuple[float, ...]], start_s: float, rate_hz: float, **more: Any) -> None:
    for index, row in enumerate(rows):
        source.add(start_s + (index + 0.5) / rate_hz, row, **more)


def one(rows: list[tuple[float, ...]], limits: tuple[float, ...] = (1e3,), **more: Any) -> Batch:
    """The batch that one second of rows becomes, after a partial second."""
    source = BatchSource(limits, 10)
    source.add(99.9, rows[0])
    fill(source, rows, 100.0, len(rows), **more)
    source.close_before(101.0)
    return source.batches[100]


def test_a_second_is_summed_up() -> None:
    batch = one([(1.0, 5.0), (2.0, 5.0), (4.0, 5.0), (1.0, 6.0)], (1e3, 1e3), temperature_degc=21.5)
    assert batch.n == 4
    assert batch.mean == pytest.approx([2.0, 5.25])
    assert batch.variance == pytest.approx([2.0, 0.25])
    # Successive differences 1, 2, -3: half of 14 / 3.
    assert batch.white == pytest.approx([14.0 / 6.0, 1.0 / 6.0])
    assert batch.low == pytest.approx([1.0, 5.0])
    assert batch.high == pytest.approx([4.0, 6.0])
    assert batch.distinct.tolist() == [3, 2]
    assert batch.largest_gap_s == pytest.approx(0.25)
    assert batch.temperature_degc == 21.5
    assert not batch.clipped


def test_white_noise_is_white_and_slow_motion_is_not() -> None:
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 1.0, 1000)
    slow = 3.0 * np.sin(2.0 * math.pi * 2.0 * np.arange(1000) / 1000.0)
    assert float(one([(x,) for x in noise]).white[0]) == pytest.approx(1.0, rel=0.1)
    moving = one([(x,) for x in noise + slow])
    assert float(moving.white[0]) == pytest.approx(1.0, rel=0.1)
    assert float(moving.variance[0]) == pytest.approx(5.5, rel=0.1)


def test_the_first_partial_second_is_not_a_batch() -> None:
    source = BatchSource((1e3,), 10)
    fill(source, [(1.0,)] * 40, 10.6, 100.0)
    fill(source, [(1.0,)] * 100, 11.0, 100.0)
    source.close_before(12.0)
    assert list(source.batches) == [11]
    assert source.closed_through == 11


def test_late_samples_are_counted_and_dropped() -> None:
    source = BatchSource((1e3,), 5)
    fill(source, [(1.0,)] * 10, 1.0, 10.0)
    fill(source, [(1.0,)] * 10, 2.0, 10.0)
    source.add(2.4, (99.0,))
    source.add(1.4, (99.0,))
    source.close_before(3.0)
    assert source.dropped["late or out of order"] == 2
    assert source.batches[2].n == 10
    assert source.batches[2].mean == pytest.approx([1.0])


def test_impossible_values_are_counted() -> None:
    batch = one([(1.0,), (math.nan,), (1.0,), (math.inf,), (2e3,), (1.5,)])
    assert batch.n == 3
    assert batch.high == pytest.approx([1.5])


def test_one_sample_from_the_future_does_not_lock_the_stream() -> None:
    source = BatchSource((1e3,), 50)
    fill(source, [(1.0,)] * 30, 0.0, 10.0)
    source.add(1e9, (1.0,))
    fill(source, [(1.0,)] * 100, 3.0, 10.0)
    source.close_before(13.0)
    assert 12 in source.batches


def test_repeated_packets_are_dropped_and_equal_readings_are_not() -> None:
    source = BatchSource((1e3,), 5)
    source.add(0.9, (0.0,), None, 0.0)
    for index in range(10):
        # Every packet over two routes; the counter is eight bits and wraps.
        for lag in (0.0, 0.01):
            source.add(1.0 + 0.09 * index + lag, (float(index % 3),), None, float((250 + index) % 256))
    for index in range(10):
        source.add(2.0 + 0.09 * index, (7.0,), None, float(index))
    source.close_before(3.0)
    assert source.batches[1].n == 10
    assert source.dropped["repeated"] == 10
    assert source.batches[2].n == 10


def test_missing_samples_by_counter() -> None:
    source = BatchSource((1e3,), 5)
    source.add(0.9, (0.0,), None, 0.0)
    counters = [250, 252, 254, 2, 4, 10, 12, 14, 20]  # steps of two, a wrap, two and two missing
    for index, counter in enumerate(counters):
        source.add(1.0 + 0.1 * index, (float(index),), None, float(counter))
    source.close_before(2.0)
    assert source.batches[1].missing == 4


@pytest.mark.parametrize("rate_hz", [100.0, 70.0, 60.0])
def test_a_sender_that_picks_from_a_faster_sensor_has_lost_nothing(rate_hz: float) -> None:
    """PX4: its IMU is there every 4 ms; a turn of the sender's loop takes 1 to 5 ms, and sends what is due."""
    rng = np.random.default_rng(0)
    turns_s = np.cumsum(rng.uniform(0.001, 0.005, 8000))
    source, due_s, newest_s = BatchSource((1e3,), 30), 0.0, 0.0
    steps_ms = set()
    for turn_s in turns_s[turns_s < 20.0]:
        stamp_s = math.floor(turn_s / 0.004) * 0.004
        if turn_s >= due_s and stamp_s > newest_s:
            steps_ms.add(round((stamp_s - newest_s) * 1e3))
            source.add(float(turn_s), (rng.normal(),), None, stamp_s)
            due_s, newest_s = max(due_s + 1.0 / rate_hz, turn_s - 1.0 / rate_hz), stamp_s
    assert len(steps_ms) >= 3
    assert source.lost == 0
    assert lost(list(source.batches.values())) < 0.01


@pytest.mark.parametrize(("first_s", "gap_s"), [(1.7, 0.7), (1.1, 0.72), (1.3, 0.52)])
def test_gaps_reach_to_the_ends_of_the_second(first_s: float, gap_s: float) -> None:
    source = BatchSource((1e3,), 5)
    source.add(0.9, (0.0,))
    for index in range(10):
        source.add(first_s + 0.02 * index, (1.0,))
    source.close_before(2.0)
    assert source.batches[1].largest_gap_s == pytest.approx(gap_s)


def test_a_pile_at_the_end_of_the_range_is_clipping() -> None:
    rng = np.random.default_rng(2)
    vibrating = rng.normal(0.0, 10.0, 200)
    assert one([(x,) for x in np.clip(vibrating, -1e9, 16.0)]).clipped
    assert one([(x,) for x in np.clip(vibrating, -16.0, 1e9)]).clipped
    assert not one([(x,) for x in vibrating]).clipped
    # Quantised noise at rest has many equal readings, but not at its ends.
    assert not one([(x,) for x in np.round(rng.normal(0.0, 3.0, 400))]).clipped
    assert not one([(x,) for x in np.round(rng.normal(0.3, 0.3, 400))]).clipped


def test_few_integers_a_second_are_hardly_ever_taken_for_clipping() -> None:
    # A gate that shuts once in a minute for no reason is switched off by its pilot.
    rng = np.random.default_rng(5)
    seconds = np.trunc(rng.normal(rng.uniform(-3.0, 3.0, (3000, 1)), 2.0, (3000, 50)))
    assert sum(one([(x,) for x in second]).clipped for second in seconds) <= 1


def test_headings_are_averaged_over_north() -> None:
    source = BatchSource((1e3,), 5, circle=True)
    source.add(0.9, (0.0,))
    for index, heading in enumerate((359.0, 1.0, 358.0, 0.0)):
        source.add(1.1 + 0.2 * index, (heading,))
    source.close_before(2.0)
    assert source.batches[1].mean == pytest.approx([359.5])
    assert source.batches[1].variance == pytest.approx([5.0 / 3.0])


def test_forgetting_leaves_out_the_second_under_way() -> None:
    source = BatchSource((1e3,), 5)
    fill(source, [(1.0,)] * 25, 1.0, 10.0)
    source.forget()
    fill(source, [(2.0,)] * 5, 3.5, 10.0)
    fill(source, [(2.0,)] * 10, 4.0, 10.0)
    source.close_before(5.0)
    assert list(source.batches) == [4]
