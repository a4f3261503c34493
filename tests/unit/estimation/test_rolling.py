"""The rolling collector as its users see it: samples in; a line for people, progress and a window out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.sections import AllanModel, NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.collector import measurement
from companion.estimation.collector.intake import Settings
from companion.estimation.collector.rolling import RollingCollector
from companion.physics.units import DEG, DEG_H
from companion.recording.messages import encode
from companion.samples import ImuSample, TiltSample
from tests.support.still_aircraft import (
    BIAS,
    GYRO_NOISE,
    HEADING,
    RATE_HZ,
    TILT,
    Feeder,
    imu,
    settings,
)

Floats = NDArray[np.float64]

SILENT = settings(target_gyro_sigma_rad_s=1e-9, target_accel_sigma_m_s2=1e-9)
"""Targets that nothing meets."""


def feeder(asked: Settings | None = None, *names: str, gradienter: bool = False, compass: bool = False) -> Feeder:
    names = names or ("fc",)
    collector = RollingCollector(
        asked or settings(),
        [imu(name) for name in names],
        TILT if gradienter else None,
        HEADING if compass else None,
    )
    made = Feeder(collector, names)
    if gradienter:
        made.tilt = lambda _t: (1.25, -0.5)
    if compass:
        made.heading = lambda _t: 12.0
    return made


# ---------------------------------------------------------------------------------------------------------- words


def test_before_and_without_data_the_source_is_named() -> None:
    feed = feeder(gradienter=True, compass=True)
    assert feed.waiting_for() == "no data from imu fc yet"
    feed.tilt = None
    feed.run(3.0)
    assert feed.waiting_for() == "no data from gradienter yet"
    feed.tilt = lambda _t: (1.25, -0.5)
    feed.run(3.0)
    assert feed.waiting_for() == "hold still 8 s more"  # the first second of every stream is a partial one
    feed.tilt = None
    feed.run(3.2)
    assert feed.waiting_for() == "no data from gradienter for 3 s"
    feed.run(1.0)
    assert feed.waiting_for() == "no data from gradienter for 4 s"
    assert feed.still_s() == 0.0


def test_the_countdown_then_nothing_then_the_window() -> None:
    feed = feeder(gradienter=True, compass=True)
    lines = []
    for _ in range(12):
        feed.run(1.0)
        lines.append(feed.waiting_for())
    assert lines[0] == "hold still 10 s"
    assert lines[1:10] == [f"hold still {left} s more" for left in range(9, 0, -1)]
    assert lines[10:] == [None, None]
    window = feed.collector.window(feed.now_s)
    assert window.end_s - window.start_s == pytest.approx(11.0)
    assert window.imus[0].samples == 11 * RATE_HZ
    assert window.imus[0].duration_s == 11.0


# -------------------------------------------------------------------------------------------------------- stretches


def knock(start_s: float, seconds: float, rate: float = 5.0) -> object:
    def change(_name: str, t: Floats, rows: Floats) -> Floats:
        hit = (t >= start_s) & (t < start_s + seconds)
        return np.asarray(rows + (hit * rate * DEG * np.sin(20.0 * t))[:, None] * np.array([1, 1, 1, 0, 0, 0]))

    return change


def test_a_knock_is_left_out_and_said() -> None:
    feed = feeder(SILENT)
    feed.change = knock(1025.0, 3.0)  # type: ignore[assignment]
    feed.run(60.0)
    window = feed.collector.window(feed.now_s).imus[0]
    assert window.duration_s == 56.0
    assert "3 of 59 s were not still and are left out" in window.warnings
    assert np.abs(np.array(window.gyro_rad_s) - BIAS).max() < 4.0 * GYRO_NOISE / math.sqrt(56 * RATE_HZ)


def test_four_bad_seconds_in_a_row_end_the_stretch() -> None:
    feed = feeder(SILENT)
    feed.change = knock(1025.0, 4.0)  # type: ignore[assignment]
    feed.run(60.0)
    # 1029 is the first good second after it; the last whole one is 1059.
    assert feed.collector.window(feed.now_s).start_s == 1029.0


def test_more_than_a_fifth_rejected_ends_the_stretch() -> None:
    feed = feeder(SILENT)
    feed.run(21.0)  # 1001 to 1021 are good
    for second in range(1022, 1041, 2):
        feed.change = knock(float(second), 1.0)  # type: ignore[assignment]
        feed.run(2.0)
        rejected = (second - 1022) // 2 + 1
        total = second - 1000
        if rejected / total <= 0.2:
            assert feed.collector.status(feed.now_s).still_s == total - rejected
        else:
            break
    assert rejected / total > 0.2
    assert feed.collector.status(feed.now_s).still_s < 5.0


def test_the_window_is_at_most_max_s_long_and_memory_is_bounded() -> None:
    feed = feeder(settings(max_s=20.0), gradienter=True)
    feed.run(300.0)
    window = feed.collector.window(feed.now_s)
    assert window.end_s - window.start_s == 20.0
    assert window.end_s == math.floor(feed.now_s)
    status = feed.collector.status(feed.now_s)
    assert status.enough
    assert status.progress == 1.0
    assert status.still_s > 250.0
    for source in feed.collector.sources():
        assert len(source.batches.batches) <= 30


def test_since_takes_only_whole_seconds_after_it() -> None:
    feed = feeder(SILENT)
    feed.run(20.0)
    since = feed.now_s - 0.2  # 1020.3
    feed.run(5.0)
    with pytest.raises(CalibrationRefusedError, match="still for 4 s only, needs 5 s"):
        feed.collector.window(feed.now_s, since_s=since)
    feed.run(2.0)
    window = feed.collector.window(feed.now_s, since_s=since)
    assert (window.start_s, window.end_s) == (1021.0, 1027.0)
    assert window.imus[0].duration_s == 6.0


def test_a_window_since_new_offsets_shows_the_stream_and_no_raw_readings() -> None:
    """Raw readings less the offsets of the parameters would show offsets in use that are not."""
    feed = feeder(SILENT)
    raw_rad_s = 100.0 * DEG_H

    def noisy(_name: str, _t: Floats, rows: Floats) -> Floats:
        return rows + feed.rng.normal(0.0, 0.01, rows.shape)

    feed.change = noisy
    for _ in range(25):
        feed.collector.add_raw("fc", feed.now_s, (raw_rad_s, 0.0, 0.0, 0.0, 0.0, -9.81), None)
        feed.run(1.0)
    since_s = feed.now_s - 15.0
    (whole,) = feed.collector.window(feed.now_s).imus
    (since,) = feed.collector.window(feed.now_s, since_s=since_s).imus
    assert whole.gyro_rad_s[0] == pytest.approx(raw_rad_s)
    assert since.gyro_rad_s[0] == pytest.approx(BIAS[0], abs=4.0 * 0.01 / math.sqrt(15.0 * RATE_HZ))


def test_reset_forgets_one_imu_or_all_and_the_stretch() -> None:
    feed = feeder(SILENT, "fc", "nose")
    feed.run(20.0)
    step = np.array([0.5 * DEG, 0, 0, 0, 0, 0])
    feed.collector.reset("offsets written", "fc")
    feed.change = lambda name, _t, rows: rows - step if name == "fc" else rows
    status = feed.collector.status(feed.now_s)
    assert status.still_s == 0.0
    assert status.waiting_for == "hold still 10 s"
    feed.run(7.0)
    window = feed.collector.window(feed.now_s, since_s=feed.now_s - 7.0)
    assert window.start_s == 1021.0
    fc, nose = window.imus
    assert fc.gyro_rad_s[0] == pytest.approx(BIAS[0] - 0.5 * DEG, abs=0.02 * DEG)
    assert nose.gyro_rad_s[0] == pytest.approx(BIAS[0], abs=0.02 * DEG)


def test_another_stream_is_not_mixed_with_the_old_one() -> None:
    feed = feeder(SILENT)
    feed.run(20.0)
    feed.collector.set_imu(imu("fc", gyro_step_rad_s=1e-3, accel_step_m_s2=1e-3 * 9.80665))
    steps = np.repeat([1e-3, 9.80665e-3], 3)
    feed.change = lambda _name, _t, rows: np.trunc(rows / steps) * steps
    feed.run(12.0)
    window = feed.collector.window(feed.now_s)
    assert window.start_s >= 1021.0
    # The truncation is known and taken out: the naive mean would be half a step, 0.5 mrad/s, off.
    assert np.abs(np.array(window.imus[0].gyro_rad_s) - BIAS).max() < 0.15e-3
    assert min(window.imus[0].gyro_sigma_stat_rad_s) > 0.03e-3
    assert min(window.imus[0].gyro_sigma_use_rad_s) < 0.1e-3


def test_a_dead_compass_can_be_given_up() -> None:
    feed = feeder(None, compass=True)
    feed.run(15.0)
    feed.heading = None
    feed.run(8.0)
    assert feed.waiting_for() == "no data from compass for 8 s"
    feed.collector.expect(gradienter=False, compass=False)
    feed.run(11.0)
    assert feed.waiting_for() is None
    assert feed.collector.window(feed.now_s).heading is None


def test_a_slow_gradienter_need_not_speak_every_second() -> None:
    feed = feeder(None, gradienter=True)
    collector = feed.collector
    feed.tilt = None
    for tick in range(20):
        if tick % 3 != 2:  # every third second is silent
            collector.add_tilt(TiltSample(feed.now_s + 0.1, 1.25, -0.5))
        feed.run(1.0)
    assert collector.status(feed.now_s).waiting_for is None
    tilt = collector.window(feed.now_s).tilt
    assert tilt is not None
    assert tilt.x_deg == pytest.approx(1.25)


def test_no_imu_at_all_still_gives_the_pose() -> None:
    collector = RollingCollector(settings(), [], TILT)
    for tick in range(150):
        collector.add_tilt(TiltSample(10.05 + 0.1 * tick, 1.0, 2.0))
    assert collector.status(25.0).enough
    assert collector.window(25.0).imus == ()


# ------------------------------------------------------------------------------------------------------- dirty input


def test_an_imu_that_pauses_breaks_the_stretch_and_is_named() -> None:
    feed = feeder(None, "fc", "nose")
    feed.run(15.0)
    feed.change = lambda name, _t, rows: None if name == "nose" else rows
    feed.run(2.0)
    assert feed.waiting_for() == "imu nose was silent for a second"
    feed.run(5.0)
    assert feed.waiting_for() == "no data from imu nose for 7 s"


def test_one_clock_back_in_the_middle_of_a_stretch_starts_again() -> None:
    feed = feeder(None, "fc", "nose")
    feed.run(20.0)
    start_s = feed.now_s
    for index in range(40):
        t_s = start_s + index / RATE_HZ
        for name, at in (("fc", t_s), ("nose", t_s - 500.0)):
            feed.collector.add_imu(name, ImuSample(at, (0.001 * index, 0.0, 0.0), (0.0, 0.0, -9.8)))
    assert feed.collector.status(start_s + 0.8).still_s == 0.0
    with pytest.raises(CalibrationRefusedError):
        feed.collector.window(start_s + 0.8)


def test_an_imu_that_joins_late_starts_the_stretch_again() -> None:
    feed = feeder()
    feed.run(20.0)
    feed.collector.set_imu(imu("nose"))
    assert feed.waiting_for() == "no data from imu nose yet"
    feed.names = ("fc", "nose")
    feed.run(12.0)
    window = feed.collector.window(feed.now_s)
    assert [found.name for found in window.imus] == ["fc", "nose"]
    assert window.start_s == 1021.0


def test_other_targets_count_from_the_next_look_on() -> None:
    feed = feeder(SILENT)
    feed.run(12.0)
    before = feed.collector.status(feed.now_s)
    feed.collector.retarget(settings(target_gyro_sigma_rad_s=1.0, target_accel_sigma_m_s2=1.0))
    after = feed.collector.status(feed.now_s)
    assert (before.enough, after.enough) == (False, True)
    assert after.still_s == before.still_s


def test_lost_samples_are_said_without_a_counter_too() -> None:
    feed = feeder(SILENT)
    feed.run(12.0)
    feed.rate_hz = RATE_HZ // 2
    feed.run(4.0)
    # Fourteen whole seconds at 50 Hz would be 750 samples; 3.5 of them came at half the rate.
    warning = next(line for line in feed.collector.window(feed.now_s).imus[0].warnings if "lost" in line)
    assert warning == "imu fc lost 12% of its samples"


@pytest.mark.parametrize(("part", "axis"), [("gyro", 1), ("accel", 2)])
def test_one_dead_axis_of_a_float_stream_is_refused(part: str, axis: int) -> None:
    feed = feeder()
    column = axis + (3 if part == "accel" else 0)

    def dead(_name: str, _t: Floats, rows: Floats) -> Floats:
        rows[:, column] = -9.8 if column == 5 else 0.001
        return rows

    feed.change = dead
    feed.run(15.0)
    line = f"{part} fc is stuck: axis {'xyz'[axis]} did not change in 14 s"
    assert feed.waiting_for() == line
    with pytest.raises(CalibrationRefusedError, match=line):
        feed.collector.window(feed.now_s)


# --------------------------------------------------------------------------------------------------- stop, progress


def test_never_before_min_still_and_always_at_max() -> None:
    easy = feeder(settings(target_gyro_sigma_rad_s=1.0, target_accel_sigma_m_s2=1.0))
    hard = feeder(settings(target_gyro_sigma_rad_s=1e-12, target_accel_sigma_m_s2=1e-12, max_s=40.0))
    # White noise without any floor: neither rule of the stop rule is ever met.
    model = AllanModel(100.0 * DEG_H, 1e-12, 1e-15)
    hard.collector.set_imu(imu("fc", NoiseProfile("white", model, model)))
    done = {}
    for feed in (easy, hard):
        for second in range(1, 60):
            feed.run(1.0)
            if feed.collector.status(feed.now_s).enough:
                done[feed] = second
                break
    assert done[easy] == 11  # ten whole seconds after half a second's start
    assert done[hard] == 41


def test_progress_grows_and_reaches_one_only_when_enough() -> None:
    feed = feeder(settings(max_s=40.0, target_gyro_sigma_rad_s=1e-12), gradienter=True)
    model = AllanModel(100.0 * DEG_H, 1e-12, 1e-15)
    feed.collector.set_imu(imu("fc", NoiseProfile("white", model, AllanModel(1e-9, 1.0, 1e-9))))
    seen = []
    for _ in range(42):
        feed.run(1.0)
        status = feed.collector.status(feed.now_s)
        seen.append(status.progress)
        assert (status.progress == 1.0) == status.enough
    assert seen == sorted(seen)
    # The end is known to be at 40 s, so half of it is half of the bar.
    assert seen[20] == pytest.approx(0.5, abs=0.03)
    assert seen[-1] == 1.0
    feed.collector.reset("armed")
    assert feed.collector.status(feed.now_s).progress == 0.0


def test_what_nobody_asked_for_is_not_waited_for() -> None:
    feed = feeder(settings(target_accel_sigma_m_s2=math.inf, target_gyro_sigma_rad_s=1.0))
    feed.run(11.0)
    assert feed.collector.status(feed.now_s).enough


# -------------------------------------------------------------------------------------- worked out somewhere else


def test_an_estimate_worked_out_elsewhere_is_the_window_that_would_have_been(monkeypatch: pytest.MonkeyPatch) -> None:
    feeds = feeder(SILENT), feeder(SILENT)
    for feed in feeds:
        feed.run(20.0)
    here, there = feeds
    expected = here.collector.window(here.now_s)
    work = there.collector.pending(there.now_s)
    assert work is not None
    found = work.run()
    there.collector.accept(work, found)
    assert there.collector.pending(there.now_s) is None
    monkeypatch.setattr(measurement, "imu_window", lambda *_, **__: pytest.fail("worked out on the spot"))
    assert encode(there.collector.window(there.now_s)) == encode(expected)
    assert there.collector.status(there.now_s).waiting_for is None


def test_while_the_next_estimate_is_worked_out_the_status_gives_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    feed = feeder(SILENT)
    feed.run(20.0)
    before = feed.collector.status(feed.now_s).progress
    monkeypatch.setattr(measurement, "imu_window", lambda *_, **__: pytest.fail("worked out on the spot"))
    feed.run(1.0)
    assert feed.collector.pending(feed.now_s) is not None
    assert before <= feed.collector.status(feed.now_s).progress < 1.0


def test_an_estimate_of_a_stretch_that_has_ended_meanwhile_is_left() -> None:
    feed = feeder(SILENT)
    feed.run(40.0)
    work = feed.collector.pending(feed.now_s)
    assert work is not None
    # Every clock goes back: the seconds of the new stretch have smaller numbers than those of the old one.
    feed.now_s = 5.0
    feed.collector.tick(feed.now_s)
    feed.run(20.0)
    feed.collector.accept(work, work.run())
    window = feed.collector.window(feed.now_s)
    assert window.imus[0].duration_s == window.end_s - window.start_s < 20.0
