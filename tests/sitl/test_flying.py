"""A real ArduCopter flies by our heading in the wind; the daemon dies, or its heading drifts: it stays on its spot."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from sim.flying.cli import fly
from sim.flying.flight import Plan
from tests.sitl.craft import BINARIES, missing

pytestmark = pytest.mark.sitl


@pytest.mark.parametrize("fault", ["kill", "gyro-drift"])
def test_it_stays_where_it_is(tmp_path: Path, fault: str) -> None:
    """Never above 10 deg and 3 m, at most two changes of the source set, no change of mode, no crash."""
    reason = missing("ardupilot-sitl")
    if reason is not None:
        pytest.skip(reason)
    plan = Plan(Path(os.environ[BINARIES["ardupilot-sitl"]]), fault, wind=(5.0, 90.0), watched_s=25.0)
    record, found = asyncio.run(fly(plan, tmp_path))
    print(found, [event for event in record.events if event.own_s > record.struck_s])
    assert not found.wrong
    assert found.yaw_before_deg < 5.0
    if (
        fault == "kill"
    ):  # a heading that drifts is not believed by EKF3 itself, sooner than anybody asks for the compass
        assert found.fallback_s < 1.0
