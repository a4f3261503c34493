"""Random bytes for every decoder, and bytes full of real and of damaged frames. Verified by brute force.

Ten million a decoder in `make long`, a slice of them in `make test`. The seeds are fixed: the same bytes every run.
"""

from __future__ import annotations

import math
import random
import struct
from collections import deque

import pytest

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder
from companion.protocols.compasses.nmea import NmeaDecoder
from companion.protocols.compasses.os5000 import Os5000Decoder
from companion.protocols.compasses.pni import PniDecoder
from companion.protocols.decoding.base import Decoder
from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.protocols.imus.mip import MipDecoder
from companion.protocols.imus.stim300 import Stim300Decoder
from companion.protocols.imus.vectornav import VectorNavDecoder
from companion.protocols.imus.witmotion import WitMotionDecoder
from companion.protocols.imus.xsens import MAX_DATA_BYTES, XsensDecoder
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.inclinometers.jewell import JewellDecoder
from companion.protocols.inclinometers.rion import RionDecoder
from companion.protocols.registry import PROTOCOLS
from companion.samples import CompassSample, ImuSample, Sample, TiltSample
from tests.support.decoders import make_decoder
from tests.support.extent import extent
from tests.support.frames import (
    imu_line,
    int24,
    mip_imu,
    one_after_another,
    pni_heading,
    right_binaries,
    right_mips,
    right_pni_data,
    right_rion_angles,
    right_sentences,
    right_stims,
    right_wit,
    right_xbus,
    rion_angles,
    rion_long,
    sentence,
    stim300,
    vectornav_imu,
    wit,
    wit_imu,
    xsens_imu,
)

SIZE = 1_000_000
RANDOM = extent(whole=10_000_000, a_slice=500_000)
CHUNK = 500
HELD = 1200
"""More than the longest frame of any device, with the times of its pieces and the reasons counted."""
EVERY = [(kind, name) for kind, names in PROTOCOLS.items() for name in names]


def noise_with_frames(seed: int, frames: list[bytes], size: int = SIZE) -> bytes:
    """Noise, whole frames, cut ones and damaged ones in turn."""
    source = random.Random(seed)
    pieces, total = [], 0
    while total < size:
        piece = bytearray(source.choice(frames))
        match source.randrange(4):
            case 0:
                piece = bytearray(source.randbytes(source.randrange(1, 60)))
            case 1:
                del piece[source.randrange(len(piece)) :]
            case 2:
                piece[source.randrange(len(piece))] = source.randrange(256)
            case _:
                pass
        pieces.append(bytes(piece))
        total += len(piece)
    return b"".join(pieces)


def chunks(seed: int, data: bytes) -> list[bytes]:
    source = random.Random(seed)
    cut, at = [], 0
    while at < len(data):
        size = source.randrange(1, 200)
        cut.append(data[at : at + size])
        at += size
    return cut


def held(decoder: Decoder) -> int:
    """How much a decoder keeps: bytes, and the items of whatever else may grow."""
    return sum(
        len(value) for value in vars(decoder).values() if isinstance(value, bytes | bytearray | deque | dict | list)
    )


