"""Simulated tiltmeters and compasses beyond the first ones: what their lines say, taken apart by hand."""

from __future__ import annotations

import math
import re

import pytest

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.compasses import NmeaCompass, Os5000
from sim.devices import SerialDevice
from sim.families import COMPASSES, GRADIENTERS
from sim.gradienters import BeiInclinometer, Jewell
from tests.support.frames import xor

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
X_DEG = math.degrees(math.asin(math.sin(math.radians(-3.0)) * math.cos(math.radians(5.0))))
"""Elevation of the right axis, downwards: -2.989."""


def checked(line: bytes) -> list[str]:
    match = re.fullmatch(rb"\$([^*]*)\*([0-9A-F]{2})\r\n", line)
    assert match, line
    assert xor(match[1]) == int(match[2], 16)
    return match[1].decode().split(",")


def aircraft(declination_deg: float = 0.0) -> VirtualAircraft:
    return VirtualAircraft(POSE, Site(40.0, 116.0, 50.0, declination_deg=declination_deg), temperature_degc=21.5)


def test_jewell_lines() -> None:
    device = Jewell(aircraft(), noise_deg=0.0)
    assert device.power_on(0.0) == b""
    frames = device.frames_until(1.0)
    assert len(frames) == 5
    assert {frame.data for frame in frames} == {b"$-02.989,005.000,021.500,N0000\r\n"}
    device.command(b"*9900SO-XDR\r\n", 1.0)
    assert checked(device.command(b"*9900XY\r\n", 1.0)) == (
        ["YXXDR", "A", "005.000", "D", "N", "A", "-02.989", "D", "E", "C", "021.500", "C", "T-N0000"]
    )
    assert device.stored == 1
    assert device.command(b"*9900SO-TEA\r\n", 1.0).startswith(b"ERR ")
    assert device.command(b"*9900xy\r\n*98", 1.0) == b""  # case-sensitive; and unfinished
    assert device.command(b"\x00" * 5000, 1.0) == b""
    device.command(b"\n*9900XYC-OFF\r\n", 1.0)
    assert device.frames_until(2.0) == []
    assert device.power_on(3.0) == b""
    assert device.frames_until(4.0) == []  # the setting has stayed


def test_a_lily_stops_at_its_rail_and_goes_on_sending() -> None:
    device = Jewell(aircraft(), output="XDR", unit="M", range_deg=math.degrees(330e-6))
    fields = checked(device.command(b"*9900XY\r\n", 0.0))
    assert (fields[2], fields[6], fields[3]) == ("330.000", "-330.000", "M")


def test_bei_levels() -> None:
    device = BeiInclinometer(aircraft(), polled=True)
    assert b"SN:" in device.power_on(0.0)
    assert device.frames_until(1.0) == []
    assert device.command(b"*", 1.0) == b"US"
    assert device.command(b"R", 1.0).startswith(b"X=-02.9")
    device.command(b"F", 1.0)
    assert len(device.frames_until(2.0)) == 10
    assert device.command(b"f", 2.0) == b"f"
    assert (device.stored, device.command(b"prog", 2.0), device.command(b"*", 2.0)) == (0, b"P", b"SS")
    device.command(b"F", 2.0)
    assert device.stored == 1
    assert device.power_on(3.0) == b""
    assert device.frames_until(3.5)


def test_hmr3000_sentences() -> None:
    device = NmeaCompass(aircraft(-7.5), heading_noise_deg=0.0, tilt_noise_deg=0.0, deviation_deg=2.0, sentences=())
    assert device.frames_until(10.0) == []
    ask = device.command
    assert checked(ask(b"$PTNT,HPR*78\r\n", 10.0)) == ["PTNTHPR", "47.5", "N", "5.0", "N", "-3.0", "N"]
    assert checked(ask(b"$TNHCQ,HDG*27\r\n", 10.0)) == ["HCHDG", "45.5", "2.0", "E", "7.5", "W"]
    assert checked(ask(b"$TNHCQ,HDT*34\r\n", 10.0)) == ["HCHDT", "40.0", "T"]
    assert checked(ask(b"$TNHCQ,XDR*22\r\n", 10.0))[:9] == ["HCXDR", "A", "5.0", "D", "PITCH", "A", "-3.0", "D", "ROLL"]
    ccd = checked(ask(b"$PTNT,CCD*76\r\n", 10.0))
    assert math.degrees(math.atan(int(ccd[1]) / 32768)) == pytest.approx(5.0, abs=2e-3)
    assert math.degrees(math.atan(int(ccd[2]) / 32768)) == pytest.approx(X_DEG, abs=2e-3)
    assert ccd[-1] == "47.5"
    assert ask(b"$PTNT,HPR*79\r\n#FA0.4=1*21\r\n\xff\xff", 10.0) == b""
    device.magnetic_alarm = True
    assert checked(ask(b"\r\n$PTNT,HPR*78\r\n", 10.0)) == ["PTNTHPR", "", "P", "5.0", "N", "-3.0", "N"]
    tilted = NmeaCompass(VirtualAircraft(Pose(50.0, 0.0, 0.0)), tilt_noise_deg=0.0)
    assert checked(tilted.frames_until(0.0)[0].data) == ["PTNTHPR", "", "N", "", "P", "0.0", "N"]


def test_a_talking_nmea_compass_sends_all_that_is_enabled() -> None:
    device = NmeaCompass(aircraft(-7.5), heading_noise_deg=0.0, sentences=("HDM", "THS"))
    frames = device.frames_until(4.0)
    assert len(frames) == 56  # 13.75 Hz
    (data,) = {frame.data for frame in frames}
    first, second = data.splitlines(keepends=True)
    assert (checked(first), checked(second)) == (["HCHDM", "47.5", "M"], ["GPTHS", "40.0", "A"])


def test_os5000_lines_and_its_rate() -> None:
    device = Os5000(aircraft(-7.5), heading_noise_deg=0.0)
    (line,) = {frame.data for frame in device.frames_until(0.0)}
    assert re.fullmatch(r"C47\.5P[45]\.\dR-[23]\.\dT21\.5", checked(line)[0])
    device.command(b"\x1bR0 ", 0.0)
    assert device.frames_until(1.0) == []
    device.command(b"\x1bR1", 1.0)
    device.command(b"0 \x1bX7 ", 1.0)
    assert device.frames_until(2.0)
    device.vectors = True
    body = checked(device.frames_until(3.0)[-1].data)[0]
    tags = dict(re.findall(r"([A-Z][a-z]?)([-+0-9.]+)", body))
    assert float(tags["Az"]) == pytest.approx(0.995, abs=2e-3)
    assert math.hypot(*(float(tags[each]) for each in ("Mx", "My", "Mz"))) == pytest.approx(530.0, abs=0.1)


def asked(device: SerialDevice) -> bytes:
    questions = {"rion": bytes.fromhex("6804000408"), "pni": bytes.fromhex("000504BF71")}
    return device.command(questions[device.protocol], 1.0)


def test_the_families_name_their_protocols() -> None:
    for made in (GRADIENTERS, COMPASSES):
        for name, make in made.items():
            device = make(aircraft(), 1)
            assert device.protocol == name
            device.power_on(0.0)
            # Those that only answer: to the question that the companion asks them.
            assert device.frames_until(1.0) or asked(device)
