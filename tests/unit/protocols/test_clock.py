"""Device clocks mapped to the host's: against the times at which samples were really taken."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.protocols.decoding.clock import LATE, LATE_S, SPAN_S, DeviceClock, SampleTimes
from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder
from companion.samples import ImuSample, MagSample, TiltSample
from tests.support.frames import imu_line
from tests.support.serial_reads import RATE_HZ, Reads, reads

Floats = NDArray[np.float64]


def mapped(stream: Reads, wraps_s: float | None = None) -> tuple[Floats, DeviceClock]:
    """Times that a clock gives to a stream; NaN where it gives none."""
    clock = DeviceClock(wraps_s)
    pairs = zip(stream.device_s.tolist(), stream.arrival_s.tolist(), strict=True)
    found = [clock.host_s(device_s, arrival_s) for device_s, arrival_s in pairs]
    return np.array([math.nan if t_s is None else t_s for t_s in found]), clock


def deviation_ms(stream: Reads, after_s: float = 10.0) -> Floats:
    """Deviation of the mapped times from the truth and their common delay, which one end cannot see."""
    times, clock = mapped(stream)
    assert clock.breaks == 0
    late = ((times - stream.taken_s) * 1e3)[stream.taken_s > stream.taken_s[0] + after_s]
    return np.asarray(late - np.median(late))


# --- the reference's table: 200 Hz, 80 ppm, 1.5 ms at least, exponential jitter of 0.4 ms, 12 stalls of 60 ms in 120 s


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("skew_ppm", [80.0, -80.0])
@pytest.mark.parametrize(("timer_s", "worst_ms"), [(0.016, 0.12), (0.001, 0.03)])
def test_the_running_minimum_is_as_good_as_documented(
    timer_s: float, worst_ms: float, skew_ppm: float, seed: int
) -> None:
    stream = reads(timer_s=timer_s, skew_ppm=skew_ppm, seed=seed)
    arrival_ms = (stream.arrival_s - stream.taken_s) * 1e3
    assert arrival_ms.max() > 40.0  # the stalls are there
    deviations = deviation_ms(stream)
    assert np.abs(deviations).max() <= worst_ms
    assert deviations.std() <= 0.02
    times, _ = mapped(stream)
    late = times - stream.taken_s
    assert 0.0015 - 1e-9 < np.median(late) < 0.0025
    assert (times <= stream.arrival_s).all()
    assert (np.diff(times) > -1e-9).all()


@pytest.mark.parametrize("skew_ppm", [80.0, -80.0])
def test_polls_that_slide_past_the_samples_cost_less_than_a_millisecond(skew_ppm: float) -> None:
    """With the sensor's rate itself off, the least delay of one second is that of the next only to a millisecond."""
    stream = reads(timer_s=0.016, skew_ppm=skew_ppm, sliding=True)
    assert np.abs(deviation_ms(stream)).max() < 1.0


def test_a_ceramic_resonator_is_followed_within_milliseconds() -> None:
    for skew_ppm in (5000.0, -5000.0):
        stream = reads(timer_s=0.001, skew_ppm=skew_ppm)
        times, clock = mapped(stream)
        late = times - stream.taken_s
        assert np.abs(late[stream.taken_s > stream.taken_s[0] + 5.0]).max() < 0.025
        assert clock.breaks == 0


# --- wraps


@pytest.mark.parametrize("wraps_s", [2**32 / 1e6, 2**32 / 1e4, 65.536])
@pytest.mark.parametrize("silence_s", [0.0, 5.0])
def test_a_wrap_is_no_restart(wraps_s: float, silence_s: float) -> None:
    stream = reads(timer_s=0.016, skew_ppm=80.0, seconds=40.0)
    plain, _ = mapped(stream)
    device_s = np.mod(stream.device_s + wraps_s - stream.device_s[0] - 20.0, wraps_s)
    assert (np.diff(device_s) < 0).sum() == 1
    kept = np.abs(stream.taken_s - stream.taken_s[0] - 20.0) >= silence_s / 2
    times, clock = mapped(Reads(stream.taken_s[kept], device_s[kept], stream.arrival_s[kept]), wraps_s)
    assert clock.breaks == 0
    assert times == pytest.approx(plain[kept], abs=0.001)
    assert clock.device_s == pytest.approx(device_s[0] + 40.0, abs=0.1)  # unwrapped


# --- jumps


