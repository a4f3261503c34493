"""Serial IMUs from bytes to seconds: bunched reads, lost and repeated samples, restarts, clocks that jump."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
import pytest

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import SourceStatus
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.seconds.batch import Batch
from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.samples import ImuSample
from tests.support.frames import imu_line
from tests.support.serial_reads import RATE_HZ, Floats, Reads, reads
from tests.support.still_aircraft import imu, settings

OLD: Final = (0.001, -0.002, 0.003)
NEW: Final = (0.004, -0.002, 0.003)
"""A bias after the next power-up, well below what any gate on movement sees."""


def lines(stream: Reads, gyro: Sequence[tuple[float, ...]], first: int = 65000, seed: int = 3) -> list[bytes]:
    """A sample a line, with noise; the counter and the 32-bit microseconds wrap on the way."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 0.0005, (len(gyro), 3)), rng.normal(0.0, 0.02, (len(gyro), 3))
    made = []
    for k, rates in enumerate(gyro):
        t_us = round(stream.device_s[k] * 1e6) % 2**32
        turned = tuple(np.add(rates, noise[0][k]).tolist())
        made.append(imu_line((first + k) % 65536, t_us, turned, tuple((noise[1][k] + (0.1, -0.2, -9.79)).tolist())))
    return made


class Fed:
    """A collector that has been given the reads of one serial IMU."""

    def __init__(self) -> None:
        self.decoder = ImuLineDecoder()
        self.collector = RollingCollector(settings(min_still_s=5.0, max_s=30.0), [imu("own")])
        self.now_s = 0.0
        self.waits: list[str] = []

    def feed(self, arrivals: Floats, data: Iterable[bytes]) -> None:
        """One read for all that arrives at once."""
        together: dict[float, bytes] = {}
        for arrival_s, each in zip(arrivals.tolist(), data, strict=True):
            together[arrival_s] = together.get(arrival_s, b"") + each
        for arrival_s, bunch in together.items():
            for sample in self.decoder.receive(bunch, arrival_s):
                assert isinstance(sample, ImuSample)
                self.collector.add_imu("own", sample)
            self.now_s = arrival_s
            self.collector.tick(arrival_s)

    @property
    def source(self) -> SourceStatus:
        return self.collector.status(self.now_s).sources[0]

    @property
    def batches(self) -> list[Batch]:
        return list(self.collector.imus["own"].batches.batches.values())


def still(stream: Reads) -> list[tuple[float, ...]]:
    return [OLD] * len(stream.taken_s)


# --- bunches


def test_a_host_that_stalls_for_60_ms_loses_nothing_and_moves_no_sample_to_another_second() -> None:
    stream = reads(timer_s=0.016, skew_ppm=80.0, seconds=60.0, stalls=40)
    fed = Fed()
    fed.feed(stream.arrival_s, lines(stream, still(stream)))
    truth = np.bincount(np.floor(stream.taken_s + 0.002).astype(int))
    for batch in fed.batches[1:]:
        assert abs(batch.n - truth[batch.slot]) <= 1
        assert batch.largest_gap_s < 0.010
    assert (fed.source.dropped, fed.source.lost) == ({}, 0)


# --- counters


# --- restarts and jumps


def biases(fed: Fed) -> set[float]:
    """Biases found in the kept seconds, by the lowest and highest x rate of each second."""
    found = set()
    for batch in fed.batches:
        low, high = batch.low[0], batch.high[0]
        assert high - low < 0.006, "two biases in one second"
        found.add(NEW[0] if low + high > OLD[0] + NEW[0] else OLD[0])
    return found


@pytest.mark.parametrize("off_s", [0.0, 0.2, 3.0, 100.0])
@pytest.mark.parametrize("up_s", [2.0, 500.0, 4290.0])
def test_a_device_that_restarts_begins_anew_and_nothing_old_is_averaged(off_s: float, up_s: float) -> None:
    before = reads(timer_s=0.016, skew_ppm=80.0, seconds=12.3, device_since_s=up_s, stalls=2)
    since_s = before.taken_s[-1] + 0.005 + off_s
    after = reads(timer_s=0.016, skew_ppm=80.0, seconds=12.0, since_s=since_s, device_since_s=1.0, stalls=2, seed=1)
    fed = Fed()
    fed.feed(before.arrival_s, lines(before, still(before)))
    assert fed.collector.window(fed.now_s).imus[0].samples > 1000
    at = len(after.taken_s) // 12
    new = lines(after, [NEW] * len(after.taken_s), first=0)
    fed.feed(after.arrival_s[:at], new[:at])
    with pytest.raises(CalibrationRefusedError):
        fed.collector.window(fed.now_s)
    fed.feed(after.arrival_s[at:], new[at:])
    assert fed.decoder.times.clock.breaks == 1
    assert biases(fed) == {NEW[0]}
    window = fed.collector.window(fed.now_s)
    assert window.imus[0].gyro_rad_s[0] == pytest.approx(NEW[0], abs=2e-4)
    assert fed.source.lost == 0


@pytest.mark.parametrize("jump_s", [-3600.0, -5.0, -0.02, 0.02, 0.7, 5.0, 3600.0])
def test_a_clock_that_jumps_costs_a_measurement_at_most(jump_s: float) -> None:
    stream = reads(timer_s=0.016, skew_ppm=80.0, seconds=30.0, device_since_s=4000.0)
    jumped = Reads(stream.taken_s, stream.device_s + jump_s * (stream.taken_s > 110.0), stream.arrival_s)
    fed = Fed()
    fed.feed(jumped.arrival_s, lines(jumped, still(jumped)))
    assert fed.collector.window(fed.now_s).imus[0].samples > 15 * RATE_HZ
    assert sum(fed.source.dropped.values()) == 0
    assert fed.decoder.times.dropped.total() == 0
    later = [batch for batch in fed.batches if batch.slot > 112]
    assert len(later) >= 16
    assert all(abs(batch.n - RATE_HZ) <= 1 and batch.largest_gap_s < 0.010 for batch in later)
