"""Long recordings and logs of a still aircraft, written as a daemon would have, but in seconds instead of hours.

Plain numpy and a few lines a device: nothing of the simulator, no decoder, no collector that is fed.
"""

from __future__ import annotations

import binascii
import heapq
import itertools
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.config import parse
from companion.config.sections import Config
from companion.estimation.solution.site import Whereabouts
from companion.recording import messages
from companion.recording.files import Beginning, RecordingFile
from companion.recording.messages import Message

Floats = NDArray[np.float64]

START_S: Final = 5000.25
OFFSET_NS: Final = 1_800_000_000 * 10**9
GYRO_BIAS: Final = (0.0008, -0.0005, 0.0003)
"""rad/s, of every IMU."""
ACCEL: Final = (0.85, 0.47, -9.74)
"""m/s^2, what level-headed gravity and the biases of every IMU come to."""
NOISE: Final = (1.5e-3,) * 3 + (0.02,) * 3
TEXT: Final = """
[mavlink]
url = "udpout:127.0.0.1:9"
{imus}
[gradienter]
port = "/nowhere/gradienter"
protocol = "inclinometer_xy"
law = "slope"
sigma_deg = 0.005
[compass]
port = "/nowhere/compass"
protocol = "hmr3300"
sigma_deg = 1.0
[calibration]
min_still_s = 10.0
max_s = 60.0
"""
IMU: Final = """
[[imu]]
name = "{name}"
source = "serial"
port = "/nowhere/{name}"
protocol = "vectornav"
profile = "adis16470"
baud = 921600
"""
_FRAME: Final = struct.Struct("<BHHQ7f")
_LINE_S: Final = 10.0 / 921600.0
"""Of one byte."""


def config(names: Sequence[str]) -> Config:
    """The configuration that the recording carries."""
    return parse(TEXT.format(imus="".join(IMU.format(name=name) for name in names)), "long recording")


def readings(seconds: float, rate_hz: float, seed: int) -> tuple[Floats, Floats]:
    """(n,) seconds since `START_S` on the sensor's own clock, (n, 6) rad/s and m/s^2, white noise at rest."""
    rng = np.random.default_rng(seed)
    count = round(seconds * rate_hz)
    rows = rng.normal((*GYRO_BIAS, *ACCEL), NOISE, (count, 6))
    return np.arange(count) / rate_hz, rows


def vectornav_frames(device_s: Floats, rows: Floats, temperature_degc: float = 25.0) -> list[bytes]:
    """One binary frame a row, groups 05, masks 0121 and 0010 (VectorNav UM001)."""
    frames = []
    for time_ns, row in zip(np.rint(device_s * 1e9).astype(np.int64).tolist(), rows.tolist(), strict=True):
        body = _FRAME.pack(0x05, 0x0121, 0x0010, time_ns, *row, temperature_degc)
        frames.append(b"\xfa" + body + struct.pack(">H", binascii.crc_hqx(body, 0)))
    return frames


def _imu(name: str, seconds: float, rate_hz: float, read_s: float, seed: int) -> Iterator[Message]:
    """Give what each read of a serial IMU brought."""
    rng = np.random.default_rng(seed + 100)
    device_s, rows = readings(seconds, rate_hz, seed)
    device_s = device_s + 12.0
    frames = vectornav_frames(device_s, rows)
    came_s = START_S + (device_s - 12.0) * (1.0 + 20e-6) + len(frames[0]) * _LINE_S
    if read_s:
        # An adapter that hands over every so often.
        came_s = np.ceil(came_s / read_s) * read_s
    came_s = came_s + rng.exponential(1e-4, len(came_s)) * (read_s == 0.0)
    times = np.maximum.accumulate(came_s).tolist()
    for t_s, some in itertools.groupby(zip(times, frames, strict=True), key=lambda each: each[0]):
        yield messages.SERIAL + name, t_s, b"".join(frame for _, frame in some)


def _gradienter(seconds: float) -> Iterator[Message]:
    rng = np.random.default_rng(7)
    for k in range(round(seconds * 10.0)):
        x, y = -3.0 + rng.normal(0.0, 0.002), 5.0 + rng.normal(0.0, 0.002)
        line = f"X={x:+07.3f}\r\nY={y:+07.3f}\r\n".encode()
        yield messages.SERIAL + "gradienter", START_S + 0.05 + 0.1 * k, line


def _compass(seconds: float) -> Iterator[Message]:
    rng = np.random.default_rng(8)
    for k in range(round(seconds * 8.0)):
        line = f"{40.0 + rng.normal(0.0, 0.2):.1f}, 5.0, -3.0\r\n".encode()
        yield messages.SERIAL + "compass", START_S + 0.07 + 0.125 * k, line


def _ticks(seconds: float) -> Iterator[Message]:
    """Give one a second, which ends the seconds before."""
    for k in range(1, int(seconds)):
        yield messages.TICK, START_S + k + 0.4, b""


def write_recording(path: Path, *, seconds: float, rate_hz: float = 1000.0, imus: int = 1, read_s: float = 0.0) -> int:
    """A recording of serial IMUs, a gradienter and a compass; how many IMU samples it has.

    Args:
        path: where.
        seconds: how long.
        rate_hz: of each IMU.
        imus: how many.
        read_s: the reads of the IMUs' ports come so far apart; 0: one a frame.
    """
    names = [f"imu{k}" for k in range(imus)]
    begin_s = START_S - 0.01
    place = messages.encode(Whereabouts(40.0, 116.0, 50.0, "config", None))
    beginning = Beginning(begin_s, OFFSET_NS, msgspec.json.encode(config(names)), [(messages.PLACE, begin_s, place)])
    file = RecordingFile(path)
    streams = [
        *(_imu(name, seconds, rate_hz, read_s, seed) for seed, name in enumerate(names)),
        _gradienter(seconds),
        _compass(seconds),
        _ticks(seconds),
    ]
    for _, second in itertools.groupby(heapq.merge(*streams, key=lambda each: each[1]), key=lambda each: int(each[1])):
        file.write(list(second), beginning)
    file.close()
    return imus * round(seconds * rate_hz)


def write_log(path: Path, count: int, rate_hz: float = 100.0) -> None:
    """A log of so many lines, in SI units, of the same IMU."""
    device_s, rows = readings(count / rate_hz, rate_hz, 3)
    with path.open("w", encoding="utf-8") as file:
        file.write("t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2\n")
        for t_s, row in zip(device_s.tolist(), rows.tolist(), strict=True):
            file.write(f"{t_s:.4f},{','.join([f'{value:.9g}' for value in row])}\n")
