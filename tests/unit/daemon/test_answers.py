"""Requests that ask for what there is not, and the table of commands, on the daemon's answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from companion.commands import ALL, Interface
from companion.config import parse
from companion.daemon.process.service import Service
from companion.errors import CompanionError
from tests.support.mqtt_daemon import ALONE

pytestmark = pytest.mark.real_clock

SECONDS = "a number of seconds above 0"
WRONG = [
    *(
        (command, key, seconds, SECONDS)
        for command, key in (("calibrate", "timeout_s"), ("align", "timeout_s"), ("record", "seconds"))
        for seconds in (float("nan"), -5, 0, float("inf"), 10**400, True, "60", [1])
    ),
    ("calibrate", "what", "nothing", '"both", "gyros", "accelerometers"'),
    ("calibrate", "reboot", 1, "true or false"),
    ("align", "headings", 5, "1, 2, 3, 4, 6, 8"),
    ("history", "limit", 0, "a whole number from 1 to 1000000"),
    ("record", "file", 5, "a path"),
]


def service(folder: Path) -> Service:
    return Service(parse(ALONE.format(folder=folder, more=""), "test.toml"))


@pytest.mark.parametrize(("command", "key", "value", "allowed"), WRONG)
async def test_a_value_that_is_not_allowed_is_refused_in_one_line(
    tmp_path: Path, command: str, key: str, value: Any, allowed: str
) -> None:
    with pytest.raises(CompanionError) as caught:
        async for _ in service(tmp_path).faces.answer({"command": command, key: value}):
            pass
    words = str(caught.value)
    assert words.startswith(f"{command}: {key!r}: found ")
    assert words.endswith(f"; allowed: {allowed}")
    assert "\n" not in words


async def test_every_command_of_the_table_is_answered_and_no_other(tmp_path: Path) -> None:
    """All but `answer`, which the page asks where there is no daemon yet."""
    running = service(tmp_path)
    subsystems = (running.calibrating, running.arming, running.heading, running.recorder)
    handled = {name for subsystem in subsystems for name in subsystem.commands()}
    assert handled | {"status", "monitor", "fix"} == ALL.keys() - {"answer"}


def test_pages_and_brokers_may_not_ask_for_everything() -> None:
    """The rights of a client that is not at the companion's own terminal: docs/security.md."""
    by = {each: {name for name, kind in ALL.items() if each in kind.by} for each in Interface}
    assert by[Interface.MQTT] == {"calibrate", "cancel", "undo"}
    assert by[Interface.PAGE] == {"calibrate", "align", "fix", "cancel", "undo", "answer"}
    assert set(ALL["calibrate"].fields(Interface.PAGE)) == {"what"}
    assert set(ALL["align"].fields(Interface.PAGE)) == {"action", "headings", "heading", "sides", "write", "level"}
