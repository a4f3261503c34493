"""MicroStrain MIP packets."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest

from companion.protocols.imus.mip import MipDecoder
from companion.samples import ImuSample
from tests.support import decoders
from tests.support.decoders import MIP_BYTES
from tests.support.frames import big_floats, fletcher, mip, mip_imu

G = 9.80665
PACKET = mip_imu()
ACCEL, GYRO = (0x04, big_floats(0.5, -0.25, -1.0)), (0x05, big_floats(0.25, -0.5, 0.75))

feed = partial(decoders.feed, MipDecoder)


def test_the_test_bench_computes_the_documented_checksums() -> None:
    for packet in ("756501020201E0C6", "756501020202E1C7", "756501020206E5CB", "7565010404F10100D56A"):
        whole = bytes.fromhex(packet)
        assert fletcher(whole[:-2]) == whole[-2:]


def test_rate_and_force_of_one_packet_make_a_sample_in_si() -> None:
    assert feed(PACKET) == ([ImuSample(1.0, (0.25, -0.5, 0.75), (0.5 * G, -0.25 * G, -G), None, None, 5.0)], {})
    assert feed(mip([GYRO, ACCEL])) == ([ImuSample(1.0, (0.25, -0.5, 0.75), (0.5 * G, -0.25 * G, -G))], {})


def test_a_field_that_is_not_used_is_stepped_over_by_its_length() -> None:
    others = [(0x17, big_floats(1013.0)), (0x06, big_floats(0.25, -0.125, 0.5)), (0x9F, b"")]
    assert feed(mip([others[0], ACCEL, others[1], GYRO, others[2]])) == feed(mip([ACCEL, GYRO]))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (mip([ACCEL]), "nothing of use"),
        (mip([]), "nothing of use"),
        (mip([(0x06, big_floats(0.25, -0.125, 0.5))]), "nothing of use"),
        (mip([ACCEL, GYRO], descriptor_set=0x82), "nothing of use"),
        (mip([(0xF1, b"\x01\x00")], descriptor_set=0x01), "reply"),
        (mip([(0x04, bytes(8)), GYRO]), "field count"),
        (mip([ACCEL, GYRO, (0x12, bytes(8))]), "field count"),
        (mip_imu(time_s=math.nan), "non-finite"),
        (mip_imu(accel_g=(math.inf, -math.inf, 0)), "non-finite"),
        (mip_imu(gyro=(0, 0, 1e6)), "out of range"),
        (PACKET[:-1] + bytes([PACKET[-1] ^ 1]), "checksum"),
    ],
)
def test_packets_that_give_nothing_are_counted_by_reason(data: bytes, reason: str) -> None:
    assert feed(data + PACKET + bytes(MIP_BYTES)) == (feed(PACKET)[0], {reason: 1})


@pytest.mark.parametrize("payload", [b"\x00", b"\x01\x04", b"\x0e\x04" + bytes(11), b"\x02"])
def test_a_field_whose_length_does_not_fit_its_packet_is_rejected(payload: bytes) -> None:
    head = bytes([0x75, 0x65, 0x80, len(payload)]) + payload
    assert feed(head + fletcher(head)) == ([], {"field count": 1})


def test_the_device_clock_is_the_time_of_week() -> None:
    week = (0x12, struct.pack(">dHH", 604_799.995, 2400, 0x0F))
    (sample,) = feed(mip([week, ACCEL, GYRO]))[0]
    assert isinstance(sample, ImuSample)
    assert sample.t_device_s == 604_799.995
