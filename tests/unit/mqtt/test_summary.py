"""When the state is worth a message: what happens at once, what only counts time rarely."""

from __future__ import annotations

from typing import Any

from companion.mqtt.process import LEAST_S, SLOW_S, Pace, summary


def status(**more: Any) -> dict[str, Any]:
    whole: dict[str, Any] = {
        "state": "idle",
        "reason": "ready",
        "progress": None,
        "still_s": 3.0,
        "waiting_for": None,
        "vehicle": {"system_id": 1, "firmware": "px4", "armed": "disarmed", "summary": "PX4"},
        "warnings": [],
        "fault": None,
        "putting_back": False,
        "devices": [
            {"name": "compass", "kind": "compass", "good": True, "summary": "20 frames/s", "frames": 7},
            {"name": "own", "kind": "imu", "good": False, "summary": "/dev/x: unplugged?", "frames": 0},
        ],
        "arming": {
            "at_arm": "warn",
            "verdict": "accept",
            "words": "",
            "state": "calibrated",
            "in_force": "calibrated 3 s ago",
            "against": [],
        },
        "last": None,
    }
    return whole | more


def test_figures_that_change_with_every_look_are_left_out() -> None:
    busier = status(still_s=4.0)
    busier["devices"][0] |= {"summary": "21 frames/s", "frames": 28}
    assert summary(busier) == summary(status())
    assert [device["problem"] for device in summary(status())["devices"]] == [None, "/dev/x: unplugged?"]


def test_the_pace() -> None:
    pace = Pace()
    assert pace.is_due(summary(status()), 0.0)
    assert not pace.is_due(summary(status()), 100.0)
    assert pace.is_due(summary(status(state="waiting")), 100.1), "another state: at once"
    moved = summary(status(state="waiting", waiting_for="hold still"))
    assert not pace.is_due(moved, 100.1 + LEAST_S / 2)
    assert pace.is_due(moved, 100.2 + LEAST_S)
    later = status(state="waiting", waiting_for="hold still")
    later["arming"]["in_force"] = "calibrated 9 s ago"
    assert not pace.is_due(summary(later), 100.2 + SLOW_S / 2)
    assert pace.is_due(summary(later), 101.3 + SLOW_S)
