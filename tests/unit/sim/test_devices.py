"""Bytes of every device, taken apart by hand."""

from __future__ import annotations

import binascii
import math
import re
import struct
from collections.abc import Sequence
from functools import reduce
from operator import xor

import numpy as np
import pytest

from sim.aircraft import Iron, Pose, Site, VirtualAircraft
from sim.devices import HMR3300, Frame, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.imu_model import ImuModel
from sim.motions import Handling, Turn

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)


def joined(frames: Sequence[Frame]) -> bytes:
    return b"".join(frame.data for frame in frames)


def checked(line: str) -> list[str]:
    """Fields of an NMEA-like line whose XOR is right."""
    match = re.fullmatch(r"\$([^*]*)\*([0-9A-F]{2})\r\n", line)
    assert match, line
    assert reduce(xor, match[1].encode(), 0) == int(match[2], 16)
    return match[1].split(",")


def test_hmr3300_lines_are_magnetic_heading_pitch_roll_at_8_hz() -> None:
    aircraft = VirtualAircraft(POSE, Site(40.0, 116.0, 50.0, declination_deg=-7.5))
    compass = HMR3300(aircraft, heading_error_deg=1.0, heading_noise_deg=0.0)
    assert re.fullmatch(rb"HMR3300 [^\r\n]*\r\n", compass.power_on(0.0))
    frames = compass.frames_until(10.0)
    assert len(frames) == 81
    assert [frame.sampled_s for frame in frames[:3]] == [0.0, 0.125, 0.25]
    assert {frame.data for frame in frames} == {b"48.5, 5.0, -3.0\r\n"}
    assert frames[0].complete_s == pytest.approx(17 * 10 / 19200)


def test_the_field_is_the_places_and_iron_turns_the_heading_as_it_must() -> None:
    site = Site(40.0, 116.0, 50.0, declination_deg=-7.5, inclination_deg=60.0, field_gauss=0.5)
    level = VirtualAircraft(Pose(heading_deg=0.0), site)
    np.testing.assert_allclose(level.field_gauss(0.0), [0.24786, -0.03263, 0.43301], atol=1e-5)
    compass = HMR3300(level, heading_noise_deg=0.0)
    compass.field_noise_gauss = 0.0
    assert compass.frames_until(0.0)[0].data == b"7.5, 0.0, 0.0\r\n"
    compass.command(b"*M\r\n", 0.0)
    assert compass.frames_until(0.125)[0].data == b"991, -131, 1732\r\n"
    # A quarter of the horizontal field across magnetic north turns it by atan(1/4), 14.04 degrees, whoever brings it.
    east = (0.0625 * math.sin(math.radians(7.5)), 0.0625 * math.cos(math.radians(7.5)), 0.0)
    compass.command(b"*H\r\n", 0.0)
    level.iron = Iron(body_gauss=east)
    assert compass.frames_until(0.25)[0].data == b"353.5, 0.0, 0.0\r\n"
    # A dipole a metre ahead that points at the compass' right: mu0 m / (4 pi r^3), 1 A m^2 is 1e-3 gauss, reversed.
    across = tuple(-62.5 * value / 0.0625 for value in east)
    level.iron = Iron(dipole_a_m2=(across[0], across[1], 0.0), dipole_at_m=(0.0, 0.0, 1.0))
    assert compass.frames_until(0.375)[0].data == b"353.5, 0.0, 0.0\r\n"
    # On its axis a dipole is twice as strong.
    np.testing.assert_allclose(
        Iron(dipole_a_m2=(0.0, 10.0, 0.0), dipole_at_m=(0.0, 2.0, 0.0)).ground_ned_gauss, [0, 0.0025, 0]
    )


def test_gradienter_pairs_at_10_hz() -> None:
    gradienter = Gradienter(VirtualAircraft(POSE), offset_deg=(0.01, -0.02), noise_deg=0.0)
    frames = gradienter.frames_until(1.0)
    assert len(frames) == 11
    x = math.degrees(math.asin(math.sin(math.radians(-3.0)) * math.cos(math.radians(5.0)))) + 0.01
    assert {frame.data for frame in frames} == {f"X={x:+07.3f}\r\nY=+04.980\r\n".encode()}
    assert frames[0].complete_s == pytest.approx(22 * 10 / 9600)


def test_gradienter_beyond_its_range_says_signs() -> None:
    gradienter = Gradienter(VirtualAircraft(Pose(-40.0, 35.0, 0.0)), law="euler")
    assert gradienter.frames_until(0.0)[0].data == b"X=+++++++\r\nY=-------\r\n"


