"""VectorNav: sentences and binary frames on one port."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest

from companion.protocols.imus.vectornav import VectorNavDecoder
from companion.samples import ImuSample
from tests.support import decoders
from tests.support.decoders import VECTORNAV_BYTES
from tests.support.frames import (
    COMMON_SIZES,
    IMU_SIZES,
    crc16_xmodem,
    floats,
    sentence,
    vectornav_binary,
    vectornav_imu,
)

YMR = sentence("VNYMR,+010.000,-007.500,+000.500,-0.5,-0.25,+0.75,-01.500,-00.125,-09.750,-00.5,+00.25,-00.125")
IMU = sentence("VNIMU,-0.5,-0.25,+0.75,-01.500,-00.125,-09.750,-00.5,+00.25,-00.125,+21.5,+101.325")
BINARY = vectornav_imu()

feed = partial(decoders.feed, VectorNavDecoder)


def test_the_test_bench_computes_the_known_crc() -> None:
    assert crc16_xmodem(b"123456789") == 0x31C3


def test_ymr_gives_rate_and_force() -> None:
    assert feed(YMR) == (
        [
            ImuSample(1.0, (-0.5, 0.25, -0.125), (-1.5, -0.125, -9.75)),
        ],
        {},
    )


def test_imu_has_a_temperature() -> None:
    assert feed(IMU) == (
        [
            ImuSample(1.0, (-0.5, 0.25, -0.125), (-1.5, -0.125, -9.75), 21.5),
        ],
        {},
    )


def test_a_sentence_may_carry_a_crc_instead() -> None:
    body = YMR[1:].split(b"*")[0]
    assert len(feed(b"$" + body + b"*%04X\r\n" % crc16_xmodem(body))[0]) == 1
    assert feed(b"$" + body + b"*%04X\r\n" % (crc16_xmodem(body) ^ 1)) == ([], {"checksum": 1})


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (sentence("VNERR,03"), "VNERR"),
        (sentence("VNRRG,8,+006.271,+000.031,-002.000"), "reply"),
        (sentence("VNQTN,0,0,0,1"), "unknown sentence"),
        (sentence("VNYMR,1,2,3"), "field count"),
        (YMR.replace(b"-007.500", b"-007.501"), "checksum"),
        (YMR[:-4] + b"XX\r\n", "no checksum"),
        (YMR[:40] + b"\x00" + YMR[40:], "cut short"),
        (b"$VN" + b"1" * 400 + b"\r\n", "too long"),
        (sentence("VNYMR,0,0,0,0,0,0,0,0,-inf,0,0,0"), "non-finite"),
        (sentence("VNYMR,0,0,0,0,0,0,0,0,-9999,0,0,0"), "out of range"),
        (sentence("VNYMR,0,0,0,0,0,0,0,0,-9.8,0,0,x"), "not a number"),
    ],
)
def test_sentences_that_give_nothing_are_counted_by_reason(data: bytes, reason: str) -> None:
    assert feed(data) == ([], {reason: 1})


def test_the_set_up_for_a_calibration() -> None:
    assert BINARY[:6] == bytes.fromhex("FA0521011000")
    assert feed(BINARY) == ([ImuSample(1.0, (0.25, -0.5, 0.75), (0.5, -0.25, -9.75), 25.5, None, 5.0)], {})


@pytest.mark.parametrize("group", [1, 3])
def test_each_field_has_its_size_and_place(group: int) -> None:
    """Each bit alone, and all of them: the frame is read to its end, so the next one is found without a loss."""
    sizes = COMMON_SIZES if group == 1 else IMU_SIZES
    for mask in [1 << bit for bit in range(len(sizes))] + [(1 << len(sizes)) - 1]:
        fields = {bit: bytes(size) for bit, size in enumerate(sizes) if mask >> bit & 1}
        samples, rejected = feed(vectornav_binary({group: fields}) + BINARY)
        assert samples[-1:] == feed(BINARY)[0]
        assert rejected in ({}, {"nothing of use": 1}), mask


def test_values_come_from_their_own_fields() -> None:
    """Every float of a frame with all fields is different; which ones arrive where is written out here."""
    common = {bit: bytes(size) for bit, size in enumerate(COMMON_SIZES)}
    common |= {0: struct.pack("<Q", 123_456_789_000), 3: floats(11, 12, 13), 5: floats(21, 22, 23)}
    common |= {8: floats(31, 32, 33), 9: floats(41, 42, 43, 51, 52, 53), 10: floats(1, 2, 3, 61, 62)}
    imu = {bit: bytes(size) for bit, size in enumerate(IMU_SIZES)} | {4: floats(71)}
    assert feed(vectornav_binary({1: common, 3: imu}))[0] == [
        ImuSample(1.0, (21, 22, 23), (31, 32, 33), 71, None, 123.456789),
    ]
    assert feed(vectornav_binary({1: common}))[0][0] == ImuSample(1.0, (21, 22, 23), (31, 32, 33), 61, None, 123.456789)
    uncompensated = {9: floats(41, 42, 43, 51, 52, 53)}
    assert feed(vectornav_binary({1: uncompensated}))[0] == [ImuSample(1.0, (51, 52, 53), (41, 42, 43))]
    group_3 = {1: floats(1, 2, 3), 2: floats(4, 5, 6), 3: floats(7, 8, 9)}
    assert feed(vectornav_binary({3: group_3}))[0] == [
        ImuSample(1.0, (7, 8, 9), (4, 5, 6)),
    ]
    group_3 |= {8: floats(1.5, 2.5, 3.5), 9: floats(4.5, 5.5, 6.5), 10: floats(7.5, 8.5, 9.5)}
    assert feed(vectornav_binary({3: group_3}))[0] == [
        ImuSample(1.0, (7.5, 8.5, 9.5), (4.5, 5.5, 6.5)),
    ]


def test_a_compensated_rate_is_paired_with_an_uncompensated_force_only_for_want_of_better() -> None:
    mixed = {1: {5: floats(1, 2, 3)}, 3: {2: floats(4, 5, 6)}}
    assert feed(vectornav_binary(mixed))[0] == [ImuSample(1.0, (1, 2, 3), (4, 5, 6))]
    mixed[3][3] = floats(7, 8, 9)
    assert feed(vectornav_binary(mixed))[0] == [ImuSample(1.0, (7, 8, 9), (4, 5, 6))]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (vectornav_binary({1: {15: bytes(4)}}), "unknown field"),
        (vectornav_binary({1: {}}), "unknown field"),
        (vectornav_binary({5: {1: bytes(12)}}), "unknown group"),
        (vectornav_binary({1: {0: bytes(8)}, 2: {0: bytes(8)}}), "unknown group"),
        (vectornav_binary({1: {5: floats(0, 0, 0)}}), "nothing of use"),
        (vectornav_imu(temperature=math.nan), "non-finite"),
        (vectornav_imu(gyro=(0, 0, 1e6)), "out of range"),
        (vectornav_binary({1: {10: floats(1, 0, 0, 20, 100)}}), "nothing of use"),
        (BINARY[:-1] + bytes([BINARY[-1] ^ 1]), "checksum"),
    ],
)
def test_binary_frames_that_give_nothing_are_counted_by_reason(data: bytes, reason: str) -> None:
    samples, rejected = feed(data + bytes(VECTORNAV_BYTES))
    assert samples == []
    assert rejected == {reason: 1}


def test_a_value_that_is_not_used_may_be_anything() -> None:
    velocity = {5: floats(1, 2, 3), 7: floats(math.nan, math.nan, math.nan), 8: floats(4, 5, 6)}
    assert feed(vectornav_binary({1: velocity}))[0] == [ImuSample(1.0, (1, 2, 3), (4, 5, 6))]


def test_a_frame_held_back_by_a_false_start_keeps_its_time() -> None:
    decoder = VectorNavDecoder(seconds_per_byte=0.001)
    false_start = b"\xfa\x01\xff\x7f"  # claims all fields of group 1, 204 bytes
    assert decoder.feed(false_start + BINARY + b"\x00", 10.0) == []
    assert decoder.feed(bytes(50), 10.1) == []
    samples = decoder.feed(bytes(300), 10.5)
    assert [sample.t_s for sample in samples] == pytest.approx([10.0 - 0.001])