@pytest.mark.parametrize("name", sorted({name for _, name in EVERY}))
def test_random_bytes(name: str) -> None:
    decoder = make_decoder(next(kind for kind, each in EVERY if each == name), name)
    noise, longest = random.Random(7), 0
    for _ in range(RANDOM // CHUNK):
        # None of it is a frame: that has been verified for the checksummed ones by the tests below on harder input.
        assert decoder.feed(noise.randbytes(CHUNK), 0.0) == []
        longest = max(longest, held(decoder))
    assert longest <= HELD
    assert decoder.accepted == 0


def test_imu_lines_in_noise() -> None:
    source = random.Random(3)
    frames = [imu_line(n, n * 2500, gyro=(source.uniform(-1, 1), 0.0, n / 1000)) for n in range(200)]
    data = noise_with_frames(4, frames)
    decoder = ImuLineDecoder()
    samples = [sample for chunk in chunks(5, data) for sample in decoder.feed(chunk, 0.0)]
    right = [data[found.start : found.end] for found in right_sentences(data, b"IMU,")]
    sent = {frame.rstrip(): frame for frame in frames}
    expected = [line for line in right if line in sent]
    assert len(expected) > 3000
    # Everything with a right checksum has been found, in order, and nothing else.
    assert len(samples) == len(right)
    for sample, line in zip(samples, right, strict=True):
        assert isinstance(sample, ImuSample)
        fields = line[1 : line.index(b"*")].split(b",")
        assert sample.sequence == int(fields[1])
        assert sample.gyro_rad_s == tuple(map(float, fields[3:6]))
    assert decoder.accepted == len(right)


def test_vectornav_frames_in_noise() -> None:
    source = random.Random(8)
    frames = [vectornav_imu(n * 2_500_000, gyro=(source.uniform(-1, 1), 0, 0)) for n in range(100)]
    frames += [sentence(f"VNYMR,{n},1,2,0,0,0,{n / 100},0,-9.8,0.1,{n / 10},0.3") for n in range(100)]
    data = noise_with_frames(9, frames)
    decoder = VectorNavDecoder()
    got = [sample for chunk in chunks(10, data) for sample in decoder.feed(chunk, 0.0) if isinstance(sample, ImuSample)]
    binaries, sentences = right_binaries(data), right_sentences(data, b"VN")
    expected: list[tuple[int, tuple[float, ...]]] = []
    for found in binaries:
        assert data[found.start : found.start + 6] == bytes.fromhex("FA0521011000")
        expected.append((found.start, struct.unpack_from("<3f", data, found.start + 14)))
    for found in sentences:
        fields = data[found.start + 1 : found.end - 3].split(b",")
        expected.append((found.start, tuple(map(float, fields[10:13]))))
    assert min(len(binaries), len(sentences)) > 1000
    assert [sample.gyro_rad_s for sample in got] == [gyro for _, gyro in sorted(expected)]


def test_pni_frames_in_noise() -> None:
    frames = [pni_heading(n / 4, n / 16, -n / 16) for n in range(1, 1400)]
    data = noise_with_frames(15, frames)
    decoder = PniDecoder()
    got = [sample for chunk in chunks(16, data) for sample in decoder.feed(chunk, 0.0)]
    right = right_pni_data(data)
    assert len(right) > 5000
    expected = [struct.unpack(">xxxx x f x f x f xx", data[found.start : found.end]) for found in right]
    assert [(s.heading_deg, s.pitch_deg, s.roll_deg) for s in got if isinstance(s, CompassSample)] == expected
    assert len(got) == decoder.accepted == len(right)


def test_rion_frames_in_noise() -> None:
    frames = [rion_angles(n / 100, -n / 200, n / 50) for n in range(0, 9000, 7)]
    frames += [rion_long(n / 10_000, -n / 20_000) for n in range(0, 900_000, 997)]
    sent = set(frames)
    data = noise_with_frames(17, frames)
    decoder = RionDecoder()
    got = [sample for chunk in chunks(18, data) for sample in decoder.feed(chunk, 0.0)]
    right = [data[found.start : found.end] for found in right_rion_angles(data)]
    # A sum of eight bits and digits that hold as well: of 8000 that have lost their ends or a byte some few get by.
    assert sum(frame not in sent for frame in right) < 20
    assert len(got) == len(right) > 10_000
    for sample, frame in zip(got, right, strict=True):
        assert RionDecoder().feed(frame, 0.0) == [sample]


def test_witmotion_frames_in_noise() -> None:
    source = random.Random(19)
    frames = [wit_imu((n, -n, 2048), (n, 0, source.randrange(-9, 9))) + wit(0x53, n, -n, 7, 1) for n in range(3000)]
    data = noise_with_frames(20, frames)
    decoder = WitMotionDecoder()
    got = [sample for chunk in chunks(21, data) for sample in decoder.feed(chunk, 0.0)]
    right = {found.start for found in right_wit(data)}
    ours = b"".join(frames)
    assert all(data[start : start + 11] in ours for start in right)  # no damaged one got by
    expected: list[tuple[float, ...]] = []
    for start in sorted(right):
        x, y, z = struct.unpack_from("<3h", data, start + 2)
        if data[start + 1] == 0x53:
            expected.append((x * 180 / 32768, -y * 180 / 32768))
        if data[start + 1] == 0x52 and start - 11 in right and data[start - 10] == 0x51:
            accel = struct.unpack_from("<3h", data, start - 9)
            expected.append(
                (*(a * 16 * 9.80665 / 32768 for a in accel), *(math.radians(w * 2000 / 32768) for w in (x, y, z)))
            )
    said = [(*s.accel_m_s2, *s.gyro_rad_s) if isinstance(s, ImuSample) else (s.x_deg, s.y_deg)
            for s in got if isinstance(s, ImuSample | TiltSample)]  # fmt: skip
    assert len(said) > 10_000
    assert [len(one) for one in said] == [len(one) for one in expected]
    for one, other in zip(said, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-12)


def gyros(samples: list[Sample]) -> list[tuple[float, ...]]:
    return [sample.gyro_rad_s for sample in samples if isinstance(sample, ImuSample)]


def test_mip_packets_in_noise() -> None:
    source = random.Random(15)
    data = noise_with_frames(16, [mip_imu(n, gyro=(source.uniform(-1, 1), n, 0)) for n in range(100)])
    decoder = MipDecoder()
    got = [sample for chunk in chunks(17, data) for sample in decoder.feed(chunk, 0.0)]
    right = one_after_another(right_mips(data))
    assert len(right) > 3000
    # The gyro field is the last of a packet: 12 bytes before the checksum.
    assert gyros(got) == [struct.unpack_from(">3f", data, found.end - 14) for found in right]
    assert decoder.accepted == len(right)


def test_xsens_messages_in_noise() -> None:
    source = random.Random(18)
    data = noise_with_frames(19, [xsens_imu(n, n, gyro=(source.uniform(-1, 1), n / 100, 0)) for n in range(100)])
    decoder = XsensDecoder()
    got = [sample for chunk in chunks(20, data) for sample in decoder.feed(chunk, 0.0)]
    right = one_after_another(right_xbus(data, MAX_DATA_BYTES))
    assert len(right) > 3000
    # One in 256 that were cut has the right sum by chance, over what came next; it is not as it was sent then.
    whole = [
        found for found in right if found.end - found.start == 47 and data[found.end - 16 :][:3] == b"\x80\x20\x0c"
    ]
    rates = [struct.unpack_from(">3f", data, found.end - 13) for found in whole]
    expected = [rate for rate in rates if max(map(abs, rate)) <= 100.0]
    assert decoder.rejected["field count"] == len(right) - len(whole)
    assert decoder.rejected["out of range"] == len(whole) - len(expected)
    assert len(got) == len(expected)
    assert gyros(got) == expected


def test_stim300_datagrams_in_noise() -> None:
    source = random.Random(21)
    counts = [source.randrange(-(2**20), 2**20) for _ in range(100)]
    data = noise_with_frames(22, [stim300(gyro=(count, 0, 0)) for count in counts], SIZE // 4)
    decoder = Stim300Decoder()
    got = [sample for chunk in chunks(23, data) for sample in decoder.feed(chunk, 0.0)]
    right = one_after_another(right_stims(data))
    assert len(right) > 1000
    sent = {int24(count): count for count in counts}
    expected = [sent[data[found.start + 1 : found.start + 4]] / 2**14 * math.pi / 180 for found in right]
    assert [gyro[0] for gyro in gyros(got)] == pytest.approx(expected)
    assert decoder.accepted == len(right)


def test_lines_without_a_checksum_in_noise() -> None:
    """What has no checksum can be damaged unseen; but most of what comes out was sent, and all of it is possible."""
    headings = [f"{n / 10}, {n / 100:.1f}, -1.5\r\n".encode() for n in range(0, 3600, 9)]
    compass = Hmr3300Decoder()
    data = noise_with_frames(11, headings)
    got = [sample for chunk in chunks(12, data) for sample in compass.feed(chunk, 0.0)]
    sent_headings = {n / 10 for n in range(0, 3600, 9)}
    right = [sample for sample in got if isinstance(sample, CompassSample) and sample.heading_deg in sent_headings]
    assert len(right) > 0.95 * len(got) > 5000
    pairs = [f"X={n / 100:+07.3f}\r\nY=-01.500\r\n".encode() for n in range(-3000, 3000, 7)]
    tilt = InclinometerXyDecoder()
    data = noise_with_frames(13, pairs)
    tilts = [sample for chunk in chunks(14, data) for sample in tilt.feed(chunk, 0.0)]
    sent_tilts = {n / 100 for n in range(-3000, 3000, 7)}
    right_tilts = [s for s in tilts if isinstance(s, TiltSample) and s.x_deg in sent_tilts and s.y_deg == -1.5]
    assert len(right_tilts) > 0.95 * len(tilts) > 5000


def test_sentences_of_compasses_in_noise() -> None:
    """Everything with a right checksum is found, in order, and nothing else."""
    source = random.Random(15)
    frames = [sentence(f"PTNTHPR,{n / 10},N,{source.uniform(-9, 9):.1f},N,-1.5,N") for n in range(0, 3600, 9)]
    data = noise_with_frames(16, frames)
    decoder = NmeaDecoder()
    got = [sample for chunk in chunks(17, data) for sample in decoder.feed(chunk, 0.0)]
    right = [data[found.start + 1 : found.end - 3].split(b",") for found in right_sentences(data, b"PTNTHPR,")]
    assert len(right) > 3000
    assert [(s.heading_deg, s.pitch_deg) for s in got if isinstance(s, CompassSample)] == [
        (float(fields[1]), float(fields[3])) for fields in right
    ]
    assert decoder.accepted == len(right)


def test_tagged_fields_in_noise() -> None:
    frames = [sentence(f"C{n / 10}P{n / 100:.1f}R-1.5T20.0") for n in range(0, 3600, 9)]
    data = noise_with_frames(18, frames)
    decoder = Os5000Decoder()
    got = [sample for chunk in chunks(19, data) for sample in decoder.feed(chunk, 0.0)]
    right = [data[found.start + 1 : found.end - 3] for found in right_sentences(data, b"C")]
    assert len(right) > 3000
    expected = [float(text[1:].split(b"P")[0]) for text in right]
    assert [sample.heading_deg for sample in got if isinstance(sample, CompassSample)] == expected


def test_tiltmeter_lines_in_noise() -> None:
    lines = [f"${n / 100:07.3f},-01.500,020.000,N0001\r\n".encode() for n in range(-3000, 3000, 7)]
    decoder = JewellDecoder()
    data = noise_with_frames(20, lines)
    tilts = [sample for chunk in chunks(21, data) for sample in decoder.feed(chunk, 0.0)]
    sent = {n / 100 for n in range(-3000, 3000, 7)}
    right = [s for s in tilts if isinstance(s, TiltSample) and s.x_deg in sent and s.y_deg == -1.5]
    assert len(right) > 0.95 * len(tilts) > 5000
