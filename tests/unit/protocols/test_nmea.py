"""NMEA 0183 compasses and the HMR3000: which north, which sentence, which status."""

from __future__ import annotations

import math
from functools import partial

import pynmea2
import pytest
from pynmeagps import NMEAReader

from companion.protocols.compasses.nmea import HOLD_S, NmeaDecoder
from companion.samples import CompassSample, MagSample, Sample, TiltSample
from tests.support import decoders
from tests.support.frames import sentence

feed = partial(decoders.feed, NmeaDecoder)


@pytest.mark.parametrize(
    ("body", "heading_deg", "north"),
    [
        ("HCHDG,98.3,0.0,E,12.6,W", 98.3, "magnetic"),
        ("HCHDG,98.3,,,,", 98.3, "magnetic"),
        ("HCHDG,355.0,10.0,E,,", 5.0, "magnetic"),
        ("HCHDG,5.0,10.0,W,,", 355.0, "magnetic"),
        ("IIHDM,0.0,M", 0.0, "magnetic"),
        ("GPHDT,359.9,T", 359.9, "true"),
        ("HNTHS,12.5,A", 12.5, "true"),
        ("GNTHS,12.5,E", 12.5, "true"),
    ],
)
def test_headings(body: str, heading_deg: float, north: str) -> None:
    (sample,), rejected = feed(sentence(body))
    assert isinstance(sample, CompassSample)
    assert sample.heading_deg == pytest.approx(heading_deg, abs=1e-9)
    assert (sample.north, sample.pitch_deg, sample.roll_deg) == (north, None, None)
    assert not rejected


# Printed in Honeywell's HMR3000 manual, page 16.
@pytest.mark.parametrize(
    ("line", "sample"),
    [
        (b"$PTNTHPR,59.6,N,-0.2,N,-3.0,N*0F\r\n", CompassSample(1.0, 59.6, -0.2, -3.0)),
        (b"$PTNTHPR,72.9,N,-1.6,N,-29.6,O*33\r\n", CompassSample(1.0, 72.9, -1.6, -29.6)),
        (b"$PTNTHPR,,P,0.3,N,0.1,N*06\r\n", TiltSample(1.0, 0.1, 0.3)),
    ],
)
def test_hpr_as_printed(line: bytes, sample: Sample) -> None:
    assert feed(line) == ([sample], {})


def test_hpr_with_a_tilt_alarm_as_printed_is_no_reading() -> None:
    assert feed(b"$PTNTHPR,,N,-1.5,N,,P*03\r\n") == ([], {"alarm": 1})


def test_mils_are_whole_numbers() -> None:
    ((sample,), _) = feed(sentence("PTNTHPR,1838,N,-160,N,80,N"))
    assert sample == CompassSample(1.0, pytest.approx(103.3875), -9.0, 4.5)  # type: ignore[arg-type]
    # As printed, manual p. 15.
    ((sample,), _) = feed(b"$PTNTCCD,-25187,351,-3909,1899,-4394,6180,1838*58\r\n")
    assert isinstance(sample, CompassSample)
    assert sample.heading_deg == pytest.approx(103.3875)
    assert sample.pitch_deg == pytest.approx(math.degrees(math.atan(-25187 / 32768)))
    assert sample.roll_deg == pytest.approx(0.6137, abs=1e-4)


