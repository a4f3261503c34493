"""STATUSTEXT: lines as an independent receiver has them, limits, and what is dropped."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.component import ArmingScript
from companion.component.own_parameters import Parameter
from companion.component.service import ArmAnswer
from companion.component.statustext import GOES_ON, Severity, StatusText, Weight, as_lines, to_ascii
from companion.links.mavlink.link import MavlinkLink
from tests.support.component import Ground, ScriptedGate, bench
from tests.support.messages import FILLED, all_messages


def said(ground: Ground) -> list[tuple[int, str]]:
    """Severity and text on the wire, by the letter of the message's definition."""
    found = []
    for raw in ground.raw:
        assert raw[0] == 0xFD
        if int.from_bytes(raw[7:10], "little") == 253:
            payload = raw[10 : 10 + raw[1]].ljust(54, b"\0")
            assert payload[51:] == b"\0\0\0", "no line is a part of another"
            found.append((payload[0], payload[1:51].partition(b"\0")[0].decode("ascii")))
    return found


def texts(ground: Ground) -> list[str]:
    return [text for _, text in said(ground)]


def put_together(lines: list[str]) -> str:
    return " ".join([lines[0], *(line.removeprefix(GOES_ON) for line in lines[1:])])


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 101, 149, 150, 199])
async def test_texts_of_every_length_arrive_whole(length: int) -> None:
    text = ("some words: and more, " * 10)[:length].strip()
    async with bench() as b:
        b.texts.say(Severity.INFO, text)
        await asyncio.sleep(3)
        assert put_together(texts(b.ground)) == text
        assert (len(texts(b.ground)) == 1) == (length <= 50)


@settings(max_examples=300)
@given(st.sampled_from(Severity), st.text(st.characters(codec="ascii"), max_size=300))
def test_any_text_is_cut_into_lines_that_can_be_put_together(severity: Severity, text: str) -> None:
    text = to_ascii(text)
    lines = as_lines(severity, text)
    assert all(0 < len(line) <= 50 for _, line in lines)
    assert len(lines) <= 5
    assert [at for at, _ in lines] == [severity, *[max(severity, Severity.INFO)] * len(lines)][: len(lines)]
    whole = "".join([line.removeprefix(GOES_ON) if number else line for number, (_, line) in enumerate(lines)])
    if not lines[4:]:
        assert whole.replace(" ", "") == text.replace(" ", "")


FIELDS = ("gradienter", "-123456.7", "INS_GYROFFS_X, INS_GYROFFS_Y, INS_GYROFFS_Z")
"""The longest that is filled in as a rule: a name, a figure, a list of parameters."""


@pytest.mark.parametrize("field", FIELDS)
def test_every_text_of_the_code_is_cut_between_words_wherever_it_is_shown(field: str) -> None:
    """In lines of STATUSTEXT, and as ArduPilot's reason not to arm, which its script gets by TUNNEL."""
    texts = {to_ascii(message.template.replace(FILLED, field)) for message in all_messages()}
    assert len(texts) > 500
    for text in texts:
        for severity in Severity:
            lines = [line for _, line in as_lines(severity, text)]
            assert all(len(line) <= 50 for line in lines), text
            assert begins(text, put_together(lines).removesuffix(" ..."), 46), lines
        reason = sent_to_script(text)
        assert len(f"Arm: Companion: {reason}") <= 50
        assert begins(text, reason, 30), reason


def begins(text: str, shown: str, most: int) -> bool:
    """Return True where `shown` is the first words of a text, or the beginning of a word longer than a line."""
    words, first = ([word.rstrip(":;,") for word in each.split()] for each in (text, shown))
    return words[: len(first)] == first or any(len(word) > most for word in words)


def sent_to_script(text: str) -> str:
    link, ground, gate = MavlinkLink(), Ground(), ScriptedGate()
    link.join((1, 1))
    gate.asks_script, gate.says = True, ArmAnswer("wait", text)
    link.attach(lambda data: ground.receive(data, 0.0))
    ArmingScript(link, gate).step(0.0)
    (message,) = [message for _, message in ground.received]
    assert isinstance(message, mavlink.MAVLink_tunnel_message)
    return bytes(message.payload[6 : message.payload_length]).decode("ascii")


@pytest.mark.parametrize(
    ("severity", "text", "heard"),
    [
        (Severity.NOTICE, "Calibration done: sigma 4.7 deg/h, 0.13 mg", "Calibration done:"),
        (Severity.NOTICE, "Armed: calibrated 3 min ago, 4.7 deg/h", "Armed: calibrated 3 min ago,"),
        (
            Severity.NOTICE,
            "2 of 12: on its back: one pose does not fit, this one shows which",
            "2 of 12: on its back: one pose does not fit,",
        ),
        (Severity.NOTICE, "2 of 3: turn it by 180 degrees, onto its marks", None),
        (Severity.WARNING, "Before flight: reboot PX4: tilt 1.2 deg off", None),
        (
            Severity.WARNING,
            "The gradienter has moved by 0.31 deg (x +0.25, y -0.18): all accelerometers (fc, own) show this change",
            "The gradienter has moved by 0.31 deg",
        ),
        (
            Severity.ERROR,
            "Calibration failed: armed during the measurement; nothing was written",
            "Calibration failed: armed during the measurement;",
        ),
        (
            Severity.ERROR,
            "no pause in it however long it goes on and on and on",
            "no pause in it however long it goes on and on and",
        ),
    ],
)
async def test_what_is_heard_is_one_line_that_ends_at_a_pause(severity: Severity, text: str, heard: str | None) -> None:
    async with bench() as b:
        b.texts.say(severity, text)
        await asyncio.sleep(5)
        assert said(b.ground)[0] == (severity, heard or text)
        assert [at for at, _ in said(b.ground)[1:]] == [Severity.INFO] * (len(said(b.ground)) - 1)
        assert put_together(texts(b.ground)) == text
        assert [one["text"] for one in b.texts.spoken] == [heard or text]


