"""RION devices: every frame that the manuals print, right or wrong, and what a weak sum must not let by."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.inclinometers.rion import RionDecoder
from companion.samples import CompassSample, TiltSample
from tests.support import decoders
from tests.support.frames import rion, rion_angle, rion_angles, rion_long

GOOD = rion_angles(10.5, -10.05, 104.01)
SAMPLE = CompassSample(1.0, 104.01, 10.5, -10.05)

feed = partial(decoders.feed, RionDecoder)


@pytest.mark.parametrize(
    ("frame", "sample"),
    [
        ("68 0D 00 84 00 10 50 10 10 05 01 04 01 1C", SAMPLE),  # HCM370B p. 11
        ("68 0D 00 84 00 20 10 10 05 25 01 80 00 7C", CompassSample(1.0, 180.0, 20.1, -5.25)),  # HCM705B p. 17
        # Three that people have captured and put into public sources:
        ("68 0D 00 84 10 02 87 10 00 85 01 59 22 3B", CompassSample(1.0, 159.22, -2.87, -0.85)),
    ],
)
def test_printed_measurements(frame: str, sample: CompassSample) -> None:
    assert feed(bytes.fromhex(frame)) == ([sample], {})


@pytest.mark.parametrize(
    "frame",
    [
        "68 05 00 CF 00 54",  # HCM705B p. 14, should be D4
        "68 05 00 CB 00 CE",  # p. 15, should be D0
        "68 05 00 C8 00 CC",  # p. 15, should be CD
        "68 05 00 88 07 95",  # p. 12 has 94
        "68 0D 00 84 00 10 50 10 10 05 01 04 01 23",  # p. 12, should be 1C
    ],
)
def test_misprinted_frames_are_rejected(frame: str) -> None:
    samples, rejected = feed(bytes.fromhex(frame) + GOOD)
    assert samples == [SAMPLE]
    assert rejected == {"checksum": 1}


@pytest.mark.parametrize(
    "frame",
    ["68 06 00 87 02 08 97", "68 05 00 86 00 8B", "68 05 00 8C 00 91", "68 05 00 88 07 94", "68 05 00 D0 00 D5"],
)
def test_other_printed_answers_are_known(frame: str) -> None:
    assert feed(bytes.fromhex(frame) + GOOD) == ([SAMPLE], {"reply": 1})


@pytest.mark.parametrize(
    "frame",
    ["68 04 00 04 08", "68 06 00 06 02 08 16", "68 05 00 0C 00 11", "68 04 00 42 46", "68 07 00 48 02 05 18 6E"],
)
def test_printed_commands_heard_back_are_echoes(frame: str) -> None:
    assert feed(bytes.fromhex(frame) + GOOD) == ([SAMPLE], {"echo of a command": 1})


def test_records_of_floats_are_left_alone() -> None:
    records = b"\x02\x05\x43\x34\x00\x00\x18\x41\x28\x00\x00"
    assert feed(rion(0x94, records) + GOOD) == ([SAMPLE], {"reply": 1})


def test_the_inclinometers_longer_frame() -> None:
    assert feed(rion_long(-1.2345, 12.3456)) == ([TiltSample(1.0, -1.2345, 12.3456)], {})
    assert feed(rion_long(89.9999, -90.0, b"\xff\x68\x0d")) == ([TiltSample(1.0, 89.9999, -90.0)], {})


@pytest.mark.parametrize("address", [0, 1, 0xEF, 0xFF, 0x68])
def test_any_address_answers(address: int) -> None:
    data = rion_angle(1.0) + rion_angle(-2.0) + rion_angle(3.0)
    assert feed(rion(0x84, data, address)) == ([CompassSample(1.0, 3.0, 1.0, -2.0)], {})


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (rion_angles(1.0, 2.0, 360.0), "out of range"),
        (rion_angles(1.0, 2.0, -3.0), "out of range"),  # "heading no negative"
        (rion_angles(90.01, 2.0, 3.0), "out of range"),
        (rion_long(1.0, 90.0001), "out of range"),
        (rion(0x84, bytes.fromhex("001050101005010A01")), "not a number"),
        (rion(0x84, bytes.fromhex("00000000F0000000000000")), "not a number"),
    ],
)
def test_angles_that_cannot_be(frame: bytes, reason: str) -> None:
    assert feed(frame + GOOD) == ([SAMPLE], {reason: 1})