@pytest.mark.parametrize(
    ("body", "samples"),
    [
        ("HCXDR,A,1.6,D,PITCH,A,-0.3,D,ROLL", [TiltSample(1.0, -0.3, 1.6)]),
        ("YXXDR,A,-0.3,D,ROLL,A,1.6,D,PTCH", [TiltSample(1.0, -0.3, 1.6)]),
        ("HCXDR,C,20.1,C,AIR,A,1.6,D,PITCH,A,-0.3,D,ROLL", [TiltSample(1.0, -0.3, 1.6)]),
        (
            "HCXDR,A,1.6,D,PITCH,A,-0.3,D,ROLL,G,250.0,,MAGX,G,-125.0,,MAGY,G,500.0,,MAGZ,G,572.8,,MAGT",
            [TiltSample(1.0, -0.3, 1.6), MagSample(1.0, (0.25, -0.125, 0.5))],
        ),
        ("HCXDR,G,250.0,,MAGX,G,-125.0,,MAGY,G,500.0,,MAGZ", [MagSample(1.0, (0.25, -0.125, 0.5))]),
        ("HCXDR,A,1.6,D,PITCH,A,-0.3,D,ROLL,G,,,MAGX,G,1.0,,MAGY,G,1.0,,MAGZ", [TiltSample(1.0, -0.3, 1.6)]),
    ],
)
def test_transducers(body: str, samples: list[Sample]) -> None:
    assert feed(sentence(body)) == (samples, {})


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"$HCHDM,093.8,M\r\n", "no checksum"),
        (b"$HCHDM,093.8,M*2b\r\n", ""),
        (b"$HCHDM,093.8,M*2C\r\n", "checksum"),
        (b"$*00\r\n", "unknown sentence"),
        (sentence("HCHDG,98.3,0.0,E,12.6"), "field count"),
        (sentence("HCHDG,,0.0,E,12.6,W"), "not a number"),
        (sentence("HCHDG,98.3,1.0,X,,"), "unknown field"),
        (sentence("HCHDG,400.0,1.0,E,,"), "out of range"),
        (sentence("HCHDM,93.8,T"), "unknown field"),
        (sentence("HCHDM,93.8"), "field count"),
        (sentence("HCHDT,93.8,M"), "unknown field"),
        (sentence("HCHDT,nan,T"), "non-finite"),
        (sentence("HCHDT,360.1,T"), "out of range"),
        (sentence("HETHS,93.8,V"), "not a measurement"),
        (sentence("GPRMC,1,2,3"), "unknown sentence"),
        (sentence("XXNTHPR,91.7,N,0.0,N,1.6,N"), "unknown sentence"),
        (sentence("PTNTHPR,91.7,N,0.0,N,1.6"), "field count"),
        (sentence("PTNTHPR,91.7,N,0.0,N,1.6,Q"), "not a measurement"),
        (sentence("PTNTHPR,91.7,C,0.0,N,1.6,N"), "calibrating"),
        (sentence("PTNTHPR,,N,,L,1.6,N"), "alarm"),
        (sentence("PTNTHPR,91.7,N,90.1,N,1.6,N"), "out of range"),
        (sentence("PTNTCCD,522,-472,109,1841,677,1964"), "field count"),
        (sentence("PTNTCCD,522,-472,109,1841,677,1964,386.3"), "out of range"),
        (sentence("HCXDR,A,,D,PITCH,A,-0.3,D,ROLL"), "over range"),
        (sentence("HCXDR,A,1.6,D,PITCH"), "nothing of use"),
        (sentence("HCXDR,A,1.6,D"), "field count"),
        (sentence("HCXDR,A,1.6,M,PITCH,A,-0.3,D,ROLL"), "unknown field"),
        (sentence("HCXDR,G,inf,,MAGX,G,1.0,,MAGY,G,1.0,,MAGZ"), "non-finite"),
        (b"$" + b"H" * 160 + b"\r\n", "too long"),
        (b"$HCHDM,093.$HCHDM,093.8,M*2B\r\n", "cut short"),
    ],
)
def test_what_is_rejected_and_why(line: bytes, reason: str) -> None:
    samples, rejected = feed(line)
    assert rejected == ({reason: 1} if reason else {})
    assert bool(samples) == (not reason or reason == "cut short")


def test_one_sentence_of_an_epoch_gives_the_heading() -> None:
    """HDM, HDG and HPR of one reading are one sample, from the second epoch on; XDR's tilt is HPR's."""
    decoder = NmeaDecoder()
    epoch = b"".join(
        map(
            sentence,
            ("HCHDM,93.8,M", "HCHDG,93.8,,,,", "HCXDR,A,1.6,D,PITCH,A,-0.3,D,ROLL", "PTNTHPR,93.8,N,1,N,2.0,N"),
        )
    )
    epoch = epoch.replace(sentence("PTNTHPR,93.8,N,1,N,2.0,N"), sentence("PTNTHPR,93.8,N,1.0,N,2.0,N"))
    decoder.feed(epoch, 0.0)
    before = decoder.rejected.total()
    for n in range(1, 20):
        assert decoder.feed(epoch, n * 0.1) == [CompassSample(n * 0.1, 93.8, 1.0, 2.0)]
    assert decoder.rejected == {"other north": 2 * 19, "duplicate": 19}
    assert decoder.rejected.total() - before == 3 * 19


