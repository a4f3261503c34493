"""A row of MAVLink at once against message by message: the same samples, remarks and memory, whatever comes."""

from __future__ import annotations

import itertools
import random
from collections import deque
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink_bulk import crc16_mcrf4xx, frames_of
from companion.protocols.bulk import ImuBlock
from companion.recording import topics
from companion.replay.telemetry import Telemetry, TelemetryShares
from companion.samples import ImuSample

SEEDS = st.integers(0, 2**32 - 1)
DIALECT: Any = mavlink
Message = tuple[str, bytes]
"""Topic and what is on it."""


def f32(value: float) -> float:
    return float(np.float32(value))


class Autopilot:
    """Sends what an autopilot does, and writes down what a daemon would have counted of it."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.t_s = 500.0 + rng.random()
        self.boot_s = rng.choice([0.5, 70.0, 2000.0])
        self.first = rng.choice(["HIGHRES_IMU", "HIGHRES_IMU", "RAW_IMU", "SCALED_IMU"])
        self.calm = rng.random() < 0.5
        self.warm = rng.random() < 0.5

    def imu(self, message: str) -> tuple[Any, topics.ImuEntry]:
        """One IMU message and the sample that is in it."""
        rng = self.rng
        gyro: Any
        accel: Any
        if message == "HIGHRES_IMU":
            gyro, accel = (tuple(f32(rng.gauss(0.0, s)) for _ in range(3)) for s in (rng.choice([1e-3, 1e-9]), 9.8))
            time_us, updated = round(self.boot_s * 1e6), rng.choice([63, 63, 0xFFF, 0])
            if rng.random() < 0.1:
                gyro = (0.0, -0.0, f32(1.0))
            made = DIALECT.MAVLink_highres_imu_message(
                time_us, *accel, *gyro, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, updated, 0 if rng.random() < 0.97 else 1
            )
            return made, topics.ImuEntry(self.t_s, gyro, accel, None, None, time_us * 1e-6, message)
        counts = [rng.randrange(-1200, 1200) for _ in range(6)]
        temperature = rng.choice([0, 0, 2512]) if self.warm else 0
        accel = tuple(count * 9.80665e-3 for count in counts[:3])
        gyro = tuple(count * 1e-3 for count in counts[3:])
        warm = temperature * 0.01 if temperature else None
        if message == "RAW_IMU":
            time_us = round(self.boot_s * 1e6)
            made = DIALECT.MAVLink_raw_imu_message(time_us, *counts, 0, 0, 0, 0, temperature)
            return made, topics.ImuEntry(self.t_s, gyro, accel, warm, None, time_us * 1e-6, message)
        time_ms = round(self.boot_s * 1e3)
        kind = DIALECT.MAVLink_scaled_imu_message if message == "SCALED_IMU" else DIALECT.MAVLink_scaled_imu2_message
        made = kind(time_ms, *counts, 0, 0, 0, temperature)
        return made, topics.ImuEntry(self.t_s, gyro, accel, warm, None, time_ms * 1e-3, message)

    def pack(self, message: Any) -> bytes:
        data = bytes(message.pack(self.codec))
        self.codec.seq = (self.codec.seq + 1) % 256
        return data

    def steps(self, count: int) -> Iterator[list[tuple[bytes, str, topics.ImuEntry | None]]]:
        """What is sent every 10 ms: frames, and the sample of one that counts."""
        rng = self.rng
        for number in range(count):
            self.t_s += 0.01
            self.boot_s += 0.01
            frames: list[tuple[bytes, str, topics.ImuEntry | None]] = []
            for name, message in (("fc", self.first), ("two", "SCALED_IMU2")):
                made, entry = self.imu(message)
                counts = message != "HIGHRES_IMU" or (made.fields_updated & 63 == 63 and made.id == 0)
                frames.append((self.pack(made), name, entry if counts and rng.random() < 0.98 else None))
            if number % 7 == 0:
                frames += [
                    (self.pack(DIALECT.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 3)), "", None),
                    (self.pack(DIALECT.MAVLink_attitude_message(number, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)), "", None),
                    (self.pack(DIALECT.MAVLink_statustext_message(6, b"hello")), "", None),
                ]
            if not self.calm and rng.random() < 0.03:
                place = rng.randrange(len(frames))
                frames[place] = (self.strange(frames[place][0]), *frames[place][1:])
            yield frames

    def strange(self, data: bytes) -> bytes:
        rng = self.rng
        what = rng.randrange(7)
        if what == 0:
            place = rng.randrange(len(data))
            return data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :]
        if what == 1:
            return data[: rng.randrange(len(data))]
        if what == 2:
            return rng.randbytes(rng.randrange(1, 40)) + data
        if what == 3:
            self.boot_s = 0.3
            return data
        if what == 4:
            return data + bytes(
                DIALECT.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 2).pack(self.codec, force_mavlink1=True)
            )
        if what == 5:
            return b""
        made = bytearray(self.pack(DIALECT.MAVLink_raw_imu_message(1, *range(9), 1, 0)))
        return data + bytes(made[:7]) + b"\xf0\xff\xff" + bytes(made[10:])

    def written(self, name: str, entry: topics.ImuEntry) -> Message:
        """As the recording has it; something in it may have been damaged."""
        if not self.calm and self.rng.random() < 0.02:
            entry = self.rng.choice([
                msgspec.structs.replace(entry, t_device_s=None),
                msgspec.structs.replace(entry, t_device_s=0.123),
                msgspec.structs.replace(entry, t_s=entry.t_s + 1.0),
                msgspec.structs.replace(entry, sequence=4),
                msgspec.structs.replace(entry, message="SCALED_IMU3"),
                msgspec.structs.replace(entry, message=None),
                msgspec.structs.replace(entry, gyro_rad_s=(9.0, *entry.gyro_rad_s[1:])),
                msgspec.structs.replace(entry, temperature_degc=21.5),
            ])  # fmt: skip
        sample = ImuSample(
            entry.t_s, entry.gyro_rad_s, entry.accel_m_s2, entry.temperature_degc, entry.sequence, entry.t_device_s
        )
        return topics.IMU + name, topics.imu_json(sample, entry.message)


def recorded(rng: random.Random, count: int) -> list[Message]:
    """The messages of a recording: each read as a port hands it over, then the samples that it has completed."""
    autopilot = Autopilot(rng)
    whole = rng.random() < 0.5
    messages: list[Message] = []
    waiting, due = b"", deque[tuple[int, str, topics.ImuEntry]]()
    sent = 0
    for frames in autopilot.steps(count):
        for data, name, entry in frames:
            waiting += data
            sent += len(data)
            if entry is not None:
                due.append((sent, name, entry))
        cut = len(waiting) if whole else rng.randrange(max(len(waiting) - 60, 0), len(waiting) + 1)
        read, waiting = waiting[:cut], waiting[cut:]
        messages.append((topics.MAVLINK_IN, msgspec.json.encode(topics.RawBytes(autopilot.t_s, read))))
        while due and due[0][0] <= sent - len(waiting):
            _, name, entry = due.popleft()
            messages.append(autopilot.written(name, msgspec.structs.replace(entry, t_s=autopilot.t_s)))
        if not autopilot.calm and rng.random() < 0.01:
            messages.append((topics.MAVLINK_IN, msgspec.json.encode(topics.RawBytes(autopilot.t_s))))
            sent -= len(waiting)
            waiting = b""
    return messages


def one_by_one(telemetry: Telemetry, messages: list[Message]) -> tuple[list[tuple[int, str, ImuSample]], list[str]]:
    samples, remarks = [], []
    for place, (topic, data) in enumerate(messages):
        if topic == topics.MAVLINK_IN:
            raw = msgspec.json.decode(data, type=topics.RawBytes)
            telemetry.receive(raw.data, raw.t_s)
            continue
        sample, strange = telemetry.sample(msgspec.json.decode(data, type=topics.ImuEntry))
        name = topic.removeprefix(topics.IMU)
        samples.append((place, name, sample))
        remarks += [f"imu {name}: {strange}"] if strange else []
    return samples, remarks


class Taker:
    """Stands where the collector does."""

    def __init__(self) -> None:
        self.found: list[tuple[str, ImuSample]] = []
        self.in_blocks = 0

    def add_block(self, name: str, block: ImuBlock, start: int, stop: int) -> None:
        self.found += [(name, sample) for sample in block.samples(start, stop)]
        self.in_blocks += stop - start


def at_once(telemetry: Telemetry, messages: list[Message]) -> tuple[list[tuple[int, str, ImuSample]], list[str], int]:
    def of(topic: str) -> tuple[Any, list[bytes]]:
        places = [place for place, (each, _) in enumerate(messages) if each == topic]
        return np.array(places, dtype=np.intp), [messages[place][1] for place in places]

    row = TelemetryShares(telemetry, of(topics.MAVLINK_IN), {name: of(topics.IMU + name) for name in ("fc", "two")})
    taker, samples = Taker(), []
    for place in range(len(messages)):
        taker.found = []
        for name, share in row.shares.items():
            share.collect(taker, place)  # type: ignore[arg-type]
            taker.found += [(name, sample) for sample in share.one_by_one.get(place, [])]  # type: ignore[misc]
        assert len(taker.found) <= 1
        samples += [(place, name, sample) for name, sample in taker.found]
    return samples, [words for _, words in sorted(row.strange)], taker.in_blocks


def pending(telemetry: Telemetry) -> Any:
    """What it would still find samples in."""
    return {
        name: [(t_s, each.t_device_s, each.gyro_rad_s, each.accel_m_s2) for t_s, each in known.single()]
        for name, known in telemetry._pending.items()
    }


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_a_row_of_mavlink_gives_what_its_messages_give(seed: int) -> None:
    rng = random.Random(seed)
    messages = recorded(rng, rng.choice([20, 150, 400]))
    half = rng.choice([b"", b"", b"\xfd\x09\x00"])
    one, other = Telemetry(half, 1.0), Telemetry(half, 1.0)
    start = 0
    while start < len(messages):
        stop = start + rng.choice([1, 40, 1000])
        samples, remarks = one_by_one(one, messages[start:stop])
        found, strange, _ = at_once(other, messages[start:stop])
        assert repr(found) == repr(samples), "down to the sign of a zero"
        assert strange == remarks
        if rng.random() < 0.5:
            assert repr(pending(one)) == repr(pending(other))
        assert one._link.half_received == other._link.half_received
        start = stop
    assert repr(pending(one)) == repr(pending(other))


def regular(seed: int, count: int = 600) -> list[Message]:
    """A recording with nothing strange in it."""
    for number in itertools.count(seed):
        autopilot = Autopilot(random.Random(number))
        if autopilot.calm and not autopilot.warm:
            break
    return recorded(random.Random(number), count)


@pytest.mark.parametrize("seed", range(4))
def test_a_regular_stream_is_taken_in_blocks(seed: int) -> None:
    """Otherwise the test above would say nothing of them."""
    messages = regular(1000 * seed)
    samples, remarks, blocks = at_once(Telemetry(b"", 1.0), messages)
    assert not remarks
    assert blocks == len(samples) > 900


def test_what_is_strange_costs_its_neighbours_only() -> None:
    messages = regular(7)
    damaged = next(place for place in range(600, 700) if messages[place][0] == topics.MAVLINK_IN)
    raw = msgspec.json.decode(messages[damaged][1], type=topics.RawBytes)
    assert raw.data is not None
    messages[damaged] = (topics.MAVLINK_IN, msgspec.json.encode(topics.RawBytes(raw.t_s, b"\x00" + raw.data)))
    one, other = Telemetry(b"", 1.0), Telemetry(b"", 1.0)
    samples, remarks, blocks = at_once(other, messages)
    assert (samples, remarks) == one_by_one(one, messages)
    assert len(samples) - blocks < 100


@pytest.mark.parametrize(
    ("reading", "strange"), [(99, False), (71, False), (70, False), (69, True), (3, True), (100, True), (104, True)]
)
def test_what_came_too_long_ago_or_not_yet_is_not_found(
    reading: int, strange: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample behind a hundred readings that nobody counted, of which thirty are remembered."""
    monkeypatch.setattr("companion.replay.telemetry.PENDING", 30)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    messages: list[Message] = []
    for number in range(150):
        frame = DIALECT.MAVLink_raw_imu_message(10_000 * number, number, *range(8), 0, 0).pack(codec)
        messages.append((topics.MAVLINK_IN, msgspec.json.encode(topics.RawBytes(5.0 + 0.01 * number, bytes(frame)))))
    accel = (reading * 9.80665e-3, 0.0, 9.80665e-3)
    sample = ImuSample(5.0 + 0.01 * reading, (2e-3, 3e-3, 4e-3), accel, None, None, 10_000 * reading * 1e-6)
    messages.insert(100, (topics.IMU + "fc", topics.imu_json(sample, "RAW_IMU")))
    one, other = Telemetry(b"", 1.0), Telemetry(b"", 1.0)
    samples, remarks, _ = at_once(other, messages)
    assert (samples, remarks) == one_by_one(one, messages)
    assert bool(remarks) == strange
    assert pending(one) == pending(other)


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 90), SEEDS)
def test_the_checksums_of_a_table_are_those_of_its_rows(size: int, seed: int) -> None:
    table = np.random.default_rng(seed).integers(0, 256, (5, size), dtype=np.uint8)
    assert crc16_mcrf4xx(table).tolist() == [mavlink.x25crc(row.tobytes()).crc for row in table]


