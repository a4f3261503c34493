"""OceanServer's tagged fields."""

from __future__ import annotations

from functools import partial

import pytest

from companion.protocols.compasses.os5000 import Os5000Decoder
from companion.samples import CompassSample, MagSample, Sample, TiltSample
from tests.support import decoders
from tests.support.frames import sentence

feed = partial(decoders.feed, Os5000Decoder)


@pytest.mark.parametrize(
    ("line", "samples"),
    [
        # Printed in the user's guide, p. 11 and 12; the field of the second is no natural one, so it is left out.
        (b"$C320.5P0.2R-18.3T19.0*3C\r\n", [CompassSample(1.0, 320.5, 0.2, -18.3, None, 19.0)]),
        (
            b"$C212.4P2.5R-14.0T28.4Mx107977.90My-79422.00Mz173.27Ax0.045Ay-0.245Az0.977*3A\r\n",
            [CompassSample(1.0, 212.4, 2.5, -14.0, None, 28.4)],
        ),
        (sentence("C328.3P28.4R-12.4T21.1D21.01"), [CompassSample(1.0, 328.3, 28.4, -12.4, None, 21.1)]),
        (
            sentence("C28.3P9.0R1.0T21.1Mx-80.45My160.86M271.53Mz450.00A0.998"),
            [CompassSample(1.0, 28.3, 9.0, 1.0, None, 21.1)],
        ),
        (
            sentence("C28.3P9.0R1.0Mx-80.5My160.25Mz450.0Ax0.0Ay0.0Az1.0"),
            [CompassSample(1.0, 28.3, 9.0, 1.0), MagSample(1.0, (-0.0805, 0.16025, 0.45))],
        ),
        (sentence("C28.3"), [CompassSample(1.0, 28.3)]),
        (sentence("C360.0P1.0"), [CompassSample(1.0, 0.0)]),
        (sentence("P1.0R-2.0T20.0"), [TiltSample(1.0, -2.0, 1.0, 20.0)]),
        (sentence("C1.0P0.0R-179.9"), [CompassSample(1.0, 1.0, 0.0, -179.9)]),
    ],
)
def test_what_is_read(line: bytes, samples: list[Sample]) -> None:
    assert feed(line) == (samples, {})


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"$C320.5P0.2R-18.3T19.0\r\n", "no checksum"),
        (b"$C320.5P0.2R-18.3T19.0*3D\r\n", "checksum"),
        (sentence("C360.1P0.0R0.0"), "out of range"),
        (sentence("C1.0P90.1R0.0"), "out of range"),
        (sentence("C1.0P0.0R180.1"), "out of range"),
        (sentence("C1.0P0.0R0.0T200.1"), "out of range"),
        (sentence("CnanP0.0R0.0"), "not a measurement"),
        (sentence("T19.0"), "nothing of use"),
        (sentence("HCHDT,86.2,T"), "unknown sentence"),
        (sentence("C1.0" + "Q1.0" * 70), "too long"),
    ],
)
def test_what_is_rejected_and_why(line: bytes, reason: str) -> None:
    assert feed(line) == ([], {reason: 1})
