"""What we ship for ground stations, against what QGroundControl demands of such a file (autopilots 7.3)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.component.requests import Command, Key, Refused, judge

ACTIONS = Path(__file__).parents[2] / "docs/ground_stations/companion_actions.json"
NUMBERS = {"mavCmd", "compId", *(f"param{n}" for n in range(1, 8))}


def test_the_actions_file_has_the_head_that_qgroundcontrol_demands() -> None:
    found = json.loads(ACTIONS.read_text())
    assert (found["version"], found["fileType"]) == (1, "MavlinkActions")
    assert set(found) == {"version", "fileType", "actions"}


@pytest.mark.parametrize("action", json.loads(ACTIONS.read_text())["actions"], ids=lambda action: action["label"])
def test_every_action_goes_to_the_companion_and_is_understood(action: dict[str, object]) -> None:
    assert {"label", "description", "mavCmd"} <= set(action) <= {"label", "description", *NUMBERS}
    assert action["compId"] == 191, "QGroundControl's default is the autopilot"
    command = action["mavCmd"]
    assert isinstance(command, int)
    x1, x2, x3, x4, x5, x6, x7 = (float(str(action.get(f"param{n}", 0))) for n in range(1, 8))
    asked = judge(Command(Key(255, 190, command), (x1, x2, x3, x4, x5, x6, x7), 0, b""))
    assert not isinstance(asked, Refused), asked
