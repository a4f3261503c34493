"""Many reads of a gradienter or a compass at once against one after the other, and the collector behind them."""

from __future__ import annotations

import random
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.calibration.pose_models import CompassModel, GradienterModel
from companion.calibration.rolling import RollingCollector
from companion.calibration.settling import Lag
from companion.daemon.serial_devices import Role
from companion.protocols.base import Decoder
from companion.protocols.bulk import ImuBlock, PoseBlock, fixed_point
from companion.protocols.registry import make_decoder
from companion.recording import topics
from companion.recording.collector import RecordedCollector
from companion.recording.journal import Beginning, Queue
from companion.recording.state import freeze, to_json
from companion.replay.blocks import SerialShare
from companion.samples import CompassSample, ImuSample, MagSample, TiltSample
from tests.property.test_replay_blocks import knows, reads_of
from tests.support import still_aircraft as still

SEEDS = st.integers(0, 2**32 - 1)
Kind = Literal["gradienter", "compass"]
PROTOCOL: dict[Kind, str] = {"gradienter": "inclinometer_xy", "compass": "hmr3300"}


def gradienter_lines(rng: random.Random, decimals: int) -> bytes:
    x, y = (rng.choice([rng.gauss(5.0, 0.01), rng.uniform(-90.0, 90.0), -0.0004]) for _ in range(2))
    return f"X={x:+0{decimals + 4}.{decimals}f}\r\nY={y:+0{decimals + 4}.{decimals}f}\r\n".encode()


def compass_line(rng: random.Random) -> bytes:
    heading = rng.choice([rng.uniform(0.0, 359.9), rng.gauss(40.0, 0.2), rng.uniform(0.0, 12.0)])
    joint = rng.choice([", ", ", ", ","])
    return f"{heading:.1f}{joint}{rng.uniform(-90, 90):.1f}{joint}{rng.gauss(0.0, 0.3):.1f}\r\n".encode()


STRANGE: dict[Kind, tuple[bytes, ...]] = {
    "gradienter": (
        b"X=+++++++\r\n", b"Y=+00.300\r\n", b"X=+00.30\r\nY=+00.30\r\n", b"X=+95.000\r\nY=+00.000\r\n", b"\r\n", b"\n",
        b"*X=+01.000\r\nY=+01.000\r\n", b"X=+01.000\r\n", b"X=+0a.000\r\n", b"Z" * 90, b"+01.234\r\n", b"X= 01.000\r\n",
    ),
    "compass": (
        b"359.9, 1.0, 2.0, C\r\n", b"235.6\r\n", b"1256, -234, -1894\r\n", b"#I\r\n", b"40.1, 5.0\r\n", b"\r\n", b"\n",
        b"360.1, 0.0, 0.0\r\n", b"+40.1, +5.0, 1.0\r\n", b"040.1, 05.0, 1.0\r\n", b"4e1, 5.0, 1.0\r\n", b"9" * 90,
        b"40.1234, 5.0, 1.0\r\n", b"40.1, 91.0, 1.0\r\n", b"-1.0, 5.0, 1.0\r\n", b"40.1, 5.0, 1.0\n",
        b"40., 5.0, 1.0\r\n",
        b"40.1, 5.0\r, 1.0\r\n", b"40.1 , 5.0  ,1.0\r\n", b"40.1, 5.0, 1.0 \r\n", b"40.1,, 5.0, 1.0\r\n",
    ),
}  # fmt: skip


def stream(kind: Kind, rng: random.Random, count: int) -> list[tuple[bytes, float]]:
    """Readings and when they came, with everything that a field may bring."""
    period_s, t_s = rng.choice([0.01, 0.1, 0.125]), 1000.0 + rng.random()
    decimals, calm = rng.choice([2, 3, 3]), rng.random() < 0.4
    found = []
    for _ in range(count):
        t_s += period_s
        data = gradienter_lines(rng, decimals) if kind == "gradienter" else compass_line(rng)
        if not calm and rng.random() < 0.03:
            what = rng.randrange(5)
            if what == 0:
                place = rng.randrange(len(data))
                data = data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :]
            elif what == 1:
                data = data[: rng.randrange(len(data))]
            elif what == 2:
                t_s += rng.choice([0.9, 30.0])
            else:
                data = rng.choice(STRANGE[kind]) + (data if what == 3 else b"")
        found.append((data, t_s + rng.expovariate(1e3)))
    return found


