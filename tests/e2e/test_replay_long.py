"""Recordings of serial IMUs that a few lines of numpy wrote: what a replay finds is what the writer put in."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.estimation.records.record import Record
from companion.lab.replay.engine import Result, replay
from companion.recording import messages
from tests.e2e.test_record_replay import rewritten
from tests.support.long_recordings import GYRO_BIAS, NOISE, write_recording

KINDS: dict[str, dict[str, Any]] = {
    "a read a frame": {"seconds": 30.0, "rate_hz": 400.0},
    "heaps of two": {"seconds": 30.0, "rate_hz": 200.0, "imus": 2, "read_s": 0.016},
}


def replayed(path: Path) -> tuple[Result, Record]:
    result = replay([path])
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
        if not topic.startswith(messages.SERIAL + "imu"):
            return data
        count += 1
        if 1500 < count < 1600:  # it was silent
            return None
        if count % 997 == 0:
            return b""
        if count % 401 == 0:
            place = rng.randrange(len(data))
            return data[:place] + b"\xfa" + data[place + 1 :]
        return data if count % 613 else None

    _, damaged = replayed(rewritten(path, tmp_path / "damaged.mcap", damage))
    biases_are_true(damaged)
    assert damaged.imus != whole.imus
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    result, cut = replayed(path)
    biases_are_true(cut)
    assert result.cut_short
