"""The project's own $IMU line."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.samples import ImuSample
from tests.support import decoders
from tests.support.frames import imu_line, sentence

LINE = imu_line(7, 1_234_567)

feed = partial(decoders.feed, ImuLineDecoder)


def test_a_line_written_out_by_hand() -> None:
    # The checksum was computed in a shell, from od's bytes.
    line = b"$IMU,1,2000000,0.01,-0.02,0.03,0.1,0.2,-9.8,25.0*55\r\n"
    assert feed(line) == ([ImuSample(1.0, (0.01, -0.02, 0.03), (0.1, 0.2, -9.8), 25.0, 1, 2.0)], {})


def test_the_temperature_may_be_empty() -> None:
    samples, rejected = feed(imu_line(1, 1, temperature=""))
    assert [s.temperature_degc for s in samples if isinstance(s, ImuSample)] == [None]
    assert not rejected


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r", b"\n\r", b"\r\r\n"])
def test_any_line_end_will_do(end: bytes) -> None:
    samples, rejected = feed(3 * (LINE.rstrip() + end))
    assert len(samples) == 3
    assert not rejected


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("IMU,1,2,0,0,0,0,0,-9.8", "field count"),
        ("IMU,1,2,0,0,0,0,0,,25", "not a number"),
        ("IMU,1,2,0,0,0,0,0,-9.8,warm", "not a number"),
        ("IMU,65536,2,0,0,0,0,0,-9.8,25", "out of range"),
        ("IMU,1,4294967296,0,0,0,0,0,-9.8,25", "out of range"),
        ("IMU,1,2,101,0,0,0,0,-9.8,25", "out of range"),
        ("IMU,1,2,nan,0,0,0,0,-9.8,25", "non-finite"),
        ("IMU,1,2,0,0,inf,0,0,-inf,25", "non-finite"),
        ("IMV,1,2,0,0,0,0,0,-9.8,25", "unknown sentence"),
    ],
)
def test_a_right_checksum_alone_is_not_enough(body: str, reason: str) -> None:
    assert feed(sentence(body)) == ([], {reason: 1})


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (LINE.replace(b"*", b"*0"), "no checksum"),
        (LINE[: LINE.index(b"*")] + b"\r\n", "no checksum"),
        (LINE[:10] + b"9" + LINE[11:], "checksum"),
        (LINE[:30], ""),
        (LINE[:30] + b"$", "cut short"),
        (b"$" + b"x" * 200, "too long"),
    ],
)
def test_damage_is_counted_by_reason(data: bytes, reason: str) -> None:
    samples, rejected = feed(data)
    assert samples == []
    assert rejected == ({reason: 1} if reason else {})


def test_a_line_that_another_begins_in_is_counted() -> None:
    decoder = ImuLineDecoder()
    decoder.feed(b"boot\r\n" + LINE + b"???", 1.0)
    decoder.feed(b"$IMU,1$" + b"x" * 161, 1.0)  # a start that is cut short, and one that is two bytes too long
    assert decoder.rejected == {"cut short": 1, "too long": 1}
