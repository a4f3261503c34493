"""Each decoder behind four transports: plain, one byte at a time, loss and corruption, delays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import pytest

from companion.protocols.decoding.base import Decoder
from companion.protocols.registry import PROTOCOLS, Kind
from companion.samples import CompassSample, ImuSample, Sample, TiltSample
from tests.support.decoders import make_decoder
from tests.support.frames import (
    imu_line,
    mip_imu,
    pni_heading,
    rion_angles,
    sentence,
    stim300,
    vectornav_imu,
    wit,
    wit_imu,
    xsens_imu,
)
from tests.support.transports import SECONDS_PER_BYTE, START_S, TRANSPORTS, Transport

COUNT = 400


@dataclass(frozen=True)
class Device:
    """A device's n-th frame, and the value that identifies its sample."""

    kind: Kind
    name: str
    frame: Callable[[int], bytes]
    value: Callable[[int], float]
    bytes_after_end: int = 0
    crc: bool = False
    held: int = 0
    """Number of last frames that wait for the next one."""


def ymr(n: int) -> bytes:
    return sentence(f"VNYMR,{n / 4:+08.3f},-007.330,+000.715,-0.5,-0.25,+0.5,{n / 100:.3f},-00.100,-09.701,0,0,0")


def pair(n: int) -> bytes:
    return f"X={n / 100:+07.3f}\r\nY=-00.084\r\n".encode()


def stim_imu(n: int) -> bytes:
    return stim300(0x91, accel=(n << 8, 0, 1 << 19), counter=n * 16 % 256)


def stim_tilt(n: int) -> bytes:
    return stim300(0x92, inclination=(0, n << 10, 1 << 22))


def stim_right_down_deg(n: int) -> float:
    return math.asin((n << 10) / math.hypot(0, n << 10, 1 << 22)) / (math.pi / 180)


def hpr(n: int) -> bytes:
    return sentence(f"PTNTHPR,{n / 10:.1f},N,-1.5,N,{n % 60 / 10:.1f},N")


def tagged(n: int) -> bytes:
    return sentence(f"C{n / 10:.1f}P-1.5R{n % 60 / 10:.1f}T19.0Mx-80.45My160.86Mz450.00")


def sim(n: int) -> bytes:
    return f"${n / 100:07.3f},-00.084,018.910,N1234\r\n".encode()


def xdr(n: int) -> bytes:
    return sentence(f"YXXDR,A,-00.084,D,N,A,{n / 100:07.3f},D,E,C,018.910,C,T-N1234")


DEVICES = [
    Device("imu", "imu_line", lambda n: imu_line(n, n * 2500, accel=(n / 100, 0, -9.8)), lambda n: n / 100, 1),
    Device("imu", "vectornav", lambda n: vectornav_imu(accel=(n / 4, 0, -9.75)), lambda n: n / 4, crc=True),
    Device("imu", "vectornav", ymr, lambda n: n / 100, 1),
    Device("imu", "mip", lambda n: mip_imu(accel_g=(n / 4, 0, -1)), lambda n: n / 4 * 9.80665),
    Device("imu", "xsens", lambda n: xsens_imu(n, accel=(n / 4, 0, 9.75)), lambda n: n / 4),
    Device("imu", "stim300", stim_imu, lambda n: n / 2048 * 9.80665, crc=True),
    Device("gradienter", "stim300", stim_tilt, stim_right_down_deg, crc=True),
    Device("compass", "hmr3300", lambda n: f"{n / 10:.1f}, 1.5, -2.5\r\n".encode(), lambda n: n / 10),
    Device("gradienter", "inclinometer_xy", pair, lambda n: n / 100),
    Device("compass", "pni", lambda n: pni_heading(n / 4), lambda n: n / 4, crc=True),
    Device("compass", "rion", lambda n: rion_angles(10.5, -10.05, n / 4), lambda n: n / 4),
    Device("imu", "witmotion", lambda n: wit_imu((n, 0, 2048)), lambda n: n * (16 * 9.80665 / 32768), held=1),
    Device("gradienter", "witmotion", lambda n: wit(0x53, n, 3, 4), lambda n: n * 180 / 32768, held=1),
    Device("compass", "nmea", lambda n: sentence(f"HCHDG,{n / 10:.1f},,,,"), lambda n: n / 10, 1),
    Device("compass", "nmea", hpr, lambda n: n / 10, 1),
    Device("compass", "os5000", tagged, lambda n: n / 10, 1),
    Device("gradienter", "jewell", sim, lambda n: n / 100),
    Device("gradienter", "jewell", xdr, lambda n: n / 100),
]

