"""Simulated PNI, RION and WitMotion devices: their bytes by hand, and that their readings lead back to the truth."""

from __future__ import annotations

import binascii
import math
import struct

import numpy as np
import pytest

from companion.physics.frames import rotation_matrix
from companion.physics.gradienter import up_in_sensor
from companion.protocols.compasses.pni import PniDecoder
from companion.protocols.imus.witmotion import WitMotionDecoder
from companion.protocols.inclinometers.rion import RionDecoder
from companion.samples import CompassSample, ImuSample, TiltSample
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.imu_model import ImuModel
from sim.pni import PniCompass
from sim.rion import RionCompass, RionInclinometer
from sim.witmotion import WT901, WT901SDCL, WitMotionImu, WitMotionInclinometer

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
NEXT = bytes.fromhex("55500000000000000000A5")


def test_pni_answers_byte_by_byte() -> None:
    device = PniCompass(VirtualAircraft(Pose(0.0, 0.0, 90.0)), heading_noise_deg=0.0)
    assert device.power_on(0.0) == b""
    assert device.frames_until(1.0) == []  # poll mode
    assert device.command(bytes.fromhex("000501EFD4"), 1.0) == bytes.fromhex("000D0254524158313230387BD8")
    assert device.command(bytes.fromhex("000504BF70"), 1.0) == b""  # wrong CRC
    assert device.command(bytes.fromhex("000504"), 1.0) + device.command(bytes.fromhex("BF71"), 1.0) == (
        device.reading(1.0)
    )
    body = bytes.fromhex("000803020518")
    answer = device.command(body + struct.pack(">H", binascii.crc_hqx(body, 0)) + bytes.fromhex("000504BF71"), 1.0)
    assert answer[:-2] == bytes.fromhex("00100502 05") + struct.pack(">f", 90.0) + b"\x18" + struct.pack(">f", 0.0)
    assert binascii.crc_hqx(answer, 0) == 0
    assert device.saves == 0


def test_pni_forgets_what_was_not_saved() -> None:
    device = PniCompass(VirtualAircraft(POSE))
    choose, save = bytes.fromhex("000803020518"), bytes.fromhex("000509")
    device.command(choose + struct.pack(">H", binascii.crc_hqx(choose, 0)), 0.0)
    assert device.components == (5, 24)
    device.power_on(1.0)
    assert device.components == (5, 79)
    device.command(choose + struct.pack(">H", binascii.crc_hqx(choose, 0)), 1.0)
    assert device.command(save + struct.pack(">H", binascii.crc_hqx(save, 0)), 1.0)[2:5] == b"\x10\0\0"
    device.power_on(2.0)
    assert (device.components, device.saves) == ((5, 24), 1)


def test_pni_streams_when_it_is_told_to() -> None:
    device = PniCompass(VirtualAircraft(POSE))
    device.command(bytes.fromhex("000515BD61"), 0.0)
    assert len(device.frames_until(1.0)) == 11
    assert device.command(bytes.fromhex("000504BF71"), 1.0) == b""
    stop = bytes.fromhex("000516")
    device.command(stop + struct.pack(">H", binascii.crc_hqx(stop, 0)), 1.0)
    assert device.frames_until(2.0) == []


def test_pni_flags_and_little_endian_are_read_as_they_are() -> None:
    device = PniCompass(VirtualAircraft(POSE), big_endian=False, heading_noise_deg=0.0)
    device.components = (5, 24, 25, 8, 9)
    decoder = PniDecoder()
    decoder.feed(device.reading(0.0), 0.0)
    (sample,) = decoder.feed(device.reading(0.0), 0.0)
    assert isinstance(sample, CompassSample)
    assert sample.heading_deg == pytest.approx(40.0, abs=0.01)
    device.calibrated = False
    assert len(decoder.feed(device.reading(0.0), 0.0)) == 1
    assert decoder.warned.total() == 1
    device.distorted = True
    assert decoder.feed(device.reading(0.0), 0.0) == []
    assert decoder.rejected["magnetic distortion"] == 1


def test_a_rion_compass_prints_what_the_manual_prints() -> None:
    """HCM370B p. 11: pitch +10.50, roll -10.05, heading 104.01."""
    device = RionCompass(VirtualAircraft(Pose(10.5, -10.05, 104.01)), heading_noise_deg=0.0)
    frame = bytes.fromhex("680D00840010501010050104011C")
    assert device.command(bytes.fromhex("6804000408"), 0.0) == frame
    assert device.command(bytes.fromhex("6804FF0407"), 0.0) == frame
    assert device.command(bytes.fromhex("6804010409"), 0.0) == b""  # somebody else's address
    assert device.command(bytes.fromhex("6804000409"), 0.0) == b""
    assert device.frames_until(1.0) == []
    assert device.command(bytes.fromhex("6805000C0112"), 1.0) == bytes.fromhex("6805008C0091")
    assert {sent.data for sent in device.frames_until(2.0)} == {frame}
    device.command(bytes.fromhex("6805000C0011"), 2.0)
    assert device.frames_until(3.0) == []