def test_gradienter_fluid_follows_with_one_decade_a_second() -> None:
    aircraft = VirtualAircraft(Pose(5.0, 0.0, 0.0), motions=[Turn(start_s=1.0, duration_s=0.001, pitch_deg=-5.0)])
    gradienter = Gradienter(aircraft, noise_deg=0.0)
    y = {round(f.sampled_s, 1): float(f.data.split(b"Y=")[1]) for f in gradienter.frames_until(4.5)}
    assert y[0.9] == 5.0
    assert y[2.0] == pytest.approx(0.5, rel=0.05)
    assert y[3.0] == pytest.approx(0.05, rel=0.1)
    assert y[4.0] == pytest.approx(0.005, abs=0.001)


def test_gradienter_takes_acceleration_for_tilt_and_its_mounting_into_account() -> None:
    shaken = VirtualAircraft(motions=[Handling(start_s=0.0, duration_s=1.0, angle_deg=0.0, acceleration=2.0)])
    tilts = Gradienter(shaken).tilt_deg(np.linspace(0.0, 1.0, 51))
    assert np.abs(tilts).max() > 4.0
    turned = Gradienter(VirtualAircraft(POSE), mounting_deg=(0.0, 0.0, 90.0), law="axis")
    # Its forward axis is the vehicle's right one, which is up by asin(sin 3 cos 5); its right axis points backwards.
    x, y = turned.tilt_deg(np.array([0.0]))[0]
    assert x == pytest.approx(5.0)
    assert y == pytest.approx(2.98859, abs=1e-4)


def still_imu() -> tuple[VirtualAircraft, ImuModel]:
    aircraft = VirtualAircraft(POSE, temperature_degc=31.25)
    return aircraft, ImuModel(
        aircraft, "perfect", gyro_bias_rad_s=(0.01, -0.02, 0.03), accel_bias_m_s2=(0.1, -0.2, 0.3)
    )


def test_vectornav_binary_packets_at_200_hz() -> None:
    aircraft, imu = still_imu()
    device = VectorNavBinary(imu)
    frames = device.frames_until(0.995)
    assert len(frames) == 200
    assert {len(frame.data) for frame in frames} == {44}
    rate, force = aircraft.truth_at(0.0)
    for number, frame in enumerate(frames):
        data = frame.data
        sync, groups, common, inertial = struct.unpack("<BBHH", data[:6])
        assert (sync, groups, common, inertial) == (0xFA, 0x05, 0x0121, 0x0010)
        assert binascii.crc_hqx(data[1:], 0) == 0  # CRC over everything after the sync byte, CRC included
        (startup_ns,) = struct.unpack("<Q", data[6:14])
        assert startup_ns == number * 5_000_000
        values = struct.unpack("<7f", data[14:42])
        assert values[:3] == pytest.approx(np.add(rate, [0.01, -0.02, 0.03]), abs=1e-8)
        assert values[3:6] == pytest.approx(np.add(force, [0.1, -0.2, 0.3]), abs=1e-6)
        assert values[6] == 31.25
    assert frames[7].complete_s - frames[7].sampled_s == pytest.approx(44 * 10 / 115200)


def test_imu_line_counts_wrap() -> None:
    aircraft, imu = still_imu()
    device = ImuLine(imu)
    lines = joined(device.frames_until(0.1)).decode().splitlines(keepends=True)
    assert len(lines) == 21
    for number, line in enumerate(lines):
        fields = checked(line)
        assert fields[0] == "IMU"
        assert int(fields[1]) == number
        assert int(fields[2]) == number * 5000
        assert [float(field) for field in fields[3:6]] == pytest.approx(
            np.add(aircraft.truth_at(0.0).rate_rad_s, [0.01, -0.02, 0.03]), abs=6e-8
        )
        assert float(fields[9]) == 31.25
        assert len(fields) == 10
    assert device.line_time_s(len(lines[0])) < 1.0 / 200.0
    wrapped = checked(device.encode(np.array([0.0]), 65536 * 15)[0].decode())
    assert int(wrapped[1]) == 0
    assert int(wrapped[2]) == 65536 * 15 * 5000 % 2**32


def devices() -> list[SerialDevice]:
    aircraft = VirtualAircraft(POSE)
    return [
        HMR3300(aircraft, seed=1),
        Gradienter(aircraft, seed=1),
        VectorNavBinary(ImuModel(aircraft, seed=1)),
        ImuLine(ImuModel(aircraft, seed=1)),
    ]
