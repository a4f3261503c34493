"""Real firmware flies with known sensor errors: its log tells of them, and ours drifts as little as perfect offsets."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from sim.flying.bench import SPANS_S, WITHIN, draw, fly
from sim.flying.injected import Row
from tests.sitl.craft import BINARIES, missing

pytestmark = pytest.mark.sitl
LARGEST_ERROR = {"gyro x": 30.0, "gyro y": 30.0, "gyro z": 60.0, "accel z": 0.6}
"""deg/h and mg, of means; a sigma that promises nothing would let everything pass."""


@pytest.mark.parametrize(
    ("kind", "number"), [("ardupilot-sitl", 0), ("ardupilot-sitl", 1), ("px4-sitl", 1)], ids=["calm", "shaken", "px4"]
)
def test_the_log_tells_what_was_injected(tmp_path: Path, kind: str, number: int) -> None:
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    found = asyncio.run(fly(Path(os.environ[BINARIES[kind]]), 1, number, tmp_path, 4.0))
    rows = [Row(*row) for row in found["rows"]]
    print(*rows, found["drift"], sep="\n")
    assert {row.term for row in rows} >= {"own_imu", "turn_on", "in_flight", "motors", "trend"}
    for row in rows:
        assert abs(row.found - row.true) <= 3.0 * row.sigma, row
        if row.term in ("turn_on", "in_flight", "motors") and kind == "ardupilot-sitl":
            assert abs(row.found - row.true) < LARGEST_ERROR[row.axis], row
    for k, _ in enumerate(SPANS_S):
        assert found["drift"]["flown"][k] <= WITHIN * found["drift"]["perfect"][k]
    if draw(1, number).kind == "calm" and kind == "ardupilot-sitl":
        assert found["drift"]["before"][1] > 3.0 * found["drift"]["flown"][1]