class Taker:
    """Stands where the collector does."""

    def __init__(self) -> None:
        self.found: list[tuple[float, ...]] = []
        self.in_blocks = 0

    def add_tilts(self, block: PoseBlock, start: int, stop: int) -> None:
        part = slice(start, stop)
        self.found += [
            (t_s, *row) for t_s, row in zip(block.t_s[part].tolist(), block.rows[part].tolist(), strict=True)
        ]
        self.in_blocks += stop - start

    add_headings = add_tilts


def plain(samples: Any) -> list[Any]:
    """What of them a block would have, else they themselves."""
    return [
        (sample.t_s, sample.x_deg, sample.y_deg)
        if isinstance(sample, TiltSample)
        else (sample.t_s, sample.heading_deg)
        if isinstance(sample, CompassSample)
        else sample
        for sample in samples
    ]


def one_by_one(decoder: Decoder, reads: list[tuple[bytes | None, float]]) -> list[list[Any]]:
    found: list[list[Any]] = []
    for data, t_s in reads:
        if data is None:
            decoder.interrupted()
        found.append([] if data is None else plain(decoder.receive(data, t_s)))
    return found


def in_blocks(kind: Kind, decoder: Decoder, reads: list[tuple[bytes | None, float]]) -> tuple[list[list[Any]], int]:
    data = [msgspec.json.encode(topics.RawBytes(t_s, each)) for each, t_s in reads]
    share = SerialShare(Role(kind, kind), kind, decoder, np.arange(len(reads)), data)
    found, taker = [], Taker()
    for place in range(len(reads)):
        taker.found = []
        share.collect(taker, place)  # type: ignore[arg-type]
        alone = plain(share.one_by_one.get(place, []))
        assert not (taker.found and alone)
        found.append(taker.found + alone)
    return found, taker.in_blocks


@pytest.mark.parametrize("kind", ["gradienter", "compass"])
@settings(deadline=None, max_examples=60)
@given(SEEDS, st.sampled_from([0.0, 1e-3, 10.0 / 19200.0]))
def test_blocks_of_lines_give_what_reads_give(kind: Kind, seed: int, byte_s: float) -> None:
    rng = random.Random(seed)
    reads = reads_of(rng, stream(kind, rng, rng.choice([20, 150, 400])))
    one, other = (make_decoder(kind, PROTOCOL[kind], byte_s) for _ in range(2))
    start = 0
    while start < len(reads):
        stop = start + rng.choice([1, 40, 500])
        before = one_by_one(one, reads[start:stop])
        after, _ = in_blocks(kind, other, reads[start:stop])
        assert repr(after) == repr(before), "down to the sign of a zero"
        assert knows(one) == knows(other)
        start = stop


@pytest.mark.parametrize("kind", ["gradienter", "compass"])
@pytest.mark.parametrize("strange", range(21))
def test_what_is_strange_costs_its_neighbours_only(kind: Kind, strange: int) -> None:
    rng = random.Random(strange)
    reads: list[tuple[bytes | None, float]] = [
        (gradienter_lines(rng, 3) if kind == "gradienter" else compass_line(rng), 1000.0 + 0.1 * k) for k in range(400)
    ]
    among = STRANGE[kind][strange % len(STRANGE[kind])]
    reads[234] = (among + (reads[234][0] or b""), reads[234][1])
    one, other = (make_decoder(kind, PROTOCOL[kind], 1e-3) for _ in range(2))
    found, blocks = in_blocks(kind, other, reads)
    assert repr(found) == repr(one_by_one(one, reads))
    assert knows(one) == knows(other)
    assert blocks > 340


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(-99999, 99999), min_size=1), st.integers(1, 4))
def test_numbers_of_a_table_are_those_that_float_reads(numbers: list[int], decimals: int) -> None:
    texts = [f"{'-' if number < 0 else '+'}{abs(number):0{decimals + 2}d}" for number in numbers]
    size = max(map(len, texts))
    texts = [f"{text[0]}{text[1:].zfill(size - 1)}" for text in texts]
    texts = [f"{text[:-decimals]}.{text[-decimals:]}" for text in texts]
    table = np.frombuffer("".join(texts).encode(), np.uint8).reshape(len(texts), -1)
    found = fixed_point(table, decimals)
    assert found is not None
    assert repr(found.tolist()) == repr([float(text) for text in texts])
    for place in range(size + 1):
        damaged = table.copy()
        damaged[0, place] = ord("x")
        assert fixed_point(damaged, decimals) is None


# --- the collector


