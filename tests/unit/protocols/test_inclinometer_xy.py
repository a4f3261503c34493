"""The X=/Y= family: two lines a reading, no checksum."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder
from companion.samples import TiltSample
from tests.support import decoders

X, Y = b"X=+00.430\r\n", b"Y=-00.084\r\n"

feed = partial(decoders.feed, InclinometerXyDecoder)


@pytest.mark.parametrize(
    ("pair", "x_deg", "y_deg"),
    [
        (b"X=+00.430\r\nY=-00.084\r\n", 0.43, -0.084),
        (b"X=-29.999\r\nY=+30.000\r\n", -29.999, 30.0),
        (b"X=+12.34\r\nY=-00.01\r\n", 12.34, -0.01),
    ],
)
def test_a_pair(pair: bytes, x_deg: float, y_deg: float) -> None:
    assert feed(pair) == ([TiltSample(1.0, x_deg, y_deg)], {})


@pytest.mark.parametrize(
    ("data", "reasons"),
    [
        (Y, {"orphan": 1}),
        (X + X + b"Y=-00.0", {"orphan": 1}),
        (Y + X, {"orphan": 1}),
        (b"X=+++++++\r\n" + Y, {"over range": 1}),
        (X + b"Y=+++++++\r\n", {"over range": 1}),
        (b"X=+90.001\r\n" + Y, {"out of range": 1}),
        (b"X=+00.4e0\r\n" + Y, {"not a measurement": 1}),
        (b"X=+00.430\n" + Y, {"line end": 1}),
        (b"X=+00.4\xb30\r\n" + Y, {"parity": 1}),
        (b"X=+00.4\x000\r\n" + Y, {"parity": 1}),
        (b"\xd8\xbd+00.430\r\n" + Y, {"parity": 1, "orphan": 1}),
        (b"+00.430\r\n", {"single axis": 1}),
        (b"x" * 200 + b"\r\n", {"too long": 1}),
        (X + b"SN:1234\r\n" + Y, {"orphan": 2, "not a measurement": 1}),
    ],
)
def test_what_is_no_reading_is_counted_by_reason(data: bytes, reasons: dict[str, int]) -> None:
    assert feed(data) == ([], reasons)


@pytest.mark.parametrize("echo", [b"s", b"S", b"R", b"fF", b"*", b"prog"])
def test_an_echo_in_front_of_a_line_is_passed_over(echo: bytes) -> None:
    decoder = InclinometerXyDecoder()
    assert decoder.feed(echo + X + echo + Y, 1.0) == [TiltSample(1.0, 0.43, -0.084)]
    assert not decoder.rejected


def test_a_reading_that_has_lost_a_decimal_is_rejected_but_a_device_with_fewer_is_learnt() -> None:
    lost = b"X=+00.30\r\n" + Y
    samples, rejected = feed(X + Y + lost + X + Y)
    assert samples == 2 * [TiltSample(1.0, 0.43, -0.084)]
    assert rejected == {"shape changed": 1}
    samples, rejected = feed(X + Y + 10 * b"X=+12.34\r\nY=-00.01\r\n")
    assert samples.count(TiltSample(1.0, 12.34, -0.01)) == 7
    assert rejected == {"shape changed": 3}


def test_an_interruption_drops_the_x_that_waits() -> None:
    decoder = InclinometerXyDecoder()
    decoder.feed(X, 1.0)
    decoder.interrupted()
    assert decoder.feed(Y, 2.0) == []
    assert decoder.rejected == {"orphan": 2}
