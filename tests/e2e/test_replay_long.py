"""Recordings of serial IMUs that a few lines of numpy wrote: what a replay finds is what the writer put in."""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from companion.calibration.records.record import Record
from companion.errors import StorageError
from companion.recording import topics
from companion.recording.walk import Message, Recording
from companion.replay.engine import Replay, Result
from tests.e2e.test_record_replay import rewritten
from tests.support.long_recordings import GYRO_BIAS, NOISE, write_recording
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

KINDS: dict[str, dict[str, Any]] = {
    "a read a frame": {"seconds": 30.0, "rate_hz": 400.0},
    "heaps of two": {"seconds": 30.0, "rate_hz": 200.0, "imus": 2, "read_s": 0.016},
}


def replayed(path: Path) -> tuple[Result, Record]:
    result = Replay(Recording(path)).run()
    assert result.estimate is not None
    return result, result.estimate


def biases_are_true(record: Record) -> None:
    assert record.state == "done"
    for imu in record.imus:
        off = np.subtract(imu.gyro_bias_rad_s or (), np.array(GYRO_BIAS))
        assert np.abs(off).max() < 5.0 * NOISE[0] / np.sqrt(imu.samples) + 1e-4, "the Earth turns with 7e-5 rad/s"


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
def test_a_replay_finds_the_biases_of_the_writer(tmp_path: Path, kind: dict[str, Any]) -> None:
    path = tmp_path / "whole.mcap"
    write_recording(path, **kind)
    _, whole = replayed(path)
    biases_are_true(whole)
    assert len(whole.imus) == kind.get("imus", 1)
    for imu in whole.imus:
        # All but the seconds at both ends.
        assert imu.samples >= kind["rate_hz"] * 28

    rng, count = random.Random(4), 0

    def damage(topic: str, data: bytes) -> bytes | None:
        nonlocal count
        if not topic.startswith(topics.SERIAL + "imu"):
            return data
        count += 1
        raw = msgspec.json.decode(data, type=topics.RawBytes)
        if 1500 < count < 1600:  # it was silent
            return None
        assert raw.data is not None
        if count % 997 == 0:
            return msgspec.json.encode(topics.RawBytes(raw.t_s))
        if count % 401 == 0:
            place = rng.randrange(len(raw.data))
            return msgspec.json.encode(topics.RawBytes(raw.t_s, raw.data[:place] + b"\xfa" + raw.data[place + 1 :]))
        return data if count % 613 else None

    _, damaged = replayed(rewritten(path, tmp_path / "damaged.mcap", damage))
    biases_are_true(damaged)
    assert damaged.imus != whole.imus
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    result, cut = replayed(path)
    biases_are_true(cut)
    assert result.cut_short


async def _live(folder: Path) -> None:
    async with Rig(folder, own_imu=True, recordings_mb=64).running() as rig:
        await rig.ready()
        await asyncio.sleep(30.0)


def test_samples_that_are_not_in_the_autopilot_s_bytes_are_named(tmp_path: Path) -> None:
    run_virtual(_live(tmp_path))
    path = tmp_path / "recordings" / "000001.mcap"
    assert not replayed(path)[0].notes
    rng, count, changed = random.Random(8), 0, 0

    def damage(topic: str, data: bytes) -> bytes | None:
        nonlocal count, changed
        if topic not in (topics.MAVLINK_IN, topics.IMU + "fc"):
            return data
        count += 1
        if topic == topics.MAVLINK_IN and count % 397 == 0:
            raw = msgspec.json.decode(data, type=topics.RawBytes)
            assert raw.data is not None
            place = rng.randrange(len(raw.data))
            return msgspec.json.encode(topics.RawBytes(raw.t_s, raw.data[:place] + b"\xfa" + raw.data[place + 1 :]))
        if topic != topics.MAVLINK_IN and count % 501 == 0:
            changed += 1
            return data.replace(b'"gyro_rad_s":[', b'"gyro_rad_s":[1')
        return data

    notes, record = replayed(rewritten(path, tmp_path / "damaged.mcap", damage))
    assert record.state == "done"
    assert any("imu fc: a sample is not in the MAVLink bytes: " in note for note in notes.notes)
    assert changed > 0
    assert f"imu fc: a sample does not decode as it did: {changed} times" in notes.notes


def test_a_message_that_is_none_of_raw_bytes_is_named(tmp_path: Path) -> None:
    path, count = tmp_path / "whole.mcap", 0
    write_recording(path, seconds=3.0, rate_hz=100.0)

    def change(topic: str, data: bytes) -> bytes:
        nonlocal count
        count += topic == "/serial/imu0"
        return b'{"t_s":1.0},{"t_s":2.0}' if topic == "/serial/imu0" and count == 120 else data

    broken = rewritten(path, tmp_path / "broken.mcap", change)
    with pytest.raises(StorageError, match=r"a message on /serial/imu0 cannot be used by this version"):
        Replay(Recording(broken)).run()


def test_messages_that_look_like_the_beginning_of_others_are_read_as_they_are(tmp_path: Path) -> None:
    """Data full of what a record begins with: where the next one is, each record says alone."""
    path, rng = tmp_path / "x.mcap", random.Random(9)
    written = []
    with path.open("wb") as file:
        writer: Any = Writer(file, chunk_size=3000)
        writer.start()
        channels = {name: writer.register_channel(name, "json", 0) for name in ("/a", "/b", "/c", "/d", "/e", "/f")}
        for number in range(400):
            name = rng.choice(list(channels))
            head = b"\x05" + rng.choice([5, 31, 22, 60]).to_bytes(8, "little")
            data = rng.choice([b"", head, head * 3 + bytes(40), b"\x05" * 50, bytes(31), rng.randbytes(80)])
            writer.add_message(channels[name], rng.choice([5, 0, 5 << 40, number]), data, 0, 5)
            written.append((name, data))
        writer.finish()
    with path.open("rb") as file:
        library = [
            (channel.topic, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    recording = Recording(path)
    found = [(item.topic, item.data) for item in recording if isinstance(item, Message)]
    assert found == library
    assert found == written
    assert recording.cut_short is None
