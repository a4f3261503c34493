"""docs/messages.md explains every line that the code can say, and no line that it cannot."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.messages import ROOT, Message, all_messages, in_lua, in_source

GUIDE = ROOT / "docs/messages.md"
TROUBLE = ROOT / "docs/troubleshooting.md"
ALSO = ROOT / "docs/service.md"

NOT_MESSAGES = {
    # Places where a position or a pose comes from, in records and over MQTT.
    "autopilot GLOBAL_POSITION_INT", "autopilot GPS_RAW_INT", "configuration; height: …", "…; height: configuration",
    "gradienter and compass", "gyros and accelerometers", "compass and gyros", "earlier calibrations",
    # Kinds of port in `companion ports`.
    "USB device", "on-board port", "on-board port (…)",
    # Headings and labels of `status`, `history`, `calibrate` and `check`.
    "started (UTC)", "armed (UTC)", "last calibration: …",
    "pitch …  roll …  heading …", "NOT ready", "not yet", "… … in force", "in force: …",
    "ground stations: …", "ground stations", "at arming (…): …", "… … … … …  what came of it", "; … parameters written",
    "an undo",
    # Names of tasks, in the line of the watchdog, and of what failed, in the log.
    "MAVLink component", "MAVLink connection", "automatic calibration", "the page's",
    # When a rival acts, and whether a rival does: keys, not words for people.
    "at a start", "while still", "after a flight",
    # A key of what a fleet is told.
    "airframe changed",
    # A key of `counts` in `status --json`: its words have a row.
    "clock back",
    # What an error of the operating system is recognised by.
    "Operation timed out",
}  # fmt: skip

PUT_TOGETHER = {
    # The kind of job and how it ended, or who speaks; what follows has rows of its own.
    "1 of 3: …", "Calibration done: …", "Calibration failed: …",
    "… refused: …", "… refused: internal error, see the log",
    "Companion: …", "FAULT: …", "fleet: …: …", "waiting: …", "running, idle",
    # Too few words of its own to be looked for in the code.
    "IMU …: gyro residual x is …", "calibrate",
    "a … is running (…)", "… restarted …", "… restarted (…)", "… refuses … = …: …",
}  # fmt: skip
"""Rows that show what no single text of the code is."""


def rows(path: Path) -> list[tuple[list[str], str]]:
    """Messages and meaning of each row of the tables."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        cells = re.split(r"(?<!\\)\|", line.strip().strip("|"))
        if line.startswith("|") and len(cells) == 2 and (shown := re.findall(r"`([^`]+)`", cells[0])):
            found.append((shown, cells[1].strip()))
    return found


SHOWN = [shown for path in (GUIDE, TROUBLE, ALSO) for messages, _ in rows(path) for shown in messages]


@pytest.fixture(scope="module")
def said() -> list[Message]:
    """All that the code can say."""
    return all_messages()


def undocumented(messages: list[Message]) -> dict[str, str]:
    """Those that no row shows: template and place."""
    wanted = {message.shown(): message for message in messages if message.shown() not in NOT_MESSAGES}
    return {shown: message.where for shown, message in wanted.items() if not any(message.is_in(line) for line in SHOWN)}


def test_every_message_of_the_code_is_explained(said: list[Message]) -> None:
    missing = undocumented(said)
    assert not missing, "explain these in docs/messages.md:\n" + "\n".join(f"{w}: {s}" for s, w in missing.items())


def test_every_message_that_is_explained_can_be_said(said: list[Message]) -> None:
    lines = {line for path in (GUIDE, TROUBLE) for messages, _ in rows(path) for line in messages}
    stale = {line for line in lines if not any(message.is_in(line) for message in said)}
    assert stale == PUT_TOGETHER


def test_every_row_says_what_to_do() -> None:
    empty = [messages for path in (GUIDE, TROUBLE) for messages, meaning in rows(path) if len(meaning) < 8]
    assert empty == []
    assert len(rows(GUIDE)) > 100


def test_what_is_left_out_is_still_said_somewhere(said: list[Message]) -> None:
    assert {message.shown() for message in said} >= NOT_MESSAGES


@pytest.mark.parametrize(
    "source",
    [
        'self._say(Severity.WARNING, f"Wobble in {name}", Weight.NEWS)',
        'raise AutopilotError(f"{name} wobbles without end")',
        'logger.warning("%s wobbles without end", name)',
        'return ArmAnswer("wait", "wobbling: wait")',
        'words = "so far it wobbles" if bad else ""',
        'found.append(f"{count} wobbles " f"in {seconds:.0f} s")',
        'class Why(enum.Enum):\n    WOBBLE = "the thing wobbles"',
    ],
)
def test_a_new_message_would_be_missed(source: str) -> None:
    assert len(undocumented(in_source(source, "new.py"))) == 1


def test_a_new_message_of_the_script_would_be_missed() -> None:
    assert len(undocumented(in_lua('arming:set_aux_auth_failed(id, "Companion: wobbling")', "new.lua"))) == 1


@pytest.mark.parametrize(
    "source",
    [
        '"""Words of a docstring."""',
        'logger.info("all goes well with %s", name)',
        'raise ValueError("a fault of the program")',
        'group.create_task(run(), name="some long task")',
    ],
)
def test_what_is_not_for_people_needs_no_row(source: str) -> None:
    assert in_source(source, "new.py") == []
