"""Invariants of every decoder, for any bytes."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder
from companion.protocols.compasses.nmea import NmeaDecoder
from companion.protocols.compasses.os5000 import Os5000Decoder
from companion.protocols.compasses.pni import LONGEST as PNI_LONGEST
from companion.protocols.compasses.pni import PniDecoder
from companion.protocols.decoding.base import Decoder, LineDecoder, SentenceDecoder
from companion.protocols.imus import xsens as xsens_protocol
from companion.protocols.imus.imu_line import ImuLineDecoder
from companion.protocols.imus.mip import MipDecoder
from companion.protocols.imus.stim300 import Stim300Decoder
from companion.protocols.imus.vectornav import VectorNavDecoder
from companion.protocols.imus.witmotion import FRAME_BYTES as WIT_BYTES
from companion.protocols.imus.witmotion import WitMotionDecoder
from companion.protocols.imus.xsens import XsensDecoder
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder
from companion.protocols.inclinometers.jewell import JewellDecoder
from companion.protocols.inclinometers.rion import LONGEST as RION_LONGEST
from companion.protocols.inclinometers.rion import RionDecoder
from companion.samples import CompassSample, Sample, TiltSample
from tests.support.decoders import MIP_BYTES, STIM300_BYTES, VECTORNAV_BYTES, XSENS_BYTES
from tests.support.frames import (
    STIM_CONTENTS,
    Found,
    big_floats,
    floats,
    imu_line,
    mip,
    mip_imu,
    mtdata2,
    pni,
    pni_data,
    pni_heading,
    right_rion_sums,
    right_xbus,
    rion,
    rion_angles,
    rion_long,
    sentence,
    stim300,
    stim_configuration,
    vectornav_binary,
    vectornav_imu,
    wit,
    wit_imu,
    xbus,
    xsens_imu,
)

SECONDS_PER_BYTE = 1 / 1024  # exact in binary, so that times can be compared exactly
DECODERS: list[type[Decoder]] = [
    Hmr3300Decoder,
    InclinometerXyDecoder,
    ImuLineDecoder,
    VectorNavDecoder,
    NmeaDecoder,
    Os5000Decoder,
    JewellDecoder,
]
DECODERS += [PniDecoder, RionDecoder, WitMotionDecoder]
DECODERS += [MipDecoder, XsensDecoder, Stim300Decoder]

finite = st.floats(-50, 50, allow_nan=False, width=32)
triples = st.tuples(finite, finite, finite)
tenths = st.integers(-900, 900).map(lambda n: n / 10)
thousandths = st.integers(-90_000, 90_000).map(lambda n: n / 1000)

hmr_lines = st.one_of(
    st.builds(lambda h, p, r: f"{h / 10}, {p}, {r}\r\n".encode(), st.integers(0, 3599), tenths, tenths),
    st.integers(0, 3599).map(lambda h: f"{h / 10}\r\n".encode()),
    st.sampled_from([b"#I\r\n", b"12, 34, 56\r\n", b"360.0, 1.0, 1.0\r\n", b"\r\n", b"1.0\n"]),
)
xy_lines = st.one_of(
    st.builds(lambda axis, value: f"{axis}={value:+07.3f}\r\n".encode(), st.sampled_from("XY"), thousandths),
    st.builds(lambda x, y: f"X={x:+07.3f}\r\nY={y:+07.3f}\r\n".encode(), thousandths, thousandths),
    st.sampled_from([b"X=+++++++\r\n", b"Y=-------\r\n", b"s", b"X=+01.20\r\n", b"+01.200\r\n", b"SN:1\r\n"]),
)
imu_lines = st.one_of(
    st.builds(imu_line, st.integers(0, 65535), st.integers(0, 2**32 - 1), triples, triples),
    st.sampled_from([b"$IMU,1,2*00\r\n", sentence("IMU,1,2,nan,0,0,0,0,0,0"), sentence("GPGGA,1"), b"$"]),
)
vectornav_frames = st.one_of(
    st.builds(vectornav_imu, st.integers(0, 2**64 - 1), triples, triples, finite),
    triples.map(lambda ypr: vectornav_binary({1: {3: floats(*ypr)}})),
    st.builds(lambda v: sentence("VNYMR," + ",".join(map(str, v))), st.tuples(*[finite] * 12)),
    st.sampled_from(
        [b"\xfa\x05\xff\x7f\xff\x0f", b"\xfa\x04", b"$VNYMR,", b"$VN", sentence("VNERR,1"), b"\xfa\x01\x00"]
    ),
)
pni_floats = st.sampled_from([5, 7, 21, 22, 23, 24, 25, 27, 28, 29, 74, 75, 76, 88])
pni_parts = st.one_of(
    st.tuples(pni_floats, finite),
    st.tuples(st.sampled_from([8, 9, 79]), st.integers(0, 3).map(lambda n: bytes([n]))),
    st.tuples(st.just(77), st.binary(min_size=16, max_size=16)),
)
pni_frames = st.one_of(
    st.builds(pni_heading, st.floats(0, 359.5, width=32), finite, finite),
    st.builds(pni_data, st.lists(pni_parts, max_size=16), st.sampled_from("><")),
    st.builds(pni, st.integers(0, 255), st.binary(max_size=20)),
    st.sampled_from([b"\x00\xc8\x05\x10", b"\x00\x05\x05", b"\x00\x07\x05\x01\xc8", b"\x00"]),
)
hundredths = st.integers(-9999, 9999).map(lambda n: n / 100)
rion_frames = st.one_of(
    st.builds(rion_angles, hundredths, hundredths, st.integers(0, 39999).map(lambda n: n / 100)),
    st.builds(rion_long, hundredths, hundredths, st.binary(min_size=3, max_size=3)),
    st.builds(rion, st.integers(0, 255), st.binary(max_size=46)),
    st.sampled_from([b"\x68\x0d\x00\x84", b"\x68\x32\x00\x94", b"\x68"]),
)
counts = st.integers(-32768, 32767)
wit_frames = st.one_of(
    st.builds(wit_imu, st.tuples(counts, counts, counts), st.tuples(counts, counts, counts)),
    st.builds(wit, st.integers(0x50, 0x61), counts, counts, counts, counts),
    st.sampled_from([wit(0x53, 1, 2, 3) * 3, wit(0x51), b"\x55\x51", b"\x55" * 12]),
)
mip_packets = st.one_of(
    st.builds(mip_imu, finite, triples, triples),
    triples.map(lambda gauss: mip([(0x06, big_floats(*gauss))])),
    st.sampled_from([mip([(0xF1, b"\x01\0")], descriptor_set=1), b"ue", b"ue\x80\xff", mip_imu(float("nan")), b"u"]),
)
xsens_messages = st.one_of(
    st.builds(xsens_imu, st.integers(0, 65535), st.integers(0, 2**32 - 1), triples, triples),
    triples.map(lambda field: mtdata2([(0xC020, big_floats(*field))], extended=True)),
    finite.map(lambda degrees: mtdata2([(0x0810, big_floats(degrees))])),
    st.sampled_from([xbus(0x3E), b"\xfa\xff", b"\xfa\xff\x36\xff\x04\x00", b"\xfa\xff\x36\xff\x04\x01", b"\xfa"]),
)
int24s = st.tuples(*[st.integers(-(2**23), 2**23 - 1)] * 3)
stim_datagrams = st.one_of(
    st.builds(
        stim300,
        st.sampled_from(list(STIM_CONTENTS)),
        gyro=int24s,
        accel=st.one_of(int24s, st.just((0, 0, 1 << 20))),
        inclination=int24s,
        status=st.sampled_from([{}, {"r": 0x40}, {"i": 0x11}, {"a": 0x80}]),
        counter=st.integers(0, 255),
        latency_us=st.integers(0, 65535),
    ),
    st.sampled_from([stim_configuration(code) for code in range(8)] + [b"\r\n", b"\x93", b"\xd1\0\0"]),
)
tilt = st.integers(-900, 900).map(lambda n: f"{n / 10:.1f}")
circle = st.integers(0, 3599).map(lambda n: f"{n / 10:.1f}")
nmea_lines = st.one_of(
    st.builds(lambda h, d, side: sentence(f"HCHDG,{h},{d},{side},,"), circle, circle, st.sampled_from("EW")),
    st.builds(
        lambda kind, h: sentence(f"II{kind[:3]},{h},{kind[3]}"), st.sampled_from(["HDMM", "HDTT", "THSA"]), circle
    ),
    st.builds(lambda h, p, r: sentence(f"PTNTHPR,{h},N,{p},N,{r},N"), circle, tilt, tilt),
    st.builds(lambda p, r, h: sentence(f"PTNTCCD,{p},{r},1,2,3,4,{h}"), st.integers(), st.integers(), circle),
    st.builds(lambda p, r: sentence(f"HCXDR,A,{p},D,PITCH,A,{r},D,ROLL,G,1,,MAGX,G,2,,MAGY,G,3,,MAGZ"), tilt, tilt),
    st.sampled_from([b"$HCHDM,1.0,M*00\r\n", sentence("PTNTHPR,,P,1.0,N,1.0,N"), sentence("GPHDT,nan,T"), b"$", b"\r"]),
)
tagged_lines = st.one_of(
    st.builds(lambda h, p, r: sentence(f"C{h}P{p}R{r}T20.0"), circle, tilt, tilt),
    st.builds(lambda p, r, x: sentence(f"P{p}R{r}Mx{x}My1.0Mz-1.0"), tilt, tilt, tilt),
    st.sampled_from([sentence("C360.0"), sentence("C1.0P0.0R180.0"), sentence("C1.0P0.0R181.0"), b"$C1.0P", b"$"]),
)
jewell_lines = st.one_of(
    st.builds(lambda x, y: f"${x:07.3f},{y:07.3f},018.910,N0000\r\n".encode(), thousandths, thousandths),
    st.builds(
        lambda x, y, unit: sentence(f"YXXDR,A,{y:07.3f},{unit},N,A,{x:07.3f},{unit},E,C,021.651,C,T-N0000"),
        thousandths,
        thousandths,
        st.sampled_from("DM"),
    ),
    st.builds(lambda p, r: sentence(f"P{p:07.3f}R{r:07.3f}"), thousandths, thousandths),
    st.sampled_from([b"ERR XY-SO PARSE ERROR\r\n", b"$-0.619,0.023,18.910,N0000\r\n", b"$", b"\r\n"]),
)
FRAMES: dict[type[Decoder], st.SearchStrategy[bytes]] = {
    NmeaDecoder: nmea_lines,
    Os5000Decoder: tagged_lines,
    JewellDecoder: jewell_lines,
    Hmr3300Decoder: hmr_lines,
    InclinometerXyDecoder: xy_lines,
    ImuLineDecoder: imu_lines,
    VectorNavDecoder: vectornav_frames,
    PniDecoder: pni_frames,
    RionDecoder: rion_frames,
    WitMotionDecoder: wit_frames,
    MipDecoder: mip_packets,
    XsensDecoder: xsens_messages,
    Stim300Decoder: stim_datagrams,
}


@st.composite
def damaged(draw: st.DrawFn, frames: st.SearchStrategy[bytes]) -> bytes:
    """A frame with a few bytes lost, changed or doubled."""
    frame = bytearray(draw(frames))
    for _ in range(draw(st.integers(0, 3))):
        if frame:
            at = draw(st.integers(0, len(frame) - 1))
            frame[at : at + 1] = draw(
                st.sampled_from([b"", b"\n", b"$", b"\xfa", b"\x80", b"\0", b"hU", bytes(frame[at : at + 1] * 2)])
            )
    return bytes(frame)


def streams(decoder: type[Decoder]) -> st.SearchStrategy[bytes]:
    piece = st.one_of(
        FRAMES[decoder],
        damaged(FRAMES[decoder]),
        st.binary(max_size=20),
        st.binary(min_size=1, max_size=1).map(lambda byte: byte * 400),
    )
    return st.lists(piece, max_size=12).map(b"".join)


def feed_in(decoder: Decoder, stream: bytes, cuts: list[int]) -> list[Sample]:
    """Feed a stream cut at some places, each chunk read when its last byte has just arrived."""
    samples: list[Sample] = []
    edges = [0, *sorted({cut for cut in cuts if 0 < cut < len(stream)}), len(stream)]
    for start, end in itertools.pairwise(edges):
        samples += decoder.feed(stream[start:end], end * SECONDS_PER_BYTE)
    return samples


LIMITS: dict[type[Decoder], int] = {
    VectorNavDecoder: max(VECTORNAV_BYTES, VectorNavDecoder.LIMIT + 1),
    MipDecoder: MIP_BYTES,
    XsensDecoder: XSENS_BYTES,
    Stim300Decoder: STIM300_BYTES,
    PniDecoder: PNI_LONGEST,
    RionDecoder: RION_LONGEST,
    WitMotionDecoder: 2 * WIT_BYTES,
}
"""The longest frame of each decoder of frames."""


def limit_of(decoder: Decoder) -> int:
    if type(decoder) in LIMITS:
        return LIMITS[type(decoder)]
    assert isinstance(decoder, LineDecoder | SentenceDecoder)
    return decoder.LIMIT


@pytest.mark.parametrize("kind", DECODERS)
@given(data=st.data())
def test_how_a_stream_is_cut_changes_nothing(kind: type[Decoder], data: st.DataObject) -> None:
    stream = data.draw(streams(kind))
    cuts = data.draw(st.lists(st.integers(0, max(len(stream), 1)), max_size=20))
    whole, by_byte, cut = (kind(SECONDS_PER_BYTE) for _ in range(3))
    expected = feed_in(whole, stream, [])
    assert feed_in(by_byte, stream, list(range(len(stream)))) == expected
    assert feed_in(cut, stream, cuts) == expected
    for other in (by_byte, cut):
        assert (other.accepted, other.rejected) == (whole.accepted, whole.rejected)
        assert len(other._buffer) == len(whole._buffer)


@pytest.mark.parametrize("kind", DECODERS)
@given(data=st.data())
def test_nothing_raises_and_what_waits_is_bounded(kind: type[Decoder], data: st.DataObject) -> None:
    decoder = kind()
    for chunk in data.draw(st.lists(st.one_of(streams(kind), st.binary(max_size=600)), max_size=8)):
        samples = decoder.feed(chunk, 0.0)
        assert len(decoder._buffer) <= limit_of(decoder)
        assert all(is_sane(sample) for sample in samples)
        if data.draw(st.booleans()):
            decoder.interrupted()
            assert len(decoder._buffer) == 0
    assert all(count > 0 for count in decoder.rejected.values())
    assert all(reason for reason in decoder.rejected)


def is_sane(sample: Sample) -> bool:
    """Finite everywhere, angles within their circles."""
    values = [x for x in msgspec.structs.astuple(sample) if x is not None and not isinstance(x, str)]
    flat = [x for value in values for x in (value if isinstance(value, tuple) else (value,))]
    if not all(x == x and abs(x) != float("inf") for x in flat):
        return False
    if isinstance(sample, CompassSample):
        # An accelerometer compass may lie on its back.
        return 0 <= sample.heading_deg < 360 and abs(sample.pitch_deg or 0) <= 90 and abs(sample.roll_deg or 0) <= 180
    return not isinstance(sample, TiltSample) or max(abs(sample.x_deg), abs(sample.y_deg)) <= 90


GOOD: dict[type[Decoder], bytes] = {
    Hmr3300Decoder: b"\r\n123.4, 18.6, -0.5\r\n",  # without a start mark, only a line end shows where a line begins
    InclinometerXyDecoder: b"X=+00.430\r\nY=-00.084\r\n",
    ImuLineDecoder: imu_line(1, 2),
    VectorNavDecoder: vectornav_imu(),
    PniDecoder: pni_heading(123.5),
    RionDecoder: rion_angles(10.5, -10.05, 104.01),
    WitMotionDecoder: wit_imu() + wit(0x50),  # believed when another follows
    MipDecoder: mip_imu(),
    # With a temperature: one that came before is held.
    XsensDecoder: mtdata2([(0x0810, big_floats(25)), (0x4020, big_floats(0, 1, 9)), (0x8020, big_floats(1, 2, 3))]),
    Stim300Decoder: stim300(0x92),
    NmeaDecoder: sentence("PTNTHPR,91.7,N,-0.5,N,1.6,N"),
    Os5000Decoder: sentence("C320.5P0.2R-18.3T19.0"),
    JewellDecoder: b"$-00.619,000.023,018.910,N0000\r\n",
}


WEAK_SUMS: dict[type[Decoder], Callable[[bytes], list[Found]]] = {
    XsensDecoder: lambda data: right_xbus(data, xsens_protocol.MAX_DATA_BYTES),
    RionDecoder: right_rion_sums,
}


@pytest.mark.parametrize("kind", DECODERS)
@given(data=st.data())
def test_a_good_frame_after_anything_is_found(kind: type[Decoder], data: st.DataObject) -> None:
    before = data.draw(st.one_of(st.binary(max_size=400), damaged(FRAMES[kind]), FRAMES[kind].map(lambda f: f[:-3])))
    # A sum of eight bits is easily right by chance, over what came before and a part of the good frame: then that is
    # the frame, and the rest of the good one none.
    by_chance = WEAK_SUMS[kind](before + GOOD[kind]) if kind in WEAK_SUMS else []
    assume(not any(found.start < len(before) < found.end for found in by_chance))
    alone = kind().feed(GOOD[kind], 0.0)
    assert len(alone) == 1
    decoder = kind()
    # A false start may claim up to the longest frame; only what comes after that shows it to be one.
    samples = decoder.feed(before + GOOD[kind], 0.0) + decoder.feed(bytes(LIMITS.get(kind, VECTORNAV_BYTES)), 0.0)
    assert samples[-1:] == alone


@given(st.lists(st.tuples(st.sampled_from("XYxG"), thousandths), max_size=30))
def test_only_an_x_and_the_y_right_after_it_make_a_reading(lines: list[tuple[str, float]]) -> None:
    """Against a plain reading of the rule with a regular expression over the axes."""
    stream = "".join(f"{axis}={value:+07.3f}\r\n" for axis, value in lines).encode()
    decoder = InclinometerXyDecoder()
    samples = decoder.feed(stream, 0.0)
    axes = "".join(axis for axis, _ in lines)
    expected = [TiltSample(0.0, lines[m.start()][1], lines[m.start() + 1][1]) for m in re.finditer("XY", axes)]
    assert samples == expected
    unpaired = Counter(axes.replace("XY", ""))
    waiting = int(axes.endswith("X"))
    assert decoder.rejected.total() == unpaired.total() - waiting
