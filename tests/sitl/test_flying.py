"""Real firmware flies by our heading in the wind; the daemon dies, or its heading drifts: it stays on its spot."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from sim.flying.cli import fly
from sim.flying.flight import Plan, SetUp
from tests.sitl.craft import BINARIES, missing

pytestmark = pytest.mark.sitl


@pytest.mark.parametrize("kind", ["ardupilot-sitl", "px4-sitl"])
@pytest.mark.parametrize("fault", ["kill", "restart", "gyro-drift"])
def test_it_stays_where_it_is(tmp_path: Path, kind: str, fault: str) -> None:
    """Never above 10 deg and 3 m, at most two changes of the source set, no change of mode, no crash."""
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    set_up: SetUp = "px4" if kind == "px4-sitl" else "script"
    plan = Plan(Path(os.environ[BINARIES[kind]]), fault, set_up, wind=(5.0, 90.0), watched_s=25.0)
    record, found = asyncio.run(fly(plan, tmp_path))
    print(found, [event for event in record.events if event.own_s > record.struck_s])
    assert not found.wrong
    assert found.yaw_before_deg < 5.0
    # A heading that drifts is not believed by EKF3 itself, sooner than anybody asks for the compass.
    if set_up == "script" and fault != "gyro-drift":
        assert found.fallback_s < 1.0
    if fault == "restart":
        assert "Attitude: heading pushed to the autopilot" in [event.words for event in record.after("text")]
