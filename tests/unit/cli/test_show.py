"""What was done by hand, in words."""

from __future__ import annotations

import pytest

from companion.cli.show import history_lines

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
