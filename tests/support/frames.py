"""Encoders and brute-force readers of the devices' wire formats, written apart from the decoders under test.

Slow and plain on purpose: checksums bit by bit, frames tried at every offset.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

# Bytes of each field, by group and bit (VectorNav UM001, binary output tables).
COMMON_SIZES = (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8)
IMU_SIZES = (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2)
_TABLES: dict[bytes, list[tuple[int, ...]]] = {
    b"\x01": [COMMON_SIZES],
    b"\x04": [IMU_SIZES],
    b"\x05": [COMMON_SIZES, IMU_SIZES],
}


def crc16_xmodem(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def xor(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
    return value


def sentence(body: str) -> bytes:
    return f"${body}*{xor(body.encode()):02X}\r\n".encode()


def imu_line(
    sequence: int,
    t_us: int,
    gyro: tuple[float, ...] = (0.001, -0.002, 0.003),
    accel: tuple[float, ...] = (0.1, -0.2, -9.8),
    temperature: str = "25.12",
) -> bytes:
    values = [f"{value:.6f}" for value in gyro] + [f"{value:.4f}" for value in accel]
    return sentence(",".join(["IMU", str(sequence), str(t_us), *values, temperature]))


def vectornav_binary(groups: dict[int, dict[int, bytes]], *, crc: int | None = None) -> bytes:
    """Group number (1 common, 3 IMU) to bit to the field's bytes."""
    head = bytes([sum(1 << (group - 1) for group in groups)])
    masks = b"".join(struct.pack("<H", sum(1 << bit for bit in fields)) for _, fields in sorted(groups.items()))
    payload = b"".join(fields[bit] for _, fields in sorted(groups.items()) for bit in sorted(fields))
    body = head + masks + payload
    return b"\xfa" + body + struct.pack(">H", crc16_xmodem(body) if crc is None else crc)


def floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def vectornav_imu(
    time_ns: int = 5_000_000_000,
    gyro: tuple[float, ...] = (0.25, -0.5, 0.75),
    accel: tuple[float, ...] = (0.5, -0.25, -9.75),
    temperature: float = 25.5,
) -> bytes:
    """The set-up for a calibration: groups 05, masks 0121 and 0010."""
    common = {0: struct.pack("<Q", time_ns), 5: floats(*gyro), 8: floats(*accel)}
    return vectornav_binary({1: common, 3: {4: floats(temperature)}})


@dataclass(frozen=True)
class Found:
    """A frame with a right checksum, wherever it lies."""

    start: int
    end: int


def right_sentences(data: bytes, prefix: bytes) -> list[Found]:
    """Every `$...*hh` whose checksum is right and that ends a line."""
    found = []
    for match in re.finditer(rb"\$(" + prefix + rb"[^$\r\n]*)\*([0-9A-Fa-f]{2}|[0-9A-Fa-f]{4})(?=[\r\n])", data):
        computed = xor(match[1]) if len(match[2]) == 2 else crc16_xmodem(match[1])
        if computed == int(match[2], 16):
            found.append(Found(match.start(), match.end()))
    return found


def right_binaries(data: bytes) -> list[Found]:
    """Every VectorNav binary frame of groups 1 and 3 whose CRC is right, at whatever offset."""
    found = []
    for start in (index for index, byte in enumerate(data) if byte == 0xFA):
        groups = data[start + 1 : start + 2]
        tables = _TABLES.get(groups)
        if tables is None:
            continue
        payload = start + 2 + 2 * len(tables)
        length = 0
        for index, sizes in enumerate(tables):
            raw = data[start + 2 + 2 * index : start + 4 + 2 * index]
            if len(raw) < 2 or int.from_bytes(raw, "little") >= 1 << len(sizes):
                break
            length += sum(size for bit, size in enumerate(sizes) if int.from_bytes(raw, "little") >> bit & 1)
        else:
            end = payload + length + 2
            if end <= len(data) and crc16_xmodem(data[start + 1 : end]) == 0:
                found.append(Found(start, end))
    return found
