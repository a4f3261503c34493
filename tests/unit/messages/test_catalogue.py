"""The catalogue of messages: complete, used, and shown to people.

A text of the code needs an entry, with two exceptions. It says itself what to do or what is being done
(`Message.explains_itself`), or a command prints it that somebody has just typed (`AT_A_DESK`).
"""

from __future__ import annotations

import ast
import runpy
import string

import pytest

from companion.cli import main
from companion.messages import Entry, catalogue, explain, search
from tests.support.messages import ROOT, Message, all_messages

AT_A_DESK = (
    "companion/cli", "companion/setup", "companion/lab", "companion/recording", "companion/fleet",
    "companion/estimation/solution/by_temperature.py", "companion/estimation/records/flight_record.py",
    "companion/summary.py", "companion/configured/models.py",
)  # fmt: skip
"""Packages of which commands print the texts, beside what was typed: their documents explain them."""

NOT_MESSAGES = {
    # Places where a position or a pose comes from, in records and over MQTT.
    "autopilot GLOBAL_POSITION_INT", "autopilot GPS_RAW_INT", "gradienter and compass", "gyros and accelerometers",
    "earlier calibrations",
    # Kinds of port in `companion ports`, of sender, of writer, of undo; names of parameters of a port.
    "USB device", "on-board port", "on-board port (…)", "autopilot of kind …", "MAVLink component …", "an undo",
    "SERIALn_PROTOCOL = 2, SERIALn_BAUD = …", "MAV_1_CONFIG = 102, SER_TEL2_BAUD = …", "SYS_HAS_MAG = 0",
    # Sides of an aircraft, of which a request is made; names of tasks in the log, and keys.
    "on its back", "… with … half …", "MAVLink component", "MAVLink connection", "the page's", "airframe changed",
    "Operation timed out",  # Recognises an error of the operating system.
    # Complete in themselves: nothing to do, or said by what the person has just asked for.
    "whole numbers", "… of … s were not still and are left out", "no noise profile … (known: …)", "nothing measured",
    "there is no IMU of the autopilot: none is configured", "the configuration's zero and sigma are active",
    "there was no zero to forget", "the companion ends", "starts with companion run", "nose up", "nose down",
    "left side down", "right side down", "… (after … more like this, left out)", "TURN IT", "PUT IT DOWN", "HOLD STILL",
    ": type companion fix",
    "the board would sit more than 10 deg askew: no level is for that", "learned from … h at rest in …, saved …",
    "before this start", "steady to … deg",
}  # fmt: skip

PATTERNS = [pattern for entry in catalogue().values() for pattern in entry.patterns]


@pytest.fixture(scope="module")
def said() -> list[Message]:
    """All texts of the code that do not come from the catalogue."""
    return all_messages()


def is_explained(message: Message, rows_shown: list[str]) -> bool:
    """Return True where a row shows words of the message, or of a message composed with it."""
    return any(message.has(shown) or message.is_in(shown) for shown in rows_shown)


def test_every_text_that_leaves_something_open_is_in_the_catalogue(said: list[Message]) -> None:
    missing = {
        message.shown(): message.where
        for message in said
        if message.shown() not in NOT_MESSAGES
        and not message.explains_itself()
        and not message.where.startswith(AT_A_DESK)
        and not is_explained(message, PATTERNS)
    }
    assert not missing, "add these to companion/messages:\n" + "\n".join(f"{w}: {s}" for s, w in missing.items())


def test_every_other_text_of_the_catalogue_can_be_said(said: list[Message]) -> None:
    also = {pattern for entry in catalogue().values() for pattern in entry.also}
    stale = {pattern for pattern in also if not any(is_explained(message, [pattern]) for message in said)}
    assert stale == set()


def calls() -> list[tuple[str, ast.Call]]:
    return [
        (f"{path.relative_to(ROOT)}:{node.lineno}", node)
        for path in sorted((ROOT / "companion").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "message"
    ]


def test_every_call_names_a_message_and_exactly_its_fields() -> None:
    wrong = []
    for where, call in calls():
        name = call.args[0].value if len(call.args) == 1 and isinstance(call.args[0], ast.Constant) else None
        entry = catalogue().get(str(name))
        if entry is None or {keyword.arg for keyword in call.keywords} != set(fields(entry.text)):
            wrong.append(f"{where}: {ast.unparse(call)}")
    assert wrong == []


def test_every_text_is_used() -> None:
    assert len(catalogue()) <= 250
    used = {call.args[0].value for _, call in calls() if isinstance(call.args[0], ast.Constant)}
    assert {name for name, entry in catalogue().items() if entry.text} == used


def fields(text: str) -> dict[str, str]:
    """The fields of a text with what the caller leaves to the catalogue: a format or a conversion."""
    parts = string.Formatter().parse(text)
    return {name: f"{form or ''}{conversion or ''}" for _, name, form, conversion in parts if name is not None}


@pytest.mark.parametrize(("name", "entry"), catalogue().items(), ids=catalogue())
def test_an_entry_is_whole(name: str, entry: Entry) -> None:
    assert entry.patterns
    assert entry.cause if entry.do == "nothing" else entry.remedy
    assert not any(fields(entry.text).values()), "fields are formatted by the caller"
    assert len(f"{entry.cause} {entry.remedy}".split()) <= 60


def test_the_page_is_that_of_the_catalogue() -> None:
    made = runpy.run_path(str(ROOT / "packaging/messages.py"))["page"]()
    assert (ROOT / "docs/messages.md").read_text(encoding="utf-8") == made, "make messages"
    assert len(made.split()) <= 6000


@pytest.mark.parametrize("name", catalogue())
def test_a_line_with_its_values_is_found_again(name: str) -> None:
    """The line is as a pilot would copy it: behind its speaker, with values in the places of fields."""
    for pattern in catalogue()[name].patterns:
        if len(pattern.replace("…", "").strip()) >= 8:
            assert explain(f"Not armed: {pattern.replace('…', '12.5')}") is not None


def test_words_find_their_message_in_any_order_and_with_a_slip() -> None:
    for words in ("restore pending", "pending restore", "restor pendng", "RESTORE PENDING: disarm"):
        assert search(words)[0][0] == "restore_pending", words
    assert search("restore_pending")[0][0] == "restore_pending"
    for words, name in (("prearm denied", "script_silent"), ("boat", "slow_turn"), ("failsafe", "safety_net")):
        assert not set(words.split()) & set(" ".join((*catalogue()[name].patterns, catalogue()[name].cause)).split())
        assert name in dict(search(words, 250))


def test_explain_names_the_way_on_when_no_message_matches(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "xyzzy"]) != 0
    assert "Type the line from the screen, or find the topic in docs/index.md" in capsys.readouterr().out
