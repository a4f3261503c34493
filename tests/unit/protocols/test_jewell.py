"""Jewell tiltmeters: four output formats and two logged ones, which axis comes first, and the rail."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.inclinometers.jewell import JewellDecoder
from companion.samples import TiltSample
from tests.support import decoders
from tests.support.frames import sentence

feed = partial(decoders.feed, JewellDecoder)


# As printed: Tuff Tilt Digital manual, p. 12 and 15; D700 manual, p. 14; the last two as logged at sea.
@pytest.mark.parametrize(
    ("line", "sample"),
    [
        ("$-00.619,000.023,018.910,N0000", TiltSample(1.0, -0.619, 0.023, 18.91)),
        ("$-0.619,0.023,18.923,N0000", TiltSample(1.0, -0.619, 0.023, 18.923)),
        ("$YXXDR,A,000.034,D,N,A,-00.625,D,E,C,021.651,C,T-N0000*47", TiltSample(1.0, -0.625, 0.034, 21.651)),
        ("$YXXDR,A,-00.920,D,N,A,-00.210,D,E,C,030.045,C,T-N1212*57", TiltSample(1.0, -0.21, -0.92, 30.045)),
        ("$PASHS,XDR,A,004.261,D,N,A,004.280,D,E,C,021.288,C,T-N1346", TiltSample(1.0, 4.28, 4.261, 21.288)),
        ("$P-00.907R002.186*1C", TiltSample(1.0, 2.186, -0.907)),
    ],
)
@pytest.mark.parametrize("end", ["\r\n", "\n"])
def test_lines_as_printed(line: str, sample: TiltSample, end: str) -> None:
    assert feed((line + end).encode()) == ([sample], {})


def test_microradians() -> None:
    ((sample,), _) = feed(sentence("YXXDR,A,-100.000,M,N,A,8726.646,M,E,C,021.651,C,T-N0000"))
    assert isinstance(sample, TiltSample)
    assert (sample.x_deg, sample.y_deg) == pytest.approx((0.5, -0.00572958), abs=1e-7)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (sentence("YXXDR,A,095.000,D,N,A,001.000,D,E,C,021.651,C,T-N0000").decode().strip(), "out of range"),
        (sentence("YXXDR,A,1.2.3,D,N,A,001.000,D,E,C,021.651,C,T-N0000").decode().strip(), "not a measurement"),
        ("$YXXDR,A,000.034,D,N,A,-00.625,D,E,C,021.651,C,T-N0000*48", "checksum"),
        ("$YXXDR,A,000.034,D,N,A,-00.625,D,E,C,021.651,C,T-N0000", "no checksum"),
        ("$095.000,000.023,018.910,N0000", "out of range"),
        # A digit has been lost on the way: padded numbers and others do not mix.
        ("$-0.619,000.023,018.910,N0000", "not a measurement"),
        ("$-00.619,000.023,018.910,0000", "not a measurement"),
        ("$-00.619,000.023,018.910", "not a measurement"),
        ("PASHS,XDR,A,004.261,D,N,A,004.280,D,E,C,021.288,C,T-N1346", "not a measurement"),
        ("ERR XY-SO BAD PARAMETER", "command refused"),
        ("$-00.619,000.0\r23,018.910,N0000", "line end"),
        ("$-00.619,000.0\u00023,018.910,N0000", "not a measurement"),
        ("$" + "1" * 120, "too long"),
    ],
)
def test_what_is_rejected_and_why(line: str, reason: str) -> None:
    assert feed((line + "\r\n").encode()) == ([], {reason: 1})