def test_magnetic_and_true_are_never_mixed() -> None:
    decoder = NmeaDecoder()
    magnetic, true = sentence("HCHDG,93.8,,,,"), sentence("HCHDT,86.2,T")
    decoder.feed(true, 0.0)  # all that there is so far
    samples: list[Sample] = []
    for n in range(1, 100):
        samples += decoder.feed(magnetic + true if n < 50 else true, n * 0.2)
    assert {sample.north for sample in samples if isinstance(sample, CompassSample)} == {"magnetic"}
    assert len(samples) == 49
    assert decoder.rejected == {"other north": 99}
    decoder.interrupted()  # it may be another device now
    (sample,) = decoder.feed(true, 30.0)
    assert isinstance(sample, CompassSample)
    assert sample.north == "true"


def test_another_sentence_to_the_same_north_takes_over_from_a_silent_one() -> None:
    decoder = NmeaDecoder()
    hdg, hdm = sentence("HCHDG,10.0,,,,"), sentence("HCHDM,20.0,M")
    assert len(decoder.feed(hdg, 0.0)) == 1
    assert decoder.feed(hdm, HOLD_S) == []
    assert decoder.rejected == {"duplicate": 1}
    assert len(decoder.feed(hdm, HOLD_S + 0.1)) == 1
    assert len(decoder.feed(hdg, HOLD_S + 0.2)) == 1
    assert decoder.feed(hdm, HOLD_S + 0.3) == []


def test_an_alarm_of_the_leader_lets_nobody_else_speak() -> None:
    decoder = NmeaDecoder()
    decoder.feed(sentence("PTNTHPR,93.8,N,1.0,N,2.0,N"), 0.0)
    for n in range(1, 60):
        assert (
            decoder.feed(sentence("PTNTHPR,,N,,P,2.0,N") + sentence("HCXDR,A,1.6,D,PITCH,A,2.0,D,ROLL"), n * 0.1) == []
        )
    assert decoder.rejected == {"alarm": 59, "duplicate": 59}


def test_ccd_beside_a_better_heading_still_gives_its_tilt() -> None:
    decoder = NmeaDecoder()
    decoder.feed(sentence("HCHDG,86.0,,,,"), 0.0)
    (sample,) = decoder.feed(b"$PTNTCCD,522,-472,109,1841,677,1964,86.3*44\r\n", 0.1)
    assert isinstance(sample, TiltSample)
    assert (sample.x_deg, sample.y_deg) == pytest.approx((-0.825, 0.913), abs=1e-3)
    assert decoder.feed(sentence("HCXDR,A,1.6,D,PITCH,A,2.0,D,ROLL"), 0.2) == []


def test_against_two_other_packages() -> None:
    """Lines through pynmea2 and pynmeagps; both leave the deviation to their user."""
    for n in range(0, 3600, 7):
        deviation = (n % 50) / 10
        line = sentence(f"HCHDG,{n / 10:.1f},{deviation},{'EW'[n % 2]},3.5,W")
        (sample,) = NmeaDecoder().feed(line, 0.0)
        assert isinstance(sample, CompassSample)
        one, two = pynmea2.parse(line.decode(), check=True), NMEAReader.parse(line)
        sign = 1 if n % 2 == 0 else -1
        for heading, side in ((one.heading, one.dev_dir), (two.headingM, two.deviationEW)):
            assert side == "EW"[n % 2]
            assert sample.heading_deg == pytest.approx((float(heading) + sign * deviation) % 360.0, abs=1e-9)
        true = sentence(f"HEHDT,{n / 10:.1f},T")
        (sample,) = NmeaDecoder().feed(true, 0.0)
        assert isinstance(sample, CompassSample)
        assert sample.heading_deg == NMEAReader.parse(true).headingT == float(pynmea2.parse(true.decode()).heading)
