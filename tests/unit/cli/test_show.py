"""The summary of a status, and what was done by hand, in words."""

from __future__ import annotations

import pytest

from companion.cli.show import history_lines
from companion.formats import Object
from companion.summary import headline, rows

UNDONE = "2026-11-23T07:01:02.000+00:00"


@pytest.mark.parametrize(
    ("more", "end"),
    [
        ({}, "; 2 parameters written, in force"),
        ({"in_force": None}, "; 2 parameters written"),
        ({"in_force": False}, "; 2 parameters written, not in force as written any more"),
        ({"in_force": False, "undone_at": UNDONE}, "; 2 parameters written, undone 2026-11-23 07:01"),
        ({"written": {}, "in_force": None}, ""),
    ],
)  # fmt: skip
def test_what_was_done_by_hand_is_told_by_the_history(more: dict[str, object], end: str) -> None:
    done = {
        "what": "level",
        "state": "done",
        "measured_at": "2026-11-23T06:12:13.000+00:00",
        "reason": "level written",
        "written": {"AHRS_TRIM_X": 0.01, "AHRS_TRIM_Y": 0.02},
        "undone_at": None,
        "in_force": True,
    }
    lines = history_lines([], [], [], [done | more])
    assert lines[0] == "no calibrations yet"
    assert lines[-1] == f"     2026-11-23T06:12:13  level: level written{end}"


def test_the_summary_names_each_part_with_its_verdict_and_then_the_warnings() -> None:
    status: Object = {
        "headline": {"word": "READY", "reason": "calibrated 5 s ago", "tone": "good"},
        "vehicle": {"heartbeat_age_s": 2.5, "summary": "ArduPilot, disarmed", "signing": None},
        "devices": [
            {"name": "imu", "good": True, "summary": "200 Hz", "rejected": {"crc": 3, "length": 1}, "reconnects": 2},
            {"name": "compass", "good": False, "summary": "silent for 3 s", "lost": 0},
        ],
        "ground_stations": {"good": False, "summary": "hear nothing"},
        "mqtt": {"good": True, "summary": "connected"},
        "fleet": None,
        "recording": {"fault": "disk full"},
        "arming": {"setup": {"problem": "the script does not run"}},
        "automatic": {"stopped": "an undo"},
        "warnings": ["the compass wanders"],
    }
    assert headline(status) == "READY: calibrated 5 s ago"
    assert rows(status) == [
        ("wrong", "autopilot", "ArduPilot, disarmed"),
        ("ok", "imu", "200 Hz; bad frames: 4; reconnected: 2"),
        ("wrong", "compass", "silent for 3 s"),
        ("wrong", "ground stations", "hear nothing"),
        ("ok", "mqtt", "connected"),
        ("wrong", "recordings", "none at present: disk full"),
        ("wrong", "arming", "the script does not run"),
        ("wrong", "by itself", "no calibration until asked: an undo"),
        ("warning", "warning", "the compass wanders"),
    ]