def test_a_text_too_long_loses_its_tail_and_says_so() -> None:
    lines = [line for _, line in as_lines(Severity.INFO, "word " * 1000)]
    assert len(lines) == 5
    assert lines[-1].endswith(" ...")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("gyro 0.31°/s", "gyro 0.31 deg/s"),
        ("σ ± 3 m/s² – café", "sigma +- 3 m/s^2 - cafe"),
        ("two\nlines\tand\0more", "two lines and?more"),
        ("  spaces   inside ", "spaces inside"),
        ("火", "?"),
    ],
)
def test_text_becomes_plain_ascii(text: str, expected: str) -> None:
    assert to_ascii(text) == expected


async def test_a_request_cancelled_and_made_again_at_once_is_heard_to_start_again() -> None:
    async with bench() as b:
        story = ["Calibration started", "Calibration cancelled", "Calibration started", "Calibration cancelled"]
        for text in story:
            weight = Weight.RESULT if text.endswith("cancelled") else Weight.NEWS
            assert b.texts.say(Severity.NOTICE, text, weight)
            await asyncio.sleep(0.3)
        await asyncio.sleep(1.0)
        assert texts(b.ground) == story


async def test_repeats_within_seconds_are_said_once() -> None:
    async with bench() as b:
        said = []
        for _ in range(9):
            said.append(b.texts.say(Severity.INFO, "again"))
            await asyncio.sleep(1)
        assert said == [True, False, False] * 3
        assert b.ground.texts() == ["again"] * 3
        assert b.texts.say(Severity.WARNING, "again"), "another severity is another text"


async def test_lines_per_second_are_bounded_and_nothing_within_the_bounds_is_lost() -> None:
    async with bench() as b:
        for i in range(16):
            b.texts.say(Severity.INFO, f"text {i}")
        await asyncio.sleep(10)
        assert b.ground.texts() == [f"text {i}" for i in range(16)]
        times = b.ground.times("STATUSTEXT")
        assert times[7] - times[0] < 0.1
        for count, said_s in enumerate(times, start=1):
            assert count <= 8 + 2 * (said_s - times[0]) + 0.1, "more than the burst and two a second"
        assert times[-1] - times[0] < 4.1


async def test_a_flood_of_news_and_refusals_cannot_push_out_a_result() -> None:
    async with bench() as b:
        for i in range(1000):
            b.texts.say(Severity.INFO, f"news {i}")
        b.texts.say(Severity.NOTICE, "the result", Weight.RESULT)
        for i in range(1000):
            b.texts.say(Severity.WARNING, f"refused {i}", Weight.REFUSAL)
        assert len(b.texts._waiting) == 16
        await asyncio.sleep(30)
        texts = b.ground.texts()
        assert texts[0] == "the result"
        assert texts[1:] == [f"refused {i}" for i in range(985, 1000)]


async def test_news_do_not_push_out_refusals() -> None:
    async with bench() as b:
        for i in range(16):
            assert b.texts.say(Severity.WARNING, f"refused {i}", Weight.REFUSAL)
        assert not b.texts.say(Severity.INFO, "news")
        await asyncio.sleep(30)
        assert b.ground.texts() == [f"refused {i}" for i in range(16)]


async def test_what_waited_for_a_link_until_it_was_stale_is_not_said_but_results_are() -> None:
    link, ground = MavlinkLink(), Ground()
    texts = StatusText(link)
    texts.say(Severity.INFO, "old news")
    texts.say(Severity.NOTICE, "result", Weight.RESULT)
    assert texts.step(1000.0) == math.inf
    await asyncio.sleep(60)
    texts.say(Severity.INFO, "fresh news")
    link.attach(lambda data: ground.receive(data, 0.0))
    assert texts.step(1060.0) == math.inf
    assert ground.texts() == ["result", "fresh news"]


async def test_nothing_to_say_is_not_said() -> None:
    async with bench() as b:
        assert not b.texts.say(Severity.INFO, " \n ")
        await asyncio.sleep(1)
        assert b.ground.texts() == []


async def test_a_full_transport_delays_texts_and_values_but_loses_none() -> None:
    parameters = [Parameter(name, 0, 0, 9) for name in ("CMP_A", "CMP_B", "CMP_C")]
    async with bench(parameters=parameters) as b:
        await asyncio.sleep(0.1)
        transmit = b.link._transmit
        b.link.attach(lambda data: False)
        b.texts.say(Severity.NOTICE, "x", Weight.RESULT)
        for name in ("CMP_A", "CMP_B", "CMP_C"):
            b.component.parameters.set(name, 5)
        await asyncio.sleep(5)
        assert b.ground.texts() == []
        b.link.attach(transmit)
        await asyncio.sleep(1)
        assert texts(b.ground) == ["x"]
        assert len(b.ground.times("PARAM_VALUE")) == 3
