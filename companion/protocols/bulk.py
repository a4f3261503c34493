"""Many readings of an IMU at once, for whoever has many: a replay, a log.

A stream is nearly always regular: whole frames of one kind, checksums right, a clock that goes on. Numpy then reads a
thousand frames with the calls that Python spends on two. What is not regular is left to the decoders, which know every
case; so nothing here may give another result than they do, to the last bit.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.protocols.checks import ACCEL_LIMIT_M_S2, GYRO_LIMIT_RAD_S, TEMPERATURE_LIMIT_DEGC
from companion.samples import ImuSample

Floats = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, slots=True)
class Frames:
    """The readings in so many equal frames that followed each other without a byte between."""

    frame_bytes: int
    header: bytes
    rows: Floats
    """(n, 6) rad/s and m/s^2."""
    temperature_degc: Floats | None
    """(n,)"""
    device_s: Floats | None
    """(n,) by the device's own clock, as sent."""


@dataclasses.dataclass(frozen=True, slots=True)
class ImuBlock:
    """Samples of one IMU in their order, as so many `ImuSample` would have it; (n,) arrays, times never decrease."""

    t_s: Floats
    rows: Floats
    """(n, 6) rad/s and m/s^2 in the sensor's axes."""
    temperature_degc: Floats | None
    """All finite."""
    stamps: Floats | None
    """The device's clock, unwrapped."""
    breaks: int
    reads: NDArray[np.intp]
    """Which of the reads has completed each."""

    def __len__(self) -> int:
        return len(self.t_s)

    def samples(self, start: int = 0, stop: int | None = None) -> Iterator[ImuSample]:
        """From `start` up to, without, `stop`, one by one."""
        part = slice(start, stop)
        nothing = itertools.repeat(None)
        for t_s, (gx, gy, gz, ax, ay, az), temperature_degc, stamp in zip(
            self.t_s[part].tolist(),
            self.rows[part].tolist(),
            nothing if self.temperature_degc is None else self.temperature_degc[part].tolist(),
            nothing if self.stamps is None else self.stamps[part].tolist(),
            strict=False,
        ):
            yield ImuSample(t_s, (gx, gy, gz), (ax, ay, az), temperature_degc, None, stamp, self.breaks)


@dataclasses.dataclass(frozen=True, slots=True)
class Lines:
    """The readings in a row of whole lines; (n,) arrays."""

    rows: Floats
    """(n, c)"""
    ends: NDArray[np.int64]
    """Where in the text each one's last line ends, behind its line feed."""
    frame_bytes: NDArray[np.int64]
    """Of all its lines."""
    state: dict[str, Any]
    """Attributes that the decoder has behind them."""


@dataclasses.dataclass(frozen=True, slots=True)
class PoseBlock:
    """Readings of a gradienter or a compass in their order; (n,) arrays, times never decrease."""

    t_s: Floats
    rows: Floats
    """(n, 2) degrees of a gradienter's axes, or (n, 1) of a compass' heading, without its tilt."""
    reads: NDArray[np.intp]
    """Which of the reads has completed each."""
    temperature_degc: None = None
    stamps: None = None

    def __len__(self) -> int:
        return len(self.t_s)


Block = ImuBlock | PoseBlock


def all_believable(rows: Floats, temperature_degc: Floats | None) -> bool:
    """Whether `checks.check_imu` finds nothing wrong with any of them."""
    # Not a number compares false.
    return bool(
        (np.abs(rows[:, :3]) <= GYRO_LIMIT_RAD_S).all()
        and (np.abs(rows[:, 3:]) <= ACCEL_LIMIT_M_S2).all()
        and (temperature_degc is None or (np.abs(temperature_degc) <= TEMPERATURE_LIMIT_DEGC).all())
    )


def field(frames: NDArray[np.uint8], offset: int, kind: str, count: int = 1) -> NDArray[Any]:
    """(n, count) of a field that has the same place in every frame; `kind` with its byte order."""
    size = np.dtype(kind).itemsize * count
    return np.ascontiguousarray(frames[:, offset : offset + size]).view(kind)


def fixed_point(texts: NDArray[np.uint8], decimals: int) -> Floats | None:
    """(n,) numbers of equal length with a sign and so many decimals, as `float` reads them; None: one is none.

    At most 15 digits: they and the power of ten are whole numbers then, and their quotient is rounded once.
    """
    signs, point = texts[:, 0], texts.shape[1] - decimals - 1
    digits = np.delete(texts[:, 1:], point - 1, axis=1) - np.uint8(ord("0"))
    negative = signs == ord("-")
    if not ((negative | (signs == ord("+"))).all() and (texts[:, point] == ord(".")).all() and (digits <= 9).all()):
        return None
    whole = digits @ 10.0 ** np.arange(digits.shape[1] - 1, -1, -1)
    return np.asarray(np.where(negative, -1.0, 1.0) * (whole / 10.0**decimals))


def crc16_xmodem(frames: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """(n,) CRC-16/XMODEM of every row; zero where a row ends with its own."""
    count, size = frames.shape
    # Zeros in front change nothing of it, and make the words come out even.
    words = np.zeros((count, (size + 1) // 2), dtype=">u2")
    words.view(np.uint8).reshape(count, -1)[:, size % 2 :] = frames
    table = _crc_of_words()
    found = np.zeros(count, dtype=np.uint16)
    for column in np.ascontiguousarray(words.T.astype(np.uint16)):
        found = table[found ^ column]
    return found


@cache
def _crc_of_words() -> NDArray[np.uint16]:
    """CRC-16/XMODEM of every two bytes."""
    crc: NDArray[Any] = np.arange(65536, dtype=np.uint32)
    for _ in range(16):
        crc = np.where(crc & 0x8000, crc << 1 ^ 0x1021, crc << 1) & 0xFFFF
    return crc.astype(np.uint16)
