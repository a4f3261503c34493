"""Ten million random bytes a decoder, and a million full of real and of damaged frames. Verified by brute force.

The seeds are fixed: the same bytes every run.
"""

from __future__ import annotations

import random
import struct
from collections import deque

import pytest

from companion.protocols.base import Decoder
from companion.protocols.hmr3300 import Hmr3300Decoder
from companion.protocols.imu_line import ImuLineDecoder
from companion.protocols.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.jewell import JewellDecoder
from companion.protocols.nmea import NmeaDecoder
from companion.protocols.os5000 import Os5000Decoder
from companion.protocols.registry import PROTOCOLS, make_decoder
from companion.protocols.vectornav import VectorNavDecoder
from companion.samples import CompassSample, ImuSample, TiltSample
from tests.support.frames import imu_line, right_binaries, right_sentences, sentence, vectornav_imu

SIZE = 1_000_000
RANDOM = 10_000_000
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
def test_ten_million_random_bytes(name: str) -> None:
    decoder = make_decoder(next(kind for kind, each in EVERY if each == name), name)
    noise, longest = random.Random(7), 0
    for _ in range(RANDOM // CHUNK):
        # None of it is a frame: that has been verified for the checksummed ones by the tests below on harder input.
        assert decoder.feed(noise.randbytes(CHUNK), 0.0) == []
        longest = max(longest, held(decoder))
    assert longest <= HELD
    assert decoder.accepted == 0
    assert decoder.rejected.total() + decoder.skipped > 10_000


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
