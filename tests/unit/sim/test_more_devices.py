"""Other simulated devices: bytes by hand and from the vendors' documents; readings lead back to the truth."""

from __future__ import annotations

import binascii
import math
import re
import struct

import numpy as np
import pytest

from companion.physics.frames import rotation_matrix
from companion.physics.gradienter import up_in_sensor
from companion.samples import CompassSample, ImuSample, Sample, TiltSample
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.binary_imus import WIT_Z_UP, WitMotionImu
from sim.compasses import NmeaCompass, Os5000, PniCompass, RionCompass
from sim.devices import SerialDevice
from sim.gradienters import BeiInclinometer, Jewell, RionInclinometer
from sim.imu_model import ImuModel
from sim.scenario import IMUS
from tests.support.decoders import make_decoder
from tests.support.frames import xor

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
FLU = np.array([1.0, -1.0, -1.0])
"""Device axes of what lies on its base with Z up, as parts of forward, right, down."""
WT901 = (180.0, 0.0, 90.0)
"""Mounting of a WitMotion device with X right, Y forward, Z up."""
RION_READ = bytes.fromhex("6804000408")
PNI_READ = bytes.fromhex("000504BF71")


def checked(line: bytes) -> list[str]:
    match = re.fullmatch(rb"\$([^*]*)\*([0-9A-F]{2})\r\n", line)
    assert match, line
    assert xor(match[1]) == int(match[2], 16)
    return match[1].decode().split(",")


def aircraft(declination_deg: float = 0.0) -> VirtualAircraft:
    return VirtualAircraft(POSE, Site(40.0, 116.0, 50.0, declination_deg=declination_deg), temperature_degc=21.5)


def decoded(device: SerialDevice, role: str, seconds: float) -> tuple[list[Sample], dict[str, int]]:
    decoder = make_decoder(role, device.protocol)  # type: ignore[arg-type]
    data = device.power_on(0.0) + b"".join(frame.data for frame in device.frames_until(seconds))
    samples = decoder.feed(data, 1.0)
    return samples, dict(decoder.rejected)


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
    device.command(b"*9900XYC-OFF\r\n", 1.0)
    assert device.frames_until(2.0) == []


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


def test_hmr3000_sentences() -> None:
    device = NmeaCompass(aircraft(-7.5), heading_noise_deg=0.0, noise_deg=0.0, sentences=())
    assert device.frames_until(10.0) == []
    assert checked(device.command(b"$PTNT,HPR*78\r\n", 10.0)) == ["PTNTHPR", "47.5", "N", "5.0", "N", "-3.0", "N"]
    assert checked(device.command(b"$TNHCQ,HDT*34\r\n", 10.0)) == ["HCHDT", "40.0", "T"]
    assert device.command(b"$PTNT,HPR*79\r\n#FA0.4=1*21\r\n\xff\xff", 10.0) == b""
    device.sentences = ("HPR", "HDT")
    assert {frame.data.count(b"$") for frame in device.frames_until(14.0)} == {2}


def test_os5000_lines_and_its_rate() -> None:
    device = Os5000(aircraft(-7.5), heading_noise_deg=0.0)
    (line,) = {frame.data for frame in device.frames_until(0.0)}
    assert re.fullmatch(r"C47\.5P[45]\.\dR-[23]\.\dT21\.5", checked(line)[0])
    device.command(b"\x1bR0 ", 0.0)
    assert device.frames_until(1.0) == []
    device.command(b"\x1bR10 ", 1.0)
    assert device.frames_until(2.0)


def test_pni_answers_byte_by_byte_and_forgets_what_was_not_saved() -> None:
    device = PniCompass(VirtualAircraft(Pose(0.0, 0.0, 90.0)), heading_noise_deg=0.0)
    assert device.power_on(0.0) == b""
    assert device.frames_until(1.0) == []  # poll mode
    assert device.command(bytes.fromhex("000501EFD4"), 1.0) == bytes.fromhex("000D0254524158313230387BD8")
    assert device.command(bytes.fromhex("000504BF70"), 1.0) == b""  # wrong CRC
    assert device.command(PNI_READ[:3], 1.0) + device.command(PNI_READ[3:], 1.0) == device.reading(1.0)
    body = bytes.fromhex("000803020518")
    answer = device.command(body + struct.pack(">H", binascii.crc_hqx(body, 0)) + PNI_READ, 1.0)
    assert answer[:-2] == bytes.fromhex("00100502 05") + struct.pack(">f", 90.0) + b"\x18" + struct.pack(">f", 0.0)
    assert binascii.crc_hqx(answer, 0) == 0
    device.power_on(1.0)
    assert (device.components, device.saves) == ((5, 79), 0)
    device.command(bytes.fromhex("000515BD61"), 1.0)
    assert len(device.frames_until(2.0)) == 11


def test_a_rion_compass_prints_what_the_manual_prints() -> None:
    """HCM370B p. 11: pitch +10.50, roll -10.05, heading 104.01."""
    device = RionCompass(VirtualAircraft(Pose(10.5, -10.05, 104.01)), heading_noise_deg=0.0)
    frame = bytes.fromhex("680D00840010501010050104011C")
    assert device.command(RION_READ, 0.0) == frame
    assert device.command(bytes.fromhex("6804010409"), 0.0) == b""  # somebody else's address
    assert device.frames_until(1.0) == []
    assert device.command(bytes.fromhex("6805000C0112"), 1.0) == bytes.fromhex("6805008C0091")
    assert {sent.data for sent in device.frames_until(2.0)} == {frame}