def collector(rng: random.Random) -> RollingCollector:
    compass = CompassModel(
        magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=1.0, prefers_field=rng.random() < 0.2
    )
    field_by = rng.choice([None, (compass, GradienterModel("euler", np.eye(3), (0.0, 0.0), 0.01))])
    return RollingCollector(
        still.settings(),
        [still.imu("fc")],
        gradienter=rng.random() < 0.9,
        compass=rng.random() < 0.9,
        gradienter_lag=Lag(0.4, 0.005),
        field_by=field_by,
    )


def pose_block(kind: Kind, t_s: Any, rng: np.random.Generator) -> PoseBlock:
    rows = rng.normal((5.0, -3.0), 0.003, (len(t_s), 2)) if kind == "gradienter" else rng.normal(0, 0.3, (len(t_s), 1))
    if kind == "compass":
        rows = np.mod(rows, 360.0)
    if rng.random() < 0.3:
        rows[rng.integers(0, len(t_s), 2)] += rng.choice([3.0, 170.0, 1e9])
    return PoseBlock(t_s, rows, np.arange(len(t_s)))


@settings(deadline=None, max_examples=15)
@given(SEEDS)
def test_a_collector_gets_the_same_from_blocks_of_the_pose(seed: int) -> None:
    rng, numbers = random.Random(seed), np.random.default_rng(seed)
    one, other = collector(random.Random(seed)), collector(random.Random(seed))
    rate_hz: dict[Kind, float] = {"gradienter": rng.choice([3.0, 10.0, 100.0]), "compass": rng.choice([1.0, 8.0, 20.0])}
    now_s = 1000.3
    for _ in range(4):
        length_s = rng.choice([0.7, 9.0, 20.0])
        imu_s = now_s + np.arange(0.0, length_s, 0.02)
        rows = still.noise(numbers, len(imu_s))
        block = ImuBlock(imu_s, rows, None, None, 0, np.arange(len(imu_s)))
        poses = {
            kind: pose_block(kind, now_s + np.arange(0.0, length_s, 1.0 / rate_hz[kind]), numbers) for kind in rate_hz
        }
        now_s += length_s
        looks = sorted(rng.uniform(now_s - length_s, now_s) for _ in range(3))
        taken = dict.fromkeys((0, "gradienter", "compass"), 0)
        for look_s in (*looks, now_s):
            stop = int(np.searchsorted(imu_s, look_s))
            for sample in block.samples(taken[0], stop):
                one.add_imu("fc", ImuSample(*msgspec.structs.astuple(sample)))
            other.add_block("fc", block, taken[0], stop)
            taken[0] = stop
            for kind, own in poses.items():
                stop = int(np.searchsorted(own.t_s, look_s))
                part = slice(taken[kind], stop)
                for t_s, row in zip(own.t_s[part].tolist(), own.rows[part].tolist(), strict=True):
                    if kind == "gradienter":
                        one.add_tilt(TiltSample(t_s, *row))
                    else:
                        one.add_compass(CompassSample(t_s, *row))
                (other.add_tilts if kind == "gradienter" else other.add_headings)(own, taken[kind], stop)
                taken[kind] = stop
            field = MagSample(look_s, (0.2, 0.1, 0.4))
            assert one.add_field(field) == other.add_field(field)
            assert one.glance(look_s) == other.glance(look_s)
            assert one.status(look_s) == other.status(look_s)
    for each in (one, other):
        each.glance(now_s + 2.0)
    assert to_json(freeze(one)) == to_json(freeze(other))


def test_a_recorded_collector_writes_down_what_is_in_a_block() -> None:
    collector = RecordedCollector(
        still.settings(), [still.imu("fc")], gradienter=True, compass=True, message_of=lambda name: None
    )
    queue = Queue()
    collector.journal.queues.append(queue)
    t_s = np.array([1.0, 1.1, 1.2])
    collector.add_tilts(PoseBlock(t_s, np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.arange(3)), 1)
    collector.add_headings(PoseBlock(t_s, np.array([[10.0], [20.0], [30.0]]), np.arange(3)), 0, 2)
    written = [(entry[0], *entry[3]) for entry in queue.take() if not isinstance(entry, Beginning)]
    assert written == [
        (topics.GRADIENTER, TiltSample(1.1, 3.0, 4.0)),
        (topics.GRADIENTER, TiltSample(1.2, 5.0, 6.0)),
        (topics.COMPASS, CompassSample(1.0, 10.0)),
        (topics.COMPASS, CompassSample(1.1, 20.0)),
    ]
