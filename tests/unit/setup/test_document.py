"""Values are changed in the text of a configuration; what people wrote around them stays."""

from __future__ import annotations

import copy
import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import parse
from companion.errors import CompanionError, ConfigError
from companion.protocols.guess import Line
from companion.setup.document import render
from companion.setup.draft import Draft, sample

SAMPLE = sample()
OWN = """# Of the heron.
[mavlink]
url = "udpin:127.0.0.1:14550"  # the router's
allow = ["255"]

[[imu]]
name = "fc"
source = "autopilot"
# This one hangs upside down.
[gradienter]
port = "/dev/tilt"
protocol = "inclinometer_xy"
law = "slope"      # measured in May
offset_deg = [0.1, -0.2]
sigma_deg = 0.02
[mqtt]
host = "box"
"""
TILT = ("/dev/tilt", "inclinometer_xy", Line(9600, "even"))


def comments(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("# ")]


def test_what_says_it_already_is_left_alone() -> None:
    for text in (SAMPLE, OWN):
        assert render(text, tomllib.loads(text)) == text


values = st.one_of(
    st.booleans(),
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(blacklist_categories=("Cc", "Cs")), max_size=12),
    st.lists(st.floats(-360, 360), max_size=3),
)


@given(
    st.dictionaries(
        st.sampled_from(["mavlink", "gradienter", "compass", "vehicle", "mqtt", "web", "storage", "unheard_of"]),
        st.dictionaries(st.sampled_from(["port", "law", "baud", "bind", "host", "sigma_deg", "x"]), values, max_size=4),
        max_size=5,
    ),
    st.lists(st.dictionaries(st.sampled_from(["name", "source", "port", "instance"]), values), max_size=3),
)
def test_any_content_can_be_had_and_no_word_of_explanation_is_lost(
    sections: dict[str, Any], imus: list[dict[str, Any]]
) -> None:
    for text in (SAMPLE, OWN):
        wanted = copy.deepcopy(tomllib.loads(text)) | sections
        wanted["imu"] = [*wanted["imu"], *imus]
        result = render(text, wanted)
        assert tomllib.loads(result) == wanted
        assert [line for line in comments(result) if line in comments(text)] == comments(text)


def test_a_file_that_is_not_written_line_by_line_is_refused() -> None:
    text = 'mavlink = { url = "udpin:0.0.0.0:1" }\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
    wanted = tomllib.loads(text)
    wanted["mavlink"]["url"] = "udpin:0.0.0.0:2"
    with pytest.raises(CompanionError, match="line by line"):
        render(text, wanted)


def test_a_device_that_is_there_again_keeps_what_its_owner_has_said_of_it() -> None:
    draft = Draft(OWN, is_new=False)
    draft.take("gradienter", *TILT)
    found = parse(draft.result(), "f").gradienter
    assert found is not None
    assert (found.parity, found.law, found.offset_deg, found.sigma_deg) == ("even", "slope", (0.1, -0.2), 0.02)
    assert 'law = "slope"      # measured in May\n' in draft.result()
    assert draft.guessed == set()


@pytest.mark.parametrize(
    ("answer", "meant"),
    [
        ("0", None),
        ("90", "ROTATION_YAW_90"),
        ("-90", "ROTATION_YAW_270"),
        ("yaw 180", "ROTATION_YAW_180"),
        ("rotation_yaw_45", "ROTATION_YAW_45"),
        ("12.5", [0, 0, 12.5]),
        ("1 2, 3", [1, 2, 3]),
        ("[1, 2, 3]", [1, 2, 3]),
    ],
)
def test_a_mounting_as_people_type_it(answer: str, meant: object) -> None:
    draft = Draft(OWN, is_new=False)
    (question,) = [one for one in draft.questions() if one.key == "gradienter.mounting"]
    question.put(answer)
    assert tomllib.loads(draft.result())["gradienter"].get("mounting") == meant
    (again,) = [one for one in draft.questions() if one.key == "gradienter.mounting"]
    again.put(again.now)
    assert tomllib.loads(draft.result())["gradienter"].get("mounting") == meant, "what is shown can be typed"


@pytest.mark.parametrize("answer", ["left", "1 2", "nan", "ROTATION_ROLL_180", "1e9", "", "\x1b[2J"])
def test_what_is_no_mounting_changes_nothing_and_is_one_line(answer: str) -> None:
    draft = Draft(OWN, is_new=False)
    (question,) = [one for one in draft.questions() if one.key == "gradienter.mounting"]
    with pytest.raises(ConfigError, match="allowed: ") as caught:
        question.put(answer)
    assert "\n" not in str(caught.value)
    assert draft.result() == OWN