def test_fields_of_frames_are_those_that_the_dialect_reads() -> None:
    """Whatever is cut off a payload's end because it is zero."""
    rng = random.Random(5)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    kind = DIALECT.MAVLink_highres_imu_message
    values = [
        (rng.randrange(2**63), *(rng.choice([0.0, rng.gauss(0.0, 1.0)]) for _ in range(13)), rng.choice([0, 63]), k % 2)
        for k in range(200)
    ]
    data = b"".join(bytes(kind(*each).pack(codec)) for each in values)
    found = frames_of(data + b"\xfd\x10", {kind})
    assert found is not None
    frames, end = found
    assert end == len(data)
    truth = [mavlink.MAVLink(None).decode(bytearray(kind(*each).pack(codec))) for each in values]
    for name in kind.fieldnames:
        assert frames[kind].fields[name].tolist() == [getattr(message, name) for message in truth]


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.floats(-2e9, 2e9)
        | st.floats(-1e-3, 1e-3)
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.floats(-40.0, 40.0, width=32)
        | st.sampled_from([0.0, -0.0, 1.0, 0.1, 1e-9, 999999999.5, 99999999.95, 1e8, 1e9, 123456788.5, 0.1234567885])
        | st.builds(lambda n, k: (n + 0.5) / 10.0**k, st.integers(10**8, 10**9), st.integers(0, 17)),
        min_size=1,
    )
)
def test_nine_digits_are_those_of_the_text(values: list[float]) -> None:
    found = topics.nine_digits(np.array(values).reshape(1, -1))
    assert repr(found[0].tolist()) == repr([float(f"{value:.9g}") for value in values])
