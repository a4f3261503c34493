"""Xsens MTData2 messages."""

from __future__ import annotations

import math
import struct
from functools import partial

import pytest

from companion.protocols.imus.xsens import MAX_DATA_BYTES, XsensDecoder
from companion.samples import ImuSample
from tests.support import decoders
from tests.support.decoders import XSENS_BYTES
from tests.support.frames import big_floats, mtdata2, xbus, xsens_imu

MESSAGE = xsens_imu()
GYRO_RAD_S, ACCEL_M_S2 = (0.25, -0.5, 0.75), (0.5, -0.25, 9.75)
ACCEL, GYRO = (0x4020, big_floats(*ACCEL_M_S2)), (0x8020, big_floats(*GYRO_RAD_S))
SAMPLE = ImuSample(1.0, GYRO_RAD_S, ACCEL_M_S2)

feed = partial(decoders.feed, XsensDecoder)


def fixed_12_20(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))


def fixed_16_32(*values: float) -> bytes:
    counts = [round(value * 2**32) for value in values]
    return b"".join((count & 0xFFFFFFFF).to_bytes(4, "big") + struct.pack(">h", count >> 32) for count in counts)


def test_the_test_bench_computes_the_documented_checksums() -> None:
    assert xbus(0x30) == bytes.fromhex("FAFF3000D1")
    assert xbus(0x10) == bytes.fromhex("FAFF1000F1")


def test_a_message_has_a_counter_and_the_device_clock() -> None:
    stamped = ImuSample(1.0, GYRO_RAD_S, ACCEL_M_S2, None, 7, 5.0)
    assert feed(MESSAGE) == ([stamped], {})
    assert feed(mtdata2([GYRO, ACCEL])) == ([SAMPLE], {})


@pytest.mark.parametrize(
    ("nibble", "encode"),
    [
        (0, big_floats),
        (1, fixed_12_20),
        (2, fixed_16_32),
        (3, lambda *values: struct.pack(f">{len(values)}d", *values)),
    ],
)
def test_all_four_number_formats(nibble: int, encode: object) -> None:
    assert callable(encode)
    fields = [(0x4020 | nibble, encode(*ACCEL_M_S2)), (0x8020 | nibble, encode(*GYRO_RAD_S))]
    assert feed(mtdata2(fields)) == ([SAMPLE], {})
    assert feed(mtdata2([(0x0810 | nibble, encode(-21.5)), *fields]))[0][0].temperature_degc == -21.5  # type: ignore[union-attr]


def test_the_extended_length_and_messages_that_need_it() -> None:
    assert feed(mtdata2([ACCEL, GYRO], extended=True)) == ([SAMPLE], {})
    assert feed(mtdata2([ACCEL, (0x2010, bytes(200)), (0x7070, bytes(200)), GYRO])) == ([SAMPLE], {})
    false_start = b"\xfa\xff\x36\xff" + (MAX_DATA_BYTES + 1).to_bytes(2, "big")
    assert feed(false_start + MESSAGE) == (feed(MESSAGE)[0], {"too long": 1})


def test_high_rate_outputs_serve_where_the_usual_ones_are_missing() -> None:
    accel_hr, gyro_hr = (0x4040, big_floats(1, 2, 3)), (0x8040, big_floats(4, 5, 6))
    assert feed(mtdata2([accel_hr, gyro_hr])) == ([ImuSample(1.0, (4, 5, 6), (1, 2, 3))], {})
    assert feed(mtdata2([accel_hr, gyro_hr, ACCEL, GYRO])) == ([SAMPLE], {})
    assert feed(mtdata2([ACCEL, gyro_hr])) == ([ImuSample(1.0, (4, 5, 6), ACCEL_M_S2)], {})


def test_a_temperature_is_held_until_the_next_and_over_no_interruption() -> None:
    decoder = XsensDecoder()
    plain, warm = mtdata2([ACCEL, GYRO]), mtdata2([(0x0810, big_floats(31.5)), ACCEL, GYRO])
    temperatures = [
        sample.temperature_degc
        for sample in decoder.feed(plain + warm + plain, 1.0)
        if isinstance(sample, ImuSample)
    ]  # fmt: skip
    assert temperatures == [None, 31.5, 31.5]
    decoder.interrupted()
    (sample,) = decoder.feed(plain, 2.0)
    assert isinstance(sample, ImuSample)
    assert sample.temperature_degc is None


@pytest.mark.parametrize("bit", range(8, 14))
def test_a_clipped_axis_is_not_a_measurement(bit: int) -> None:
    assert feed(mtdata2([ACCEL, GYRO, (0xE020, struct.pack(">I", 1 << bit))])) == ([], {"over range": 1})


def test_other_bits_of_the_status_are_no_reason() -> None:
    status = (0xE020, struct.pack(">I", 0xFFFFFFFF & ~0x3F00))
    assert feed(mtdata2([ACCEL, GYRO, status])) == ([SAMPLE], {})


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (xbus(0x3E), "reply"),
        (xbus(0x42, b"\x03"), "reply"),
        (mtdata2([]), "nothing of use"),
        (mtdata2([ACCEL]), "nothing of use"),
        (mtdata2([(0xC020, big_floats(0.5, -0.25, 0.75))]), "nothing of use"),
        (xbus(0x36, b"\x40\x20\x0c" + bytes(11)), "field count"),
        (mtdata2([(0x4020, bytes(8)), GYRO]), "field count"),
        (mtdata2([(0x1020, bytes(4)), ACCEL, GYRO]), "field count"),
        (mtdata2([(0x1060, bytes(2)), ACCEL, GYRO]), "field count"),
        (mtdata2([(0x4024, big_floats(1, 2, 3)), GYRO]), "unknown field"),
        (xsens_imu(accel=(math.inf, -math.inf, 0)), "non-finite"),
        (xsens_imu(gyro=(0, 0, 1e6)), "out of range"),
        (MESSAGE[:-1] + bytes([MESSAGE[-1] ^ 1]), "checksum"),
    ],
)
def test_messages_that_give_nothing_are_counted_by_reason(data: bytes, reason: str) -> None:
    assert feed(data + MESSAGE + bytes(XSENS_BYTES)) == (feed(MESSAGE)[0], {reason: 1})
