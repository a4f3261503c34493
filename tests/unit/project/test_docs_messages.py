"""docs/messages.md explains what a message leaves open, and nothing that the code cannot say.

A row shows words of messages. A message needs a row unless its own text says what to do or what is being done
(`Message.explains_itself`), or it is printed by a command that somebody has just typed (`AT_A_DESK`).
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.messages import ROOT, Message, all_messages

GUIDE = ROOT / "docs/messages.md"
TROUBLE = ROOT / "docs/troubleshooting.md"
ALSO = ROOT / "docs/service.md"

AT_A_DESK = (
    "companion/cli", "companion/setup", "companion/lab", "companion/recording", "companion/fleet",
    "companion/estimation/solution/by_temperature.py", "companion/estimation/records/flight_record.py",
    "companion/summary.py", "companion/configured/models.py",
)  # fmt: skip
"""Packages of which commands print the texts, beside what was typed: their documents explain them."""

NOT_MESSAGES = {
    # Places where a position or a pose comes from, in records and over MQTT.
    "autopilot GLOBAL_POSITION_INT", "autopilot GPS_RAW_INT", "configuration; height: …", "…; height: configuration",
    "gradienter and compass", "gyros and accelerometers", "compass and gyros", "earlier calibrations",
    # Kinds of port in `companion ports`, of sender, of writer, of undo; names of parameters of a port.
    "USB device", "on-board port", "on-board port (…)", "autopilot of kind …", "MAVLink component …",
    "last write", "an undo", "at a start", "after a flight", "SERIALn_PROTOCOL = 2, SERIALn_BAUD = …",
    "MAV_1_CONFIG = 102, SER_TEL2_BAUD = …", "LOG_BITMASK with IMU_FAST",
    "SYS_HAS_MAG = 0", "EKF2_MAG_TYPE = …", "bit 10 of EKF2_SENS_EN",
    # Sides of an aircraft, of which a request is made.
    "on its back", "between … and …",
    # Names of tasks in the log, and keys.
    "MAVLink component", "MAVLink connection", "the page's", "airframe changed",
    # Recognises an error of the operating system.
    "Operation timed out",
    # Complete in themselves: nothing to do, or said by what the person has just asked for.
    "EKF2 believes the companion's heading beside its magnetometer, and resets to it where the two disagree",
    "whole numbers", "… of … s were not still and are left out", "no noise profile … (known: …)", "nothing measured",
    "there is no IMU of the autopilot: none is configured", "the configuration's zero and sigma are in force",
    "there was no alignment to forget", "one of them", "the companion ends", "starts with companion run",
    "a ground station is heard; it reaches the companion as component 191 of this vehicle",
    "nothing is being recorded on request",
    "nose up", "nose down", "left side down", "right side down", "… (after … more like this, left out)",
    "the board would sit more than 10 deg askew: no level is for that", "learned from … h at rest in …, saved …",
}  # fmt: skip

PUT_TOGETHER = {
    # The kind of job and its outcome; the reason after the colon has a row of its own.
    "Calibration done: …", "Calibration failed: …", "FAULT: …",
}  # fmt: skip
"""Rows that are not one text of the code."""


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
    """All messages of the code."""
    return all_messages()


def is_explained(message: Message, rows_shown: list[str]) -> bool:
    """Whether a row shows words of the message, or of a message it is composed with."""
    return any(message.has(shown) or message.is_in(shown) for shown in rows_shown)


def test_every_message_that_leaves_something_open_is_explained(said: list[Message]) -> None:
    missing = {
        message.shown(): message.where
        for message in said
        if message.shown() not in NOT_MESSAGES
        and not message.explains_itself()
        and not message.where.startswith(AT_A_DESK)
        and not is_explained(message, SHOWN)
    }
    assert not missing, "explain these in docs/messages.md:\n" + "\n".join(f"{w}: {s}" for s, w in missing.items())


def test_every_message_that_is_explained_can_be_said(said: list[Message]) -> None:
    lines = {line for path in (GUIDE, TROUBLE) for messages, _ in rows(path) for line in messages}
    stale = {line for line in lines if not any(is_explained(message, [line]) for message in said)}
    assert stale == PUT_TOGETHER