@pytest.mark.parametrize("jump_s", [-1e9, -100.0, -1.0, -0.1, -0.01, 0.05, 0.9, 1.5, 100.0, 1e9, 1e300])
def test_a_clock_that_jumps_loses_nothing_and_times_stay_right(jump_s: float) -> None:
    stream = reads(timer_s=0.016, skew_ppm=80.0, seconds=40.0, stalls=4)
    jumped = stream.taken_s > stream.taken_s[0] + 20.0
    device_s = stream.device_s + np.where(jumped, jump_s, 0.0)
    times, clock = mapped(Reads(stream.taken_s, device_s, stream.arrival_s))
    assert not np.isnan(times).any()
    late = times - stream.taken_s
    assert late.min() > 0.001
    assert late.max() < 0.080
    settled = stream.taken_s > stream.taken_s[0] + 22.0
    if abs(jump_s) < 1e100:  # beyond that the device's own samples are all equal
        assert late[settled].max() < 0.003
    assert clock.breaks == (jump_s < 0.0 or jump_s > LATE_S)


@pytest.mark.parametrize("silence_s", [3.0, 60.0])
def test_a_device_that_restarted_while_it_was_not_heard_and_has_overtaken_its_old_clock_is_found_out(
    silence_s: float,
) -> None:
    # It had been up for 1 s; then it was off, and when it is heard again it has been up for 2 s.
    before = reads(timer_s=0.001, skew_ppm=0.0, seconds=1.0, stalls=0)
    after = reads(timer_s=0.001, skew_ppm=0.0, seconds=10.0, stalls=0, seed=2)
    stream = Reads(
        np.concatenate([before.taken_s, after.taken_s + 1.0 + silence_s]),
        np.concatenate([before.device_s - before.device_s[0], after.device_s - after.device_s[0] + 2.0]),
        np.concatenate([before.arrival_s, after.arrival_s + 1.0 + silence_s]),
    )
    times, clock = mapped(stream)
    assert clock.breaks == 1
    lost = np.isnan(times)
    late = (times - stream.taken_s)[~lost]
    assert late.min() > 0.001  # no sample is believed to be older than it is
    assert late.max() < 0.080
    assert lost.sum() <= (SPAN_S + 0.02) * RATE_HZ


@pytest.mark.parametrize("stall_s", [0.06, 0.5, 3.0, 20.0])
def test_a_stall_of_the_host_is_no_restart(stall_s: float) -> None:
    stream = reads(timer_s=0.001, skew_ppm=80.0, seconds=60.0, stalls=0)
    since_s = stream.taken_s[0] + 20.0
    waiting = (stream.arrival_s > since_s) & (stream.arrival_s < since_s + stall_s)
    times, clock = mapped(
        Reads(stream.taken_s, stream.device_s, np.where(waiting, since_s + stall_s, stream.arrival_s))
    )
    assert clock.breaks == 0
    lost = np.isnan(times)
    assert lost.sum() == pytest.approx(max(stall_s - LATE_S, 0.0) * RATE_HZ, abs=2)
    # Meanwhile the minimum creeps.
    assert (times - stream.taken_s)[~lost][400:].max() < 0.003 + 200e-6 * stall_s


def test_a_suspended_host_whose_clock_stood_still() -> None:
    stream = reads(timer_s=0.001, skew_ppm=80.0, seconds=60.0, stalls=0)
    asleep = stream.taken_s > stream.taken_s[0] + 20.0
    slept_s = 3600.0
    awake = Reads(stream.taken_s, stream.device_s + np.where(asleep, slept_s, 0.0), stream.arrival_s)
    times, clock = mapped(awake)
    assert clock.breaks == 1
    assert np.abs(times - stream.taken_s).max() < 0.080


