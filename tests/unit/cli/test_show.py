"""The summary of a status, and what was done by hand, in words."""

from __future__ import annotations

from companion.formats import Object
from companion.summary import headline, rows


def test_the_summary_names_each_part_with_its_verdict_and_then_the_warnings() -> None:
    status: Object = {
        "headline": {"word": "READY", "reason": "calibrated 5 s ago", "tone": "good"},
        "vehicle": {"heartbeat_age_s": 2.5, "summary": "ArduPilot, disarmed", "signing": None},
        "devices": [
            {"name": "imu", "good": True, "summary": "200 Hz", "rejected": {"a": 3, "b": 1}, "lost": 9, "frames": 999},
            {"name": "compass", "good": False, "summary": "silent", "reconnects": 2, "lost": 30, "frames": 970},
        ],
        "compasses": [{"name": "compass 1", "summary": "heading good to 1.2 deg, aligned 2026-11-28"}],
        "ground_stations": {"good": False, "summary": "hear nothing"},
        "mqtt": {"good": True, "summary": "connected"},
        "fleet": None,
        "recording": {"fault": "disk full"},
        "arming": {
            "setup": {"problem": "the script does not run"},
            "warm_up": {"words": "steady in 3.5 +- 1.0 min, imu fc warms 0.9 K/min"},
        },
        "automatic": {"stopped": "an undo"},
        "warnings": ["the compass wanders"],
    }
    assert headline(status) == "READY: calibrated 5 s ago"
    assert [row[:3] for row in rows(status)] == [
        ("wrong", "autopilot", "ArduPilot, disarmed"),
        ("ok", "imu", "200 Hz; bad frames: 4"),
        ("wrong", "compass", "silent; samples lost: 3%; reconnected: 2"),
        ("ok", "compass 1", "heading good to 1.2 deg, aligned 2026-11-28"),
        ("wrong", "ground stations", "hear nothing"),
        ("ok", "mqtt", "connected"),
        ("wrong", "recordings", "none at present: disk full"),
        ("wrong", "arming", "the script does not run"),
        ("ok", "warm-up", "steady in 3.5 +- 1.0 min, imu fc warms 0.9 K/min"),
        ("wrong", "by itself", "no calibration until asked: an undo"),
        ("warning", "warning", "the compass wanders"),
    ]
