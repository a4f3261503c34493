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


def pni(frame_id: int, payload: bytes = b"") -> bytes:
    """A frame of a PNI compass (TCM manual, figure 7-1)."""
    body = struct.pack(">H", 5 + len(payload)) + bytes([frame_id]) + payload
    return body + struct.pack(">H", crc16_xmodem(body))


def pni_data(parts: list[tuple[int, float | bytes]], order: str = ">") -> bytes:
    """kGetDataResp: component and value, a float or its bytes."""
    payload = bytes([len(parts)])
    for part, value in parts:
        payload += bytes([part]) + (value if isinstance(value, bytes) else struct.pack(order + "f", value))
    return pni(5, payload)


def pni_heading(heading: float, pitch: float = 1.5, roll: float = -2.5) -> bytes:
    return pni_data([(5, heading), (24, pitch), (25, roll)])


def sum8(data: bytes) -> int:
    value = 0
    for byte in data:
        value = (value + byte) % 256
    return value


def rion(command: int, data: bytes = b"", address: int = 0) -> bytes:
    body = bytes([4 + len(data), address, command]) + data
    return b"\x68" + body + bytes([sum8(body)])


def rion_angle(angle: float, digits: int = 5, decimals: int = 2) -> bytes:
    return bytes.fromhex(("1" if angle < 0 else "0") + str(round(abs(angle) * 10**decimals)).zfill(digits))


def rion_angles(pitch: float, roll: float, heading: float) -> bytes:
    return rion(0x84, rion_angle(pitch) + rion_angle(roll) + rion_angle(heading))


def rion_long(x: float, y: float, rest: bytes = b"\0\0\0") -> bytes:
    return rion(0x84, rion_angle(x, 7, 4) + rion_angle(y, 7, 4) + rest)


def wit(kind: int, x: int = 0, y: int = 0, z: int = 0, last: int = 2500) -> bytes:
    body = struct.pack("<BBhhhh", 0x55, kind, x, y, z, last)
    return body + bytes([sum8(body)])


def wit_imu(accel: tuple[int, int, int] = (0, 0, 2048), gyro: tuple[int, int, int] = (1, -2, 3)) -> bytes:
    return wit(0x51, *accel) + wit(0x52, *gyro)


def right_pni_data(data: bytes) -> list[Found]:
    """Every data frame of a PNI compass whose CRC is right, at whatever offset."""
    found = []
    for start in range(len(data) - 4):
        size = int.from_bytes(data[start : start + 2], "big")
        if 5 <= size <= 200 and data[start + 2] == 5 and start + size <= len(data):
            body, crc = data[start : start + size - 2], data[start + size - 2 : start + size]
            if crc16_xmodem(body) == int.from_bytes(crc, "big"):
                found.append(Found(start, start + size))
    return found


def right_rion_angles(data: bytes) -> list[Found]:
    """Every answer with angles whose sum is right and whose digits are digits; of two that overlap the first."""
    found: list[Found] = []
    for start in range(len(data) - 13):
        length = data[start + 1]
        if data[start] != 0x68 or data[start + 3] != 0x84 or length not in (13, 15):
            continue
        if found and start < found[-1].end:
            continue
        frame = data[start : start + 1 + length]
        if len(frame) == 1 + length and sum8(frame[1:-1]) == frame[-1]:
            digits, each = (frame[4:-1].hex(), 6) if length == 13 else (frame[4:12].hex(), 8)
            angles = [digits[at : at + each] for at in range(0, len(digits), each)]
            if digits.isdecimal() and all(map(_can_be, angles, ("01", "01", "0"), (90, 90, 359.99))):
                found.append(Found(start, start + 1 + length))
    return found


def _can_be(digits: str, signs: str, greatest: float) -> bool:
    return digits[0] in signs and int(digits[1:4]) + int(digits[4:]) / 10 ** len(digits[4:]) <= greatest


def right_wit(data: bytes) -> list[Found]:
    """Every frame of a WitMotion device whose sum is right and that has another one right behind it."""
    right = {
        start
        for start in range(len(data) - 10)
        if data[start] == 0x55
        and 0x50 <= data[start + 1] <= 0x5F
        and sum8(data[start : start + 10]) == data[start + 10]
    }
    return [Found(start, start + 11) for start in sorted(right) if start + 11 in right]