def test_a_rion_heading_wraps_before_360_and_zero_has_no_sign() -> None:
    device = RionCompass(VirtualAircraft(Pose(-0.004, 0.004, 359.996)), heading_noise_deg=0.0)
    assert device.reading(0.0)[4:-1] == bytes(9)


def test_a_rion_inclinometer_gives_the_elevation_of_each_axis() -> None:
    device = RionInclinometer(VirtualAircraft(Pose(20.0, 30.0, 77.0)), noise_deg=0.0)
    frame = device.command(bytes.fromhex("6804000408"), 0.0)
    data = bytes.fromhex("00280243 00200000 000000")
    assert frame == bytes.fromhex("680F0084") + data + bytes([(0x0F + 0x84 + sum(data)) % 256])
    assert device.frames_until(1.0) == []
    assert len(RionDecoder().feed(frame, 0.0)) == 1


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 0.0), (0.0, 0.0, 90.0), (10.0, -5.0, 200.0)])
def test_a_compass_tilt_leads_back_to_up(mounting: tuple[float, float, float]) -> None:
    aircraft = VirtualAircraft(POSE)
    up = aircraft.truth_at(0.0).force_m_s2 / np.linalg.norm(aircraft.truth_at(0.0).force_m_s2)
    pni = PniCompass(aircraft, mounting_deg=mounting)
    pni.components = (5, 24, 25)
    rion = RionCompass(aircraft, mounting_deg=mounting)
    for samples in (PniDecoder().feed(pni.reading(0.0), 0.0), RionDecoder().feed(rion.reading(0.0), 0.0)):
        (sample,) = samples
        assert isinstance(sample, CompassSample)
        assert sample.pitch_deg is not None
        assert sample.roll_deg is not None
        found = rotation_matrix(mounting) @ up_in_sensor("euler", sample.roll_deg, sample.pitch_deg)
        assert found == pytest.approx(up, abs=2e-4)


def test_a_witmotion_epoch_byte_by_byte() -> None:
    aircraft = VirtualAircraft(Pose(0.0, 0.0, 0.0), Site(0.0, 0.0, 0.0), temperature_degc=25.0)
    imu = ImuModel(aircraft, "perfect", mounting_deg=WT901, gyro_bias_rad_s=(math.radians(100), math.radians(-50), 0))
    (frame,) = WitMotionImu(imu).frames_until(0.0)
    assert len(frame.data) == 44
    counts = round(aircraft.site.gravity_m_s2 / 9.80665 * 2048)
    accel = b"\x55\x51" + struct.pack("<4h", 0, 0, counts, 2500)
    assert frame.data[:11] == accel + bytes([sum(accel) % 256])
    assert frame.data[11:22] == bytes.fromhex("55526606CDFC0000C409A9")
    # Level, X right (east): no roll, no pitch, no yaw from east.
    assert frame.data[22:33] == bytes.fromhex("55530000000000000000A8")
    x, y, z = struct.unpack_from("<3h", frame.data, 35)
    assert (x, y, z) == (0, 280, -450)  # east, north, up in milligauss


@pytest.mark.parametrize(
    ("mounting_deg", "imu_mounting", "tilt_mounting"),
    [(WT901, "ROTATION_ROLL_180_YAW_90", "ROTATION_YAW_90"), (WT901SDCL, "ROTATION_ROLL_180", "ROTATION_NONE")],
)
def test_the_mountings_in_the_docs_turn_a_witmotion_into_the_vehicle(
    mounting_deg: tuple[float, float, float], imu_mounting: str, tilt_mounting: str
) -> None:
    aircraft = VirtualAircraft(Pose(25.0, -40.0, 70.0))
    rate, force = aircraft.truth_at(0.0)
    bias = np.array([0.2, -0.3, 0.4])  # so that there is a rate to be turned
    imu = ImuModel(aircraft, "perfect", mounting_deg=mounting_deg, gyro_bias_rad_s=tuple(bias))
    samples = WitMotionDecoder().feed(WitMotionImu(imu).frames_until(0.0)[0].data + NEXT, 0.0)
    own, tilt = samples
    assert isinstance(own, ImuSample)
    assert isinstance(tilt, TiltSample)
    turned = rotation_matrix(imu_mounting)
    assert turned @ own.accel_m_s2 == pytest.approx(force, abs=0.005)
    assert turned @ own.gyro_rad_s == pytest.approx(rate + imu.mounting @ bias, abs=0.001)
    found = rotation_matrix(tilt_mounting) @ up_in_sensor("euler", tilt.x_deg, tilt.y_deg)
    assert found == pytest.approx(force / np.linalg.norm(force), abs=2e-4)
    inclinometer = WitMotionInclinometer(aircraft, noise_deg=0.0, mounting_deg=mounting_deg)
    (alone, *_) = WitMotionDecoder().feed(b"".join(f.data for f in inclinometer.frames_until(0.5)), 0.0)
    assert alone == tilt
