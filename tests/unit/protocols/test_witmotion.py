"""WitMotion devices: frames of one epoch, and a sum that is believed only in company."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest

from companion.protocols.imus.witmotion import WitMotionDecoder
from companion.samples import ImuSample, TiltSample
from tests.support import decoders
from tests.support.frames import sum8, wit, wit_imu

NEXT = wit(0x50)
"""A frame that gives nothing, so that the one before is believed."""
G = 9.80665

feed = partial(decoders.feed, WitMotionDecoder)


def imu_of(data: bytes) -> ImuSample:
    (sample,), rejected = feed(data)
    assert rejected == {}
    assert isinstance(sample, ImuSample)
    return sample


def test_acceleration_and_rate_of_an_epoch_are_one_sample() -> None:
    sample = imu_of(wit(0x51, 2048, -1024, 512, last=2534) + wit(0x52, 16384, -8192, 1, last=-5) + NEXT)
    assert sample.accel_m_s2 == pytest.approx((G, -G / 2, G / 4), rel=1e-12)
    assert sample.gyro_rad_s == pytest.approx([math.radians(x) for x in (1000, -500, 2000 / 32768)], rel=1e-12)
    assert sample.temperature_degc == 25.34
    assert (sample.t_s, sample.sequence, sample.t_device_s) == (1.0, None, None)


def test_a_sample_has_the_time_of_its_last_frame_however_late_it_is_believed() -> None:
    decoder = WitMotionDecoder(0.001)
    assert decoder.feed(wit_imu(), 5.0) == []
    (sample,) = decoder.feed(NEXT, 9.0)
    assert sample.t_s == 5.0
    decoder = WitMotionDecoder(0.001)
    (sample,) = decoder.feed(wit_imu() + NEXT, 5.0)
    assert sample.t_s == pytest.approx(5.0 - 0.011)


def test_angles_are_a_tilt_with_the_nose_up() -> None:
    """Turned Z-Y-X about X forward, Y left, Z up, pitch is positive nose down."""
    assert feed(wit(0x53, 8192, -4096, 100, 7) + NEXT) == ([TiltSample(1.0, 45.0, 22.5)], {})
    assert feed(wit(0x53, 16385, 0) + NEXT) == ([], {"out of range": 1})
    assert feed(wit(0x53, 0, -32768) + NEXT) == ([], {"out of range": 1})


def test_a_field_gives_no_sample_and_is_understood() -> None:
    decoder = WitMotionDecoder()
    assert decoder.feed(wit(0x54, 360, 105, -122) + NEXT, 1.0) == []
    assert (decoder.accepted, decoder.rejected.total()) == (1, 0)


@pytest.mark.parametrize("kind", [0x50, 0x5F])
def test_other_frames_are_passed_over_and_keep_no_epoch_together(kind: int) -> None:
    decoder = WitMotionDecoder()
    assert decoder.feed(wit(kind, 1, 2, 3) + NEXT, 1.0) == []
    assert (decoder.accepted, decoder.rejected.total()) == (0, 0)
    assert feed(wit(0x51) + wit(kind) + wit(0x52) + NEXT) == ([], {"orphan": 2})


def test_only_neighbours_belong_together() -> None:
    accel, gyro = wit(0x51, 1), wit(0x52, 2)
    assert feed(gyro + NEXT) == ([], {"orphan": 1})
    assert feed(accel + NEXT + NEXT) == ([], {"orphan": 1})
    assert feed(accel + accel + NEXT + NEXT) == ([], {"orphan": 2})
    samples, rejected = feed(accel + accel + gyro + gyro + NEXT)
    assert (len(samples), rejected) == (1, {"orphan": 2})
    # The rate is lost, and with it the next epoch's acceleration is not taken for this one's.
    samples, rejected = feed(accel + accel + b"x" + gyro + NEXT)
    assert (samples, rejected) == ([], {"incomplete pair": 1, "orphan": 2})


def test_a_frame_alone_is_not_believed() -> None:
    assert feed(wit(0x53) + bytes(11)) == ([], {"incomplete pair": 1})
    assert feed(wit(0x53) + b"x" + wit(0x53) + NEXT)[1] == {"incomplete pair": 1}
    bad = bytearray(wit(0x53))
    bad[5] ^= 1
    assert feed(wit(0x53) + bytes(bad) + bytes(11)) == ([], {"incomplete pair": 1, "checksum": 1})


def test_the_last_frame_waits_for_another() -> None:
    decoder = WitMotionDecoder()
    assert decoder.feed(wit(0x53, 1), 1.0) == []
    assert len(decoder.feed(wit(0x53, 2), 2.0)) == 1
    decoder.interrupted()
    assert decoder.rejected == {"cut short": 1}
    assert decoder.feed(wit(0x53, 3), 3.0) == []


def test_an_interruption_parts_an_epoch() -> None:
    decoder = WitMotionDecoder()
    decoder.feed(wit_imu(), 1.0)
    decoder.interrupted()
    assert decoder.rejected == {"orphan": 1, "cut short": 1}
    assert decoder.feed(wit(0x52) + NEXT, 2.0) == []
    assert decoder.rejected["orphan"] == 2


@pytest.mark.parametrize("value", [32767, -32768])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_end_of_the_scale_is_no_measurement(value: int, axis: int) -> None:
    ends = [value if index == axis else 0 for index in range(3)]
    assert feed(wit(0x51, *ends) + wit(0x52) + NEXT) == ([], {"over range": 1, "orphan": 1})
    assert feed(wit(0x51) + wit(0x52, *ends) + NEXT) == ([], {"over range": 1})


def test_bluetooth_packets_are_not_read() -> None:
    decoder = WitMotionDecoder()
    assert decoder.feed((b"\x55\x61" + bytes(18)) * 5, 1.0) == []
    assert decoder.feed(bytes.fromhex("5571 3A00 6801 6900 7A00") + bytes(10), 1.0) == []


def test_the_data_sheets_wrong_sums_are_rejected() -> None:
    """WT901 p. 13 adds 0x53 for a 0x54 frame, and p. 10 0x51 for a 0x50 frame."""
    for kind, added in ((0x54, 0x53), (0x50, 0x51)):
        body = bytes([0x55, kind]) + struct.pack("<4h", 360, 105, 122, 0)
        wrong = body + bytes([(sum8(body) - kind + added) % 256])
        assert feed(wrong + NEXT + NEXT) == ([], {"checksum": 1})
