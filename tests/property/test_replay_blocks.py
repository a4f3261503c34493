"""Many reads at once against one after the other: the same samples, counters and state, whatever comes."""

from __future__ import annotations

import itertools
import random
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.calibration.rolling import RollingCollector
from companion.daemon.serial_devices import Role
from companion.protocols.base import Decoder
from companion.protocols.bulk import ImuBlock, crc16_xmodem
from companion.protocols.registry import make_decoder
from companion.protocols.vectornav import VectorNavDecoder
from companion.recording import topics
from companion.recording.state import freeze, to_json
from companion.replay.blocks import SerialShare
from companion.samples import ImuSample, Sample
from tests.support import frames
from tests.support import still_aircraft as still

SEEDS = st.integers(0, 2**32 - 1)
BYTE_S = 10.0 / 921600.0


def stream(rng: random.Random, count: int) -> list[tuple[bytes, float]]:
    """Frames of a VectorNav and when they came, with everything that a field may bring."""
    period_s = rng.choice([1e-3, 2.5e-3, 5e-3, 0.02])
    device_s, host_s = rng.choice([0.5, 12.0, 4000.0]), 1000.0 + rng.random()
    drift = 1.0 + rng.uniform(-2e-4, 2e-4)
    calm = rng.random() < 0.5
    kind = rng.choice(["usual"] * 4 + ["group 3", "no clock", "attitude"])
    found = []
    for _ in range(count):
        device_s += period_s
        host_s += period_s * drift
        data = frame(kind, device_s, rng)
        if not calm and rng.random() < 0.02:
            what = rng.randrange(9)
            if what == 0:  # a byte damaged
                place = rng.randrange(len(data))
                data = data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :]
            elif what == 1:  # bytes missing
                data = data[: rng.randrange(len(data))]
            elif what == 2:
                data = rng.randbytes(rng.randrange(1, 60)) + data
            elif what == 3:
                data = b"$VNYMR,1,2,3*00\r\n" + data
            elif what == 4:  # it restarts
                device_s = rng.random()
            elif what == 5:  # it, or the host, was not there for a while
                host_s += rng.choice([0.02, 0.9, 1.5, 30.0])
                device_s += rng.choice([0.0, 0.5, 30.0])
            elif what == 6:
                data = frames.vectornav_imu(round(device_s * 1e9), gyro=(float("nan"), 0.0, 0.0))
            elif what == 7:
                data = frames.vectornav_imu(round(device_s * 1e9), accel=(0.0, 0.0, 1e5))
            else:
                data = b""
        found.append((data, host_s + rng.expovariate(1e4) * rng.choice([0, 1, 1, 5])))
    return found


def frame(kind: str, device_s: float, rng: random.Random) -> bytes:
    gyro = tuple(rng.gauss(0.0, 1e-3) for _ in range(3))
    accel = (rng.gauss(0.0, 0.01), rng.gauss(0.0, 0.01), rng.gauss(-9.8, 0.01))
    time_ns = round(device_s * 1e9)
    if kind == "group 3":
        return frames.vectornav_binary({3: {2: frames.floats(*accel), 3: frames.floats(*gyro)}})
    if kind == "no clock":
        return frames.vectornav_binary({1: {9: frames.floats(*accel, *gyro)}})
    if kind == "attitude":
        common = {0: time_ns.to_bytes(8, "little"), 3: frames.floats(1.0, 2.0, 3.0)}
        return frames.vectornav_binary({1: {**common, 5: frames.floats(*gyro), 8: frames.floats(*accel)}})
    return frames.vectornav_imu(time_ns, gyro, accel, rng.gauss(25.0, 0.1))


def reads_of(rng: random.Random, came: list[tuple[bytes, float]]) -> list[tuple[bytes | None, float]]:
    """The same bytes as a port hands them over: in pieces, in heaps, some lost, with the port opened again."""
    size = rng.choice([1, 1, 1, 3, 16])
    every = rng.random() < 0.5
    reads: list[tuple[bytes | None, float]] = []
    waiting, latest_s = b"", -1.0
    for number, (data, t_s) in enumerate(came):
        waiting += data
        latest_s = max(latest_s, t_s)
        if number % size != size - 1 or not waiting:
            continue
        cut = len(waiting) if every else rng.randrange(1, len(waiting) + 1)
        reads.append((waiting[:cut], latest_s))
        waiting = waiting[cut:]
        if rng.random() < 0.003:
            reads.append((None, latest_s))
            waiting = b""
    return reads


