"""What is kept second by second: that it is what was fed, in the vehicle's axes, bounded, and readable again."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from companion.estimation.collector import trace as traces
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.collector.trace import MAX_SECONDS, Trace
from tests.support.still_aircraft import HEADING, TILT, Feeder, imu, settings

YAW_90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _feeder() -> Feeder:
    inputs = [imu("fc"), imu("own", rotation=YAW_90)]
    feed = Feeder(RollingCollector(settings(), inputs, TILT, HEADING), ("fc", "own"))
    feed.tilt = lambda _t: (1.25, -0.5)
    feed.heading = lambda _t: 12.0
    return feed


def _trace(feed: Feeder, started_s: float, measured_s: tuple[float, float] | None) -> Trace:
    return feed.collector.snapshot(started_s, measured_s).trace("2026-05-01T10:00:00+00:00")


def test_every_second_of_the_window_has_the_verdict_of_every_source() -> None:
    feed = _feeder()
    feed.run(20.0)
    window = feed.collector.window(feed.now_s)
    trace = _trace(feed, window.end_s - 3.4, (window.start_s, window.end_s))
    assert trace.measured == (trace.second[0], trace.second[-1] + 1)
    assert trace.second[-1] - trace.second[0] + 1 == window.end_s - window.start_s == len(trace.second)
    assert trace.second[-1] == 3  # the window's last second began 2.4 s after the whole second of the request
    assert all(trace.good)
    assert not trace.cut
    assert {(one.kind, one.name) for one in trace.verdicts} == {
        ("imu", "fc"), ("imu", "own"), ("gradienter", "gradienter"), ("compass", "compass"),
    }  # fmt: skip
    assert all(words is None for one in trace.verdicts for words in one.words)


def test_a_movement_is_kept_in_the_words_of_its_gate_although_the_stretch_is_forgotten() -> None:
    feed = _feeder()
    feed.run(12.0)
    feed.change = lambda name, _t, rows: rows + 0.5 * feed.rng.normal(size=(len(rows), 1)) if name == "own" else rows
    feed.run(3.0)
    feed.change = lambda _name, _t, rows: rows
    feed.run(5.0)
    feed.collector.reset("offsets written")
    feed.run(3.0)
    trace = _trace(feed, 1000.5, None)
    fc, own = (next(one for one in trace.verdicts if one.name == name) for name in ("fc", "own"))
    moved = [second for second, words in zip(trace.second, own.words, strict=True) if words]
    # 12 s from 1000.5 end at 1012.5: the seconds 12 (half) to 15 (half) shake, and one may settle.
    assert moved[:3] == [12, 13, 14]
    assert all(fc.words[trace.second.index(second)] is None for second in (12, 13, 14))
    assert any("own" in (words or "") for words in own.words)
    assert trace.measured is None
    assert [good for second, good in zip(trace.second, trace.good, strict=True) if second in (12, 13, 14)] == [
        False
    ] * 3
    assert own.words[0] == ""  # nothing whole yet, nothing to complain about
    assert trace.second[-1] >= 20


def test_it_is_bounded_and_says_what_it_lost() -> None:
    collector = RollingCollector(settings(), [imu("fc")])
    feed = Feeder(collector, rate_hz=5)
    feed.run(MAX_SECONDS + 50.0)
    trace = _trace(feed, 1000.5, None)
    assert len(trace.second) == MAX_SECONDS
    assert trace.cut
    assert not _trace(feed, feed.now_s - 100.0, None).cut
    assert len(traces.to_json(trace)) < 400_000


def test_one_of_the_version_before_is_read_without_its_noise() -> None:
    feed = _feeder()
    feed.run(15.0)
    trace = _trace(feed, 1000.5, (1003.0, 1013.0))
    before = msgspec.json.decode(traces.to_json(trace)) | {"format_version": 1, "imus": [{"name": "fc"}]}
    assert traces.from_json(msgspec.json.encode(before)).good == trace.good


def test_it_comes_back_whole_and_ragged_ones_are_refused() -> None:
    feed = _feeder()
    feed.run(15.0)
    trace = _trace(feed, 1000.5, (1003.0, 1013.0))
    assert traces.from_json(traces.to_json(trace)) == trace
    for broken in (
        msgspec.structs.replace(trace, good=trace.good[1:]),
        msgspec.structs.replace(trace, second=trace.second[::-1]),
    ):
        with pytest.raises(msgspec.ValidationError):
            traces.from_json(traces.to_json(broken))