CHECKED = ("imu_line", "vectornav", "mip", "xsens", "rion", "witmotion", "nmea", "os5000")
"""Families with a sum or exclusive or, which one changed bit never passes."""


def value_of(sample: Sample) -> float | None:
    match sample:
        case ImuSample():
            return sample.accel_m_s2[0]
        case TiltSample():
            return sample.x_deg
        case CompassSample():
            return sample.heading_deg
    return None


def carry(device: Device, transport: Transport) -> tuple[Decoder, list[tuple[float, float]]]:
    decoder = make_decoder(device.kind, device.name, SECONDS_PER_BYTE)
    samples: list[Sample] = []
    for data, t_s in transport.carry(device.frame(n) for n in range(COUNT)):
        samples += decoder.feed(data, t_s)
    return decoder, [(value, sample.t_s) for sample in samples if (value := value_of(sample)) is not None]


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("device", DEVICES, ids=lambda device: f"{device.kind}-{device.name}-{len(device.frame(0))}")
def test_a_decoder_behind_a_transport(device: Device, transport: Callable[[], Transport]) -> None:
    line = transport()
    decoder, got = carry(device, line)
    sent = [device.value(n) for n in range(COUNT)]
    if line.harmless:
        ends = 0
        expected = []
        for n in range(COUNT - device.held):
            ends += len(device.frame(n))
            expected.append((sent[n], START_S + (ends - device.bytes_after_end) * SECONDS_PER_BYTE))
        assert [value for value, _ in got] == [value for value, _ in expected]
        assert [t_s for _, t_s in got] == pytest.approx([t_s for _, t_s in expected], abs=1e-9)
        assert not decoder.rejected
        assert decoder.accepted == COUNT - device.held
        return
    # About one byte in fifty is hurt, so a frame of 19 bytes passes with 0.98^19 = 0.68, one of 122 with 0.085.
    untouched = 0.98 ** len(device.frame(0)) * COUNT
    right = [value for value, _ in got if value in sent]
    assert len(right) >= 0.7 * untouched
    assert decoder.rejected.total() > 0
    assert [t_s for _, t_s in got] == sorted(t_s for _, t_s in got)
    # Without a CRC some damage passes (two equal characters lost leave an exclusive or as it was), but it is rare.
    assert len(got) - len(right) <= (0 if device.crc else 0.02 * len(sent))


@pytest.mark.parametrize(
    "device", [one for one in DEVICES if one.crc or one.name in CHECKED], ids=lambda one: f"{one.kind}-{one.name}"
)
def test_no_changed_bit_passes(device: Device) -> None:
    """It gives no sample, or the very same one (a hexadecimal digit in the other case)."""
    frames = [device.frame(n) for n in range(4)]

    def read(stream: bytes) -> list[Sample]:
        samples = make_decoder(device.kind, device.name).feed(stream, 0.0)
        return [msgspec.structs.replace(sample, t_s=0.0) for sample in samples]

    right = read(b"".join(frames))
    for bit in range(8 * len(frames[1])):
        hurt = bytearray(frames[1])
        hurt[bit // 8] ^= 1 << bit % 8
        assert all(sample in right for sample in read(b"".join([frames[0], hurt, *frames[2:]]))), bit


def test_every_protocol_is_here() -> None:
    assert {device.name for device in DEVICES} == {name for names in PROTOCOLS.values() for name in names}
