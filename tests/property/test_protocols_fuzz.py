"""A million bytes a decoder: noise, and noise full of real and of damaged frames. Verified by brute force.

The seeds are fixed: the same bytes every run.
"""

from __future__ import annotations

import random
import struct

import pytest

from companion.protocols.hmr3300 import Hmr3300Decoder
from companion.protocols.imu_line import ImuLineDecoder
from companion.protocols.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.registry import PROTOCOLS, make_decoder
from companion.protocols.vectornav import VectorNavDecoder
from companion.samples import CompassSample, ImuSample, TiltSample
from tests.support.frames import imu_line, right_binaries, right_sentences, sentence, vectornav_imu

SIZE = 1_000_000
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


@pytest.mark.parametrize(("kind", "name"), EVERY)
def test_a_million_random_bytes(kind: str, name: str) -> None:
    decoder = make_decoder(kind, name)  # type: ignore[arg-type]
    samples = [sample for chunk in chunks(1, random.Random(7).randbytes(SIZE)) for sample in decoder.feed(chunk, 0.0)]
    # None of it is a frame: that has been verified for the checksummed ones by the tests below on harder input.
    assert samples == []
    assert decoder.accepted == 0
    assert decoder.rejected.total() + decoder.skipped > 1000


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