@pytest.mark.parametrize("seed", range(20))
def test_nothing_whatever_makes_it_raise_or_run_ahead(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arrival_s = np.cumsum(rng.exponential(0.01, 3000))
    kinds = np.array([0.0, 1e-3, 0.5, 5.0, 71.0, 1e6, 1e300, -1e300, math.nan, math.inf, -math.inf])
    device_s = arrival_s + rng.choice(kinds, 3000, p=[0.9, *[0.01] * 10])
    decoder_times = SampleTimes(2**32 / 1e6, 256)
    newest_s = -math.inf
    for k in range(3000):
        sample = imu(float(arrival_s[k]), float(device_s[k]), int(rng.integers(0, 300)))
        for placed in decoder_times.place([sample], float(arrival_s[k]), 0.001):
            assert newest_s <= placed.t_s <= arrival_s[k]
            newest_s = placed.t_s


# --- samples of one device


def imu(t_s: float, t_device_s: float | None = None, sequence: int | None = None) -> ImuSample:
    return ImuSample(t_s, (0.0, 0.0, 0.0), (0.0, 0.0, -9.8), None, sequence, t_device_s)


def test_a_counter_is_unwrapped_and_one_that_goes_back_loses_nothing() -> None:
    times = SampleTimes(None, 256)
    raw = [254, 255, 0, 1, 4, 4, 3, 5]
    placed = times.place([imu(float(k), None, one) for k, one in enumerate(raw)], 10.0)
    counted = [sample.sequence for sample in placed if isinstance(sample, ImuSample)]
    assert counted == [254, 255, 256, 257, 260, 260, 261, 263]


def test_a_restart_is_told_with_the_first_sample_after_it() -> None:
    times = SampleTimes(None, 2**16)
    samples = [imu(100.0 + k, 50.0 + k, 500 + k) for k in range(5)] + [imu(106.0 + k, 1.0 + k, k) for k in range(5)]
    placed = times.place(list(samples), 120.0)
    assert [sample.breaks for sample in placed if isinstance(sample, ImuSample)] == [0] * 5 + [1] * 5
    # The counter began again with the device: nothing is lost for it.
    counted = [sample.sequence for sample in placed if isinstance(sample, ImuSample)]
    assert np.diff([one for one in counted if one is not None]).tolist() == [1] * 9
    assert times.clock.breaks == 1
    assert not times.dropped


def test_what_else_a_frame_brings_has_the_same_time() -> None:
    times = SampleTimes()
    times.place([imu(100.0, 5.0)], 100.0)
    first, second = times.place([imu(101.05, 6.0), MagSample(101.05, (1.0, 2.0, 3.0))], 101.05)
    assert first.t_s == second.t_s == pytest.approx(101.0, abs=0.001)


# --- the line


def test_a_sample_was_taken_before_its_first_byte() -> None:
    line = imu_line(1, 5000)
    decoder = ImuLineDecoder(1e-4)
    (sample,) = decoder.receive(line + b"$IMU,2,", 10.0)
    assert sample.t_s == pytest.approx(10.0 - 1e-4 * (len(line) + 7))
    pair = b"X=+00.430\r\nY=-00.084\r\n"
    gradienter = InclinometerXyDecoder(1e-3)
    assert gradienter.receive(pair[:7], 9.99) == []
    (tilt,) = gradienter.receive(pair[7:] + b"X=", 10.0)
    assert isinstance(tilt, TiltSample)
    assert tilt.t_s == pytest.approx(10.0 - 1e-3 * (22 + 2))


def test_a_baud_rate_that_means_nothing_is_found_out() -> None:
    """USB without a UART: bytes come faster than the configured line could carry them, and all at once."""
    decoder = ImuLineDecoder(10 / 9600)
    last: list[float] = []
    for k in range(200):
        t_s = 100.0 + 0.005 * (k + 1)
        last = [sample.t_s for sample in decoder.receive(imu_line(k, 5000 * k), t_s)]
    assert decoder.seconds_per_byte == 0.0
    assert last == pytest.approx([101.0], abs=0.001)


@pytest.mark.parametrize("stall_s", [0.0, 2.0])
def test_a_full_line_is_none_of_that_even_after_a_stall(stall_s: float) -> None:
    spb = 10 / 115200
    decoder = ImuLineDecoder(spb)
    lines = [imu_line(k, 5000 * k) for k in range(4000)]
    data = b"".join(lines)
    ends_s = 100.0 + np.cumsum([len(line) for line in lines]) * spb
    at, t_s = 0, 100.0
    while at < len(data):
        t_s += 0.016 if not 102.0 < t_s < 102.02 else stall_s + 0.016
        upto = min(int((t_s - 100.0) / spb), len(data))
        for sample in decoder.receive(data[at:upto], t_s):
            assert isinstance(sample, ImuSample)
            assert sample.sequence is not None
        at = upto
    assert decoder.seconds_per_byte == spb
    assert ends_s[-1] < t_s + 0.001


def test_late_samples_are_counted() -> None:
    times = SampleTimes()
    for k in range(100):
        times.place([imu(100.0 + 0.1 * k, 0.1 * k)], 100.0 + 0.1 * k)
    assert times.place([imu(114.0, 10.0)], 114.0) == []
    assert times.dropped == {LATE: 1}


def test_times_of_pose_sensors_do_not_go_back() -> None:
    decoder = InclinometerXyDecoder(10 / 2400)
    pair = b"X=+00.430\r\nY=-00.084\r\n"
    times = []
    for k in range(30):
        times += [sample.t_s for sample in decoder.receive(pair * (5 if k == 20 else 1), 100.0 + 0.1 * k)]
    assert all(a <= b for a, b in pairwise(times))
