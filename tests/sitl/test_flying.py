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
RESUMED = "Attitude: heading pushed to the autopilot"
ROUND_S = 60.0
"""Time in which a plane has flown its circle; on half of it the wind lets its compass be read."""


def binary_of(craft: str) -> Path:
    """Skips where there is none; `arduplane` is looked for beside the ArduPilot that the environment names."""
    kind = "px4-sitl" if craft == "px4" else "ardupilot-sitl"
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    path = Path(os.environ[BINARIES[kind]])
    if craft == "arduplane" and not (path := path.with_name(craft)).exists():
        pytest.skip(f"found no {path}")
    return path


@pytest.mark.parametrize(
    ("craft", "fault"),
    [
        *((craft, fault) for craft in ("arducopter", "px4") for fault in ("kill", "restart", "gyro-drift")),
        ("arducopter", "own-compass"),
        ("arduplane", "kill"),
        ("arduplane", "restart"),
    ],
)
def test_it_stays_where_it_is(tmp_path: Path, craft: str, fault: str) -> None:
    """Never above 10 deg and 3 m, at most two changes of the source set, no change of mode, no crash."""
    set_up: SetUp = "px4" if craft == "px4" else "script"
    watched_s = ROUND_S if (craft, fault) == ("arduplane", "restart") else 25.0
    plan = Plan(binary_of(craft), fault, set_up, wind=(5.0, 90.0), watched_s=watched_s)
    record, found = asyncio.run(fly(plan, tmp_path))
    print(found, [event for event in record.events if event.own_s > record.struck_s])
    assert not found.wrong
    assert found.yaw_before_deg < 5.0
    # A heading that drifts is not believed by EKF3 itself, sooner than anybody asks for another.
    if fault != "gyro-drift":
        assert found.fallback_s < 1.0
    if fault == "restart":
        assert RESUMED in [event.words for event in record.after("text")]