def one_by_one(decoder: Decoder, reads: list[tuple[bytes | None, float]]) -> list[list[ImuSample]]:
    """The samples of an IMU that each read gave."""
    found: list[list[ImuSample]] = []
    for data, t_s in reads:
        samples: list[Sample] = []
        if data is None:
            decoder.interrupted()
        else:
            samples = decoder.receive(data, t_s)
        found.append([sample for sample in samples if isinstance(sample, ImuSample)])
    return found


class Taker:
    """Stands where the collector does, and keeps what it is given by the read it came of."""

    def __init__(self) -> None:
        self.samples: list[ImuSample] = []
        self.in_blocks = 0

    def add_block(self, name: str, block: ImuBlock, start: int, stop: int) -> None:
        self.samples += block.samples(start, stop)
        self.in_blocks += stop - start


def in_blocks(decoder: Decoder, reads: list[tuple[bytes | None, float]]) -> tuple[list[list[ImuSample]], int]:
    data = [msgspec.json.encode(topics.RawBytes(t_s, each)) for each, t_s in reads]
    imu = SerialShare(Role("own", "imu"), "own", decoder, np.arange(len(reads)), data)
    assert imu.last_place == len(reads) - 1
    found, taker = [], Taker()
    for place in range(len(reads)):
        taker.samples = []
        imu.collect(taker, place)  # type: ignore[arg-type]
        alone = [sample for sample in imu.one_by_one.get(place, []) if isinstance(sample, ImuSample)]
        assert not (taker.samples and alone)
        found.append(taker.samples + alone)
    return found, taker.in_blocks


def knows(decoder: Decoder) -> Any:
    """Its whole state, but for what it remembers to save work."""
    return to_json(freeze(decoder))


@settings(deadline=None, max_examples=30)
@given(SEEDS, st.sampled_from([0.0, BYTE_S]))
def test_blocks_give_what_reads_give(seed: int, byte_s: float) -> None:
    rng = random.Random(seed)
    reads = reads_of(rng, stream(rng, rng.choice([20, 150, 400])))
    one, other = VectorNavDecoder(byte_s), VectorNavDecoder(byte_s)
    start = 0
    while start < len(reads):
        stop = start + rng.choice([1, 40, 500])
        before = one_by_one(one, reads[start:stop])
        after, _ = in_blocks(other, reads[start:stop])
        assert after == before
        assert knows(one) == knows(other)
        start = stop


@pytest.mark.parametrize("byte_s", [0.0, BYTE_S])
def test_a_regular_stream_is_taken_in_blocks(byte_s: float) -> None:
    """Otherwise the test above would say nothing of them."""
    rng = random.Random(1)
    came = [(frame("usual", 5.0 + 1e-3 * k, rng), 1000.0 + 1e-3 * k + rng.expovariate(1e4)) for k in range(1000)]
    came.sort(key=lambda each: each[1])
    came = [(data, t_s) for (data, _), t_s in zip(came, sorted(t_s for _, t_s in came), strict=True)]
    decoder = VectorNavDecoder(byte_s)
    samples, blocks = in_blocks(decoder, list(came))
    assert sum(map(len, samples)) == 1000
    assert blocks > 950


def test_a_damaged_frame_costs_its_neighbours_only() -> None:
    rng = random.Random(2)
    reads: list[tuple[bytes | None, float]] = [
        (frame("usual", 5.0 + 1e-3 * k, rng), 1000.0 + 1e-3 * k) for k in range(2000)
    ]
    damaged, t_s = reads[1234]
    assert damaged is not None
    reads[1234] = (damaged[:20] + b"\x00" + damaged[21:], t_s)
    decoder = VectorNavDecoder()
    samples, blocks = in_blocks(decoder, reads)
    assert sum(map(len, samples)) == 1999
    assert decoder.rejected["checksum"] == 1
    assert 1999 - blocks < 200


