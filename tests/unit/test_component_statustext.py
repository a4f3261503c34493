"""STATUSTEXT: chunks as an independent receiver puts them together, limits, and what is dropped."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.own_parameters import Parameter
from companion.component.statustext import Severity, StatusText, Weight, split_chunks, to_ascii
from companion.links.mavlink.link import MavlinkLink
from tests.support.component import Ground, bench
from tests.support.virtual_time import run_virtual


def put_together(lines: list[tuple[bytes, int, int]]) -> list[str]:
    """A receiver by the letter of the message's definition: (text[50], id, chunk_seq) to whole texts."""
    done: list[str] = []
    parts: dict[int, list[bytes]] = {}
    for field, text_id, sequence in lines:
        assert len(field) == 50
        words, _, _ = field.partition(b"\0")
        if text_id == 0:
            assert sequence == 0
            done.append(words.decode("ascii"))
            continue
        assert sequence == len(parts.setdefault(text_id, []))
        parts[text_id].append(words)
        if b"\0" in field:
            done.append(b"".join(parts.pop(text_id)).decode("ascii"))
    assert parts == {}
    return done


def statustexts(ground: Ground) -> list[tuple[bytes, int, int]]:
    """What is on the wire: the payloads, padded again as the receiver pads them."""
    found = []
    for raw in ground.raw:
        assert raw[0] == 0xFD
        if int.from_bytes(raw[7:10], "little") == 253:
            payload = raw[10 : 10 + raw[1]].ljust(54, b"\0")
            found.append((payload[1:51], int.from_bytes(payload[51:53], "little"), payload[53]))
    return found


@pytest.mark.parametrize("length", [1, 49, 50, 51, 99, 100, 101, 149, 150, 199])
def test_texts_of_every_length_arrive_whole(length: int) -> None:
    text = "".join(chr(ord("!") + i % 90) for i in range(length))

    async def main() -> None:
        async with bench() as b:
            b.texts.say(Severity.INFO, text)
            await asyncio.sleep(3)
            lines = statustexts(b.ground)
            assert put_together(lines) == [text]
            assert (lines[0][1] == 0) == (length <= 50)

    run_virtual(main())


def test_a_text_too_long_loses_its_tail_and_says_so() -> None:
    async def main() -> None:
        async with bench() as b:
            b.texts.say(Severity.INFO, "x" * 5000)
            await asyncio.sleep(3)
            (text,) = put_together(statustexts(b.ground))
            assert text == "x" * 196 + "..."

    run_virtual(main())


@settings(max_examples=300)
@given(st.text(max_size=300))
def test_any_text_is_cut_into_chunks_that_can_be_put_together(text: str) -> None:
    chunks = split_chunks(text)
    lines = [(chunk.ljust(50, b"\0"), int(len(chunks) > 1), i) for i, chunk in enumerate(chunks)]
    (whole,) = put_together(lines)
    expected = to_ascii(text)
    assert whole == expected or (whole == expected[:196] + "..." and len(expected) > 199)
    assert len(chunks) <= 4


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


def test_severity_is_kept_and_ids_differ() -> None:
    async def main() -> None:
        async with bench() as b:
            for severity in Severity:
                b.texts.say(severity, "a" * 60 + severity.name)
                await asyncio.sleep(5)
            messages = [m for _, m in b.ground.received if isinstance(m, mavlink.MAVLink_statustext_message)]
            assert [m.severity for m in messages] == [s for severity in Severity for s in (severity, severity)]
            assert len({m.id for m in messages}) == len(Severity)
            assert 0 not in {m.id for m in messages}

    run_virtual(main())


def test_a_request_cancelled_and_made_again_at_once_is_heard_to_start_again() -> None:
    async def main() -> None:
        async with bench() as b:
            story = ["Calibration started", "Calibration cancelled", "Calibration started", "Calibration cancelled"]
            for text in story:
                weight = Weight.RESULT if text.endswith("cancelled") else Weight.NEWS
                assert b.texts.say(Severity.NOTICE, text, weight)
                await asyncio.sleep(0.3)
            await asyncio.sleep(1.0)
            assert put_together(statustexts(b.ground)) == story

    run_virtual(main())


def test_repeats_within_seconds_are_said_once() -> None:
    async def main() -> None:
        async with bench() as b:
            said = []
            for _ in range(9):
                said.append(b.texts.say(Severity.INFO, "again"))
                await asyncio.sleep(1)
            assert said == [True, False, False] * 3
            assert b.ground.texts() == ["again"] * 3
            assert b.texts.say(Severity.WARNING, "again"), "another severity is another text"

    run_virtual(main())


def test_lines_per_second_are_bounded_and_nothing_within_the_bounds_is_lost() -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_a_flood_of_news_and_refusals_cannot_push_out_a_result() -> None:
    async def main() -> None:
        async with bench() as b:
            for i in range(1000):
                b.texts.say(Severity.INFO, f"news {i}")
            b.texts.say(Severity.NOTICE, "the result", Weight.RESULT)
            for i in range(1000):
                b.texts.say(Severity.WARNING, f"refused {i}", Weight.REFUSAL)
            waiting = b.texts._waiting.values()
            assert sum(len(texts) for texts in waiting) == 16
            await asyncio.sleep(30)
            texts = b.ground.texts()
            assert texts[0] == "the result"
            assert texts[1:] == [f"refused {i}" for i in range(985, 1000)]
            assert len(b.texts._said_s) <= 32

    run_virtual(main())


def test_news_do_not_push_out_refusals() -> None:
    async def main() -> None:
        async with bench() as b:
            for i in range(16):
                assert b.texts.say(Severity.WARNING, f"refused {i}", Weight.REFUSAL)
            assert not b.texts.say(Severity.INFO, "news")
            await asyncio.sleep(30)
            assert b.ground.texts() == [f"refused {i}" for i in range(16)]
            assert b.texts.dropped == 1

    run_virtual(main())


def test_what_waited_for_a_link_until_it_was_stale_is_not_said_but_results_are() -> None:
    async def main() -> None:
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
        assert texts.dropped == 1

    run_virtual(main())


def test_nothing_to_say_is_not_said() -> None:
    async def main() -> None:
        async with bench() as b:
            assert not b.texts.say(Severity.INFO, " \n ")
            await asyncio.sleep(1)
            assert b.ground.texts() == []

    run_virtual(main())


def test_a_full_transport_delays_texts_and_values_but_loses_none() -> None:
    async def main() -> None:
        parameters = [Parameter(name, 0, 0, 9) for name in ("CMP_A", "CMP_B", "CMP_C")]
        async with bench(parameters=parameters) as b:
            await asyncio.sleep(0.1)
            transmit = b.link._transmit
            b.link.attach(lambda data: False)
            b.texts.say(Severity.NOTICE, "x" * 120, Weight.RESULT)
            for name in ("CMP_A", "CMP_B", "CMP_C"):
                b.component.parameters.set(name, 5)
            await asyncio.sleep(5)
            assert b.ground.texts() == []
            b.link.attach(transmit)
            await asyncio.sleep(1)
            assert put_together(statustexts(b.ground)) == ["x" * 120]
            assert len(b.ground.times("PARAM_VALUE")) == 3

    run_virtual(main())
