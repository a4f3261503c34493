"""PNI compasses: frames without a start mark, components in any order, either byte order."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest

from companion.protocols.compasses.pni import PniDecoder
from companion.samples import CompassSample, MagSample, TiltSample
from tests.support import decoders
from tests.support.frames import pni, pni_data, pni_heading

GOOD = pni_heading(123.5)
SAMPLE = CompassSample(1.0, 123.5, 1.5, -2.5)

feed = partial(decoders.feed, PniDecoder)


def test_a_frame_of_components() -> None:
    assert feed(GOOD) == ([SAMPLE], {})


def test_the_field_comes_in_gauss() -> None:
    parts: list[tuple[int, float | bytes]] = [(5, 10.0), (27, 12.5), (28, -25.0), (29, 50.0)]
    assert feed(pni_data(parts)) == ([CompassSample(1.0, 10.0), MagSample(1.0, (0.125, -0.25, 0.5))], {})
    assert feed(pni_data(parts[:3])) == ([CompassSample(1.0, 10.0)], {})
    assert feed(pni_data(parts[1:])) == ([MagSample(1.0, (0.125, -0.25, 0.5))], {})


def test_pitch_and_roll_without_a_heading_are_a_tilt() -> None:
    assert feed(pni_data([(24, 5.0), (25, -3.0)])) == ([TiltSample(1.0, -3.0, 5.0)], {})
    assert feed(pni_data([(7, 21.5), (24, 5.0), (25, -3.0)])) == ([TiltSample(1.0, -3.0, 5.0, 21.5)], {})
    assert feed(pni_data([(24, 5.0)])) == ([], {"nothing of use": 1})


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([(5, 10.0), (8, b"\1")], "magnetic distortion"),
        ([(5, 10.0), (79, b"\3")], "heading unsure"),
        ([(5, 10.0), (8, b"\2")], "out of range"),
        ([(5, 360.0)], "out of range"),
        ([(5, 10.0), (24, 90.5)], "out of range"),
        ([(5, 10.0), (27, 2e4)], "out of range"),
        ([(5, math.nan)], "non-finite"),
        ([(7, 25.0), (9, b"\1")], "nothing of use"),
        ([(200, 1.0)], "unknown field"),
    ],
)
def test_what_is_whole_and_of_no_use_says_why(parts: list[tuple[int, float | bytes]], reason: str) -> None:
    assert feed(pni_data(parts)) == ([], {reason: 1})
    assert feed(pni_data(parts) + GOOD) == ([SAMPLE], {reason: 1})


@pytest.mark.parametrize("status", [0, 1, 2])
def test_a_heading_status_of_ten_degrees_or_better_is_good_enough(status: int) -> None:
    assert feed(pni_data([(5, 10.0), (79, bytes([status]))])) == ([CompassSample(1.0, 10.0)], {})


def test_a_device_that_nobody_has_calibrated_is_used_with_a_warning() -> None:
    decoder = PniDecoder()
    assert decoder.feed(pni_data([(5, 10.0), (9, b"\0")]), 1.0) == [CompassSample(1.0, 10.0)]
    assert decoder.warned == {"not calibrated by the user": 1}
    decoder.feed(pni_data([(5, 10.0), (9, b"\1")]), 1.0)
    assert decoder.warned == {"not calibrated by the user": 1}


def test_all_known_components_fit() -> None:
    floats = [5, 7, 21, 22, 23, 24, 25, 27, 28, 29, 74, 75, 76, 88]
    parts: list[tuple[int, float | bytes]] = [(part, 0.5) for part in floats]
    parts += [(8, b"\0"), (9, b"\1"), (79, b"\1"), (77, struct.pack(">4f", 0.0, 0.0, 0.0, 1.0))]
    frame = pni_data(parts)
    assert len(frame) == 99
    samples, rejected = feed(frame)
    assert samples == [CompassSample(1.0, 0.5, 0.5, 0.5), MagSample(1.0, (0.005, 0.005, 0.005))]
    assert rejected == {}


@pytest.mark.parametrize("payload", [b"", b"\x00\x05", b"\x02\x05\x00\x00\x00\x00", b"\x01\x05\x00\x00\x00", b"\x09"])
def test_components_must_fill_their_frame(payload: bytes) -> None:
    samples, rejected = feed(pni(5, payload) + GOOD)
    assert samples == [SAMPLE]
    assert rejected["field count"] == 1


def test_a_device_set_to_little_endian_is_understood_from_the_second_frame_on() -> None:
    decoder = PniDecoder()
    parts: list[tuple[int, float | bytes]] = [(5, 359.9), (24, 10.5), (25, -3.25)]
    little = pni_data(parts, "<")
    assert decoder.feed(little, 1.0) == []
    assert decoder.rejected == {"byte order": 1}
    for _ in range(3):
        (sample,) = decoder.feed(little, 1.0)
        assert isinstance(sample, CompassSample)
        assert sample.heading_deg == pytest.approx(359.9, abs=1e-4)
    assert decoder.feed(GOOD, 1.0) == []  # one frame of the other order does not turn it back
    assert len(decoder.feed(little + little, 1.0)) == 2
    assert decoder.feed(GOOD + GOOD, 1.0) == [SAMPLE]


def test_a_little_endian_heading_never_passes_for_a_small_one() -> None:
    """Read the wrong way round some headings are numbers between 0 and 360 too: tilt or field give it away."""
    decoder = PniDecoder()
    for tenth in range(1, 3600):
        parts: list[tuple[int, float | bytes]] = [(5, tenth / 10), (24, 1.3), (25, -2.7), (27, 20.1)]
        for sample in decoder.feed(pni_data(parts, "<"), 1.0):
            if isinstance(sample, CompassSample):
                assert sample.heading_deg == pytest.approx(tenth / 10, abs=1e-4)
    assert decoder.accepted >= 3598


def test_replies_and_echoes_are_counted_as_such() -> None:
    decoder = PniDecoder()
    assert decoder.feed(pni(1) + pni(4) + pni(3, b"\1\5") + pni(2, b"TRAX1208") + pni(16, b"\0\0") + pni(23), 1.0) == []
    assert decoder.rejected == {"echo of a command": 3, "reply": 3}