def test_a_decoder_without_a_quicker_way_takes_nothing() -> None:
    decoder = make_decoder("imu", "imu_line", BYTE_S)
    before = knows(decoder)
    assert decoder.receive_many([frames.imu_line(1, 2)] * 100, [1.0] * 100) is None
    assert knows(decoder) == before


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 90), SEEDS)
def test_the_checksums_of_a_table_are_those_of_its_rows(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.integers(0, 256, (5, size), dtype=np.uint8)
    assert crc16_xmodem(table).tolist() == [frames.crc16_xmodem(row.tobytes()) for row in table]


# --- the collector


def blocks_of(rng: random.Random, seconds: float) -> list[ImuBlock]:
    """A still IMU with knocks, holes, repeated stamps, a clock that goes back, and readings that cannot be."""
    rate_hz = rng.choice([3.0, 50.0, 200.0, 5000.0])
    seconds = min(seconds, 20000.0 / rate_hz)
    count = int(seconds * rate_hz)
    numbers = np.random.default_rng(rng.randrange(2**32))
    t_s = 1000.3 + np.arange(count) / rate_hz + numbers.uniform(0.0, 0.3 / rate_hz, count)
    rows = still.noise(numbers, count)
    if rng.random() < 0.5:
        start = rng.uniform(0.0, seconds)
        rows[(t_s > 1000.3 + start) & (t_s < 1000.3 + start + 1.5), :3] += 0.2
    if rng.random() < 0.3:
        t_s[count // 2 :] += rng.choice([0.7, 3.0, 200.0, -50.0])
    stamps = None if rng.random() < 0.3 else np.arange(count) / rate_hz
    if stamps is not None and rng.random() < 0.3:
        stamps[count // 3 : count // 3 + 3] = stamps[count // 3 - 1 : count // 3]
        stamps[-count // 4 :] += 0.7
    if rng.random() < 0.3:
        rows[numbers.integers(0, count, 3), 2] = [1e9, np.nan, np.inf]
    if rng.random() < 0.3:
        rows = np.trunc(rows / 1e-3) * 1e-3
    if rng.random() < 0.2:  # the end of its range
        rows[:, 1] = np.minimum(rows[:, 1], np.quantile(rows[:, 1], 0.8))
    temperature = None if rng.random() < 0.5 else 25.0 + numbers.normal(0.0, 0.1, count)
    cuts = sorted({0, count, *numbers.integers(0, count, rng.randrange(6)).tolist()})
    made, breaks = [], 0
    for start, stop in itertools.pairwise(cuts):
        part = slice(start, stop)
        # Within a block times never decrease: a clock that went back begins another one.
        back = np.flatnonzero(np.diff(t_s[part]) < 0.0)
        breaks += rng.random() < 0.1
        for begin, end in zip([start, *(back + start + 1)], [*(back + start + 1), stop], strict=True):
            part = slice(int(begin), int(end))
            made.append(
                ImuBlock(
                    t_s[part],
                    rows[part],
                    None if temperature is None else temperature[part],
                    None if stamps is None else stamps[part],
                    breaks,
                    np.arange(part.stop - part.start),
                )
            )
    return made


@settings(deadline=None, max_examples=10)
@given(SEEDS)
def test_a_collector_gets_the_same_from_blocks_as_from_samples(seed: int) -> None:
    rng = random.Random(seed)
    imus = [still.imu("fc"), still.imu("int", gyro_step_rad_s=1e-3, accel_step_m_s2=1e-3, truncates=True)]
    one, other = (RollingCollector(still.settings(), imus, gradienter=False, compass=False) for _ in range(2))
    now_s = 1000.3
    for block in blocks_of(rng, 40.0):
        for name in ("fc", "int", "nobody"):
            middle = rng.randrange(len(block) + 1)
            for start, stop in ((0, middle), (middle, len(block))):
                samples = list(block.samples(start, stop))
                if rng.random() < 0.5:
                    one.add_many(name, samples)
                else:
                    for sample in samples:
                        one.add_imu(name, sample)
                if rng.random() < 0.2:
                    other.add_many(name, samples)  # both ways in one second
                else:
                    other.add_block(name, block, start, stop)
        now_s = float(block.t_s[-1]) if len(block) else now_s
        if rng.random() < 0.5:
            assert one.glance(now_s) == other.glance(now_s)
            assert one.status(now_s) == other.status(now_s)
    for collector in (one, other):
        collector.glance(now_s + 2.0)
    assert to_json(freeze(one)) == to_json(freeze(other))