def test_a_rion_inclinometer_gives_the_elevation_of_each_axis() -> None:
    device = RionInclinometer(VirtualAircraft(Pose(20.0, 30.0, 77.0)), noise_deg=0.0)
    data = bytes.fromhex("00280243 00200000 000000")
    wanted = bytes.fromhex("680F0084") + data + bytes([(0x0F + 0x84 + sum(data)) % 256])
    assert device.command(RION_READ, 0.0) == wanted
    assert device.frames_until(1.0) == []


@pytest.mark.parametrize("mounting", [(0.0, 0.0, 0.0), (10.0, -5.0, 200.0)])
def test_a_compass_tilt_leads_back_to_up(mounting: tuple[float, float, float]) -> None:
    craft = VirtualAircraft(POSE)
    up = craft.truth_at(0.0).force_m_s2 / np.linalg.norm(craft.truth_at(0.0).force_m_s2)
    pni, rion = PniCompass(craft, mounting_deg=mounting), RionCompass(craft, mounting_deg=mounting)
    pni.components = (5, 24, 25)
    for device in (pni, rion):
        (sample,) = make_decoder("compass", device.protocol).feed(device.reading(0.0), 0.0)
        assert isinstance(sample, CompassSample)
        assert sample.pitch_deg is not None
        assert sample.roll_deg is not None
        found = rotation_matrix(mounting) @ up_in_sensor("euler", sample.roll_deg, sample.pitch_deg)
        assert found == pytest.approx(up, abs=2e-4)


def test_a_witmotion_epoch_byte_by_byte() -> None:
    craft = VirtualAircraft(Pose(0.0, 0.0, 0.0), Site(0.0, 0.0, 0.0), temperature_degc=25.0)
    imu = ImuModel(craft, "perfect", mounting_deg=WT901, gyro_bias_rad_s=(math.radians(100), math.radians(-50), 0))
    (frame,) = WitMotionImu(imu).frames_until(0.0)
    counts = round(craft.site.gravity_m_s2 / 9.80665 * 2048)
    accel = b"\x55\x51" + struct.pack("<4h", 0, 0, counts, 2500)
    assert frame.data[:11] == accel + bytes([sum(accel) % 256])
    assert frame.data[11:22] == bytes.fromhex("55526606CDFC0000C409A9")
    # Level, X right (east): no roll, no pitch, no yaw from east.
    assert frame.data[22:33] == bytes.fromhex("55530000000000000000A8")
    assert struct.unpack_from("<3h", frame.data, 35) == (0, 280, -450)  # east, north, up in milligauss


@pytest.mark.parametrize(
    ("mounting_deg", "imu_mounting", "tilt_mounting"),
    [(WT901, "ROTATION_ROLL_180_YAW_90", "ROTATION_YAW_90"), (WIT_Z_UP, "ROTATION_ROLL_180", "ROTATION_NONE")],
)
def test_the_mountings_in_the_docs_turn_a_witmotion_into_the_vehicle(
    mounting_deg: tuple[float, float, float], imu_mounting: str, tilt_mounting: str
) -> None:
    craft = VirtualAircraft(Pose(25.0, -40.0, 70.0))
    rate, force = craft.truth_at(0.0)
    bias = np.array([0.2, -0.3, 0.4])  # so that there is a rate to be turned
    device = WitMotionImu(ImuModel(craft, "perfect", mounting_deg=mounting_deg, gyro_bias_rad_s=tuple(bias)))
    own, tilt, *_ = decoded(device, "imu", 0.5)[0]
    assert isinstance(own, ImuSample)
    assert isinstance(tilt, TiltSample)
    turned = rotation_matrix(imu_mounting)
    assert turned @ own.accel_m_s2 == pytest.approx(force, abs=0.005)
    assert turned @ own.gyro_rad_s == pytest.approx(rate + device.imu.mounting @ bias, abs=0.001)
    found = rotation_matrix(tilt_mounting) @ up_in_sensor("euler", tilt.x_deg, tilt.y_deg)
    assert found == pytest.approx(force / np.linalg.norm(force), abs=2e-4)


@pytest.mark.parametrize(("name", "signs", "replies"), [("mip", np.ones(3), 0), ("xsens", FLU, 1), ("stim300", FLU, 3)])
def test_the_mean_of_what_is_decoded_is_the_truth_in_the_device_s_axes(
    name: str, signs: np.ndarray, replies: int
) -> None:
    craft = VirtualAircraft(POSE)
    device = IMUS[name](ImuModel(craft, "adis16470", seed=3))
    samples, rejected = decoded(device, "imu", 20.0)
    readings = [sample for sample in samples if isinstance(sample, ImuSample)]
    assert len(readings) == 20 * device.rate_hz + 1
    assert rejected == ({"reply": replies} if replies else {})
    model = ImuModel(craft, "adis16470", seed=3)
    expected = model.read(np.arange(len(readings)) / device.rate_hz, 1 / device.rate_hz).mean(axis=0)
    gyro = np.mean([sample.gyro_rad_s for sample in readings], axis=0)
    accel = np.mean([sample.accel_m_s2 for sample in readings], axis=0)
    assert gyro == pytest.approx(expected[:3] * signs, abs=2e-5)
    assert accel == pytest.approx(expected[3:] * signs, abs=2e-4)
    assert np.sign(accel[2]) == -signs[2]
