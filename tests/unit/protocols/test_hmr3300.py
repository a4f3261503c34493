"""HMR3300: no checksum and no start mark, so what a line's neighbourhood says matters."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder
from companion.samples import CompassSample, MagSample
from tests.support import decoders

LINE = b"123.4, 18.6, -0.5\r\n"

feed = partial(decoders.feed, Hmr3300Decoder)


@pytest.mark.parametrize(
    ("line", "heading_deg", "pitch_deg", "roll_deg"),
    [
        (b"0.0, 0.0, 0.0\r\n", 0.0, 0.0, 0.0),
        (b"359.9,-60.0,+60.0\r\n", 359.9, -60.0, 60.0),
        (b"  7.5,   1.0,  -2.0 \r\n", 7.5, 1.0, -2.0),
        (b"180.0\r\n", 180.0, None, None),
    ],
)
def test_headings(line: bytes, heading_deg: float, pitch_deg: float | None, roll_deg: float | None) -> None:
    assert feed(line) == ([CompassSample(1.0, heading_deg, pitch_deg, roll_deg)], {})


def test_magnetometer_counts_keep_their_order_and_sign() -> None:
    assert feed(b"1256, -234, -1894\r\n") == ([MagSample(1.0, counts=(1256, -234, -1894))], {})


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"360.0, 0.0, 0.0\r\n", "out of range"),
        (b"10.0, 90.1, 0.0\r\n", "out of range"),
        (b"40000, 1, 1\r\n", "out of range"),
        (b"#I\r\n", "command refused"),
        (b"12, 34, 56, C\r\n", "calibrating"),
        (b"HMR3300 Rev 1.0\r\n", "not a measurement"),
        (b"123.4, 18, -0.5\r\n", "not a measurement"),
        (b"1e2, 0.0, 0.0\r\n", "not a measurement"),
        (b"123.4, 18.6\r\n", "field count"),
        (b"123.4, 18.6, -0.5, 1.0\r\n", "field count"),
        (b"123.4, 18.6, -0.5\n", "line end"),
        (b"123.4, 1\xb86, -0.5\r\n", "parity"),
        (b"1" * 40 + b"\r\n", "too long"),
    ],
)
def test_what_is_no_measurement_is_counted_by_reason(line: bytes, reason: str) -> None:
    assert feed(line) == ([], {reason: 1})


def test_the_rest_of_a_line_is_not_taken_for_a_line_after_an_interruption() -> None:
    decoder = Hmr3300Decoder()
    decoder.feed(b"12", 1.0)
    decoder.interrupted()
    assert decoder.feed(b"3.4, 18.6, -0.5\r\n", 2.0) == []
    assert decoder.rejected == {"cut short": 2}
    assert len(decoder.feed(LINE, 3.0)) == 1


def test_a_digit_damaged_into_a_line_end_makes_no_heading_of_the_rest() -> None:
    for at in range(5):
        samples, _ = feed(LINE + LINE[:at] + b"\n" + LINE[at + 1 :] + LINE)
        assert [sample.heading_deg for sample in samples if isinstance(sample, CompassSample)] == [123.4, 123.4]


def test_a_lost_line_end_makes_no_heading_of_two() -> None:
    for lost in (LINE[:-1] + LINE, LINE[:-2] + LINE, LINE[:-2] + b"\n" + LINE):
        samples, rejected = feed(LINE + lost + LINE)
        assert len(samples) == 2
        assert rejected


def test_a_lone_number_among_triples_is_debris_until_it_has_company() -> None:
    samples, rejected = feed(3 * LINE + b"10.5\r\n" + LINE)
    assert len(samples) == 4
    assert rejected == {"shape changed": 1}
    samples, rejected = feed(3 * LINE + 5 * b"10.5\r\n")
    assert [sample.heading_deg for sample in samples if isinstance(sample, CompassSample)] == 3 * [123.4] + 3 * [10.5]
