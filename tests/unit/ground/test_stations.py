"""Files for ground stations, against the demands of each (autopilots 7.3)."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion.commands import Calibrate, Cancel, Undo
from companion.component.commands import Request, judge
from companion.component.service import Refusal
from companion.estimation.machine import What
from tests.support.component import command_long

SCRIPT = Path(__file__).parents[3] / "docs/ground_stations/mission_planner_companion.py"
ACTIONS = Path(__file__).parents[3] / "docs/ground_stations/companion_actions.json"
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
    asked = judge(command_long(command, *(float(str(action.get(f"param{n}", 0))) for n in range(1, 8))))
    assert not isinstance(asked, Refusal), asked


class _MissionPlanner:
    """Mission Planner's script interface, as far as ours uses it: `MAV.doCommand(byte, byte, MAV_CMD, 7 x float)`."""

    sysidcurrent = 7

    def __init__(self, *, answer: bool) -> None:
        self.answer = answer
        self.sent: list[tuple[float, ...]] = []

    def doCommand(self, system_id: int, component_id: int, command: int, *parameters: float) -> bool:  # noqa: N802
        assert len(parameters) == 7
        self.sent.append((system_id, component_id, command, *parameters))
        return self.answer


def _run_script(text: str, planner: _MissionPlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    def to_byte(value: int) -> int:
        assert 0 <= value <= 255
        return value

    numbers = SimpleNamespace(USER_1=31010, USER_2=31011, USER_3=31012)
    for name, module in (
        ("clr", SimpleNamespace(AddReference=lambda assembly: None)),
        ("MAVLink", SimpleNamespace(MAV_CMD=numbers)),
        ("System", SimpleNamespace(Byte=to_byte)),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    exec(compile(text, SCRIPT.name, "exec"), {"MAV": planner})  # noqa: S102


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ("calibrate", Calibrate.of(What.BOTH)),
        ("gyros", Calibrate.of(What.GYROS)),
        ("accelerometers", Calibrate.of(What.ACCELEROMETERS)),
        ("calibrate and reboot", Calibrate.of(What.BOTH, reboot=True)),
        ("cancel", Cancel()),
        ("undo", Undo()),
    ],
)
def test_mission_planners_script_asks_the_companion_for_what_was_chosen(
    chosen: str, expected: Request, monkeypatch: pytest.MonkeyPatch
) -> None:
    planner = _MissionPlanner(answer=True)
    _run_script(SCRIPT.read_text().replace('DO = "calibrate"', f'DO = "{chosen}"'), planner, monkeypatch)
    ((system_id, component_id, command, *parameters),) = planner.sent
    assert (system_id, component_id) == (7, 191)
    assert judge(command_long(int(command), *parameters)) == expected


def test_mission_planners_script_is_python_2_too() -> None:
    """IronPython is: no annotations, no f-strings, `print` with one argument only."""
    for node in ast.walk(ast.parse(SCRIPT.read_text())):
        assert not isinstance(node, ast.JoinedStr | ast.AnnAssign | ast.NamedExpr)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
            assert len(node.args) == 1
            assert not node.keywords
    assert SCRIPT.read_text().isascii()
