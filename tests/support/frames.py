"""Encoders and brute-force readers of the devices' wire formats, written apart from the decoders under test.

Slow and plain on purpose: checksums bit by bit, frames tried at every offset.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

# Bytes of each field, by group and bit (VectorNav UM001, binary output tables).
COMMON_SIZES = (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8)
IMU_SIZES = (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2)


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


def right_rion_sums(data: bytes) -> list[Found]:
    """Find every RION frame by first byte, length and sum, intended or by chance."""
    ends = [(at, at + 1 + data[at + 1]) for at in range(len(data) - 1) if data[at] == 0x68 and data[at + 1] >= 4]
    return [Found(at, end) for at, end in ends if end <= len(data) and sum8(data[at + 1 : end - 1]) == data[end - 1]]


# ------------------------------------------------------------------------------------------------ MIP, Xbus, STIM300


def fletcher(data: bytes) -> bytes:
    one = two = 0
    for byte in data:
        one = (one + byte) & 0xFF
        two = (two + one) & 0xFF
    return bytes([one, two])


def mip(fields: list[tuple[int, bytes]], *, descriptor_set: int = 0x80) -> bytes:
    payload = b"".join(bytes([len(data) + 2, descriptor]) + data for descriptor, data in fields)
    head = bytes([0x75, 0x65, descriptor_set, len(payload)]) + payload
    return head + fletcher(head)


def big_floats(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def mip_imu(
    time_s: float = 5.0,
    gyro: tuple[float, ...] = (0.25, -0.5, 0.75),
    accel_g: tuple[float, ...] = (0.5, -0.25, -1.0),
) -> bytes:
    time = struct.pack(">dHH", time_s, 2400, 0)
    return mip([(0x12, time), (0x04, big_floats(*accel_g)), (0x05, big_floats(*gyro))])


def xbus(identifier: int, data: bytes = b"", *, extended: bool = False) -> bytes:
    length = b"\xff" + struct.pack(">H", len(data)) if extended or len(data) > 254 else bytes([len(data)])
    body = bytes([0xFF, identifier]) + length + data
    return b"\xfa" + body + bytes([(256 - sum(body) % 256) % 256])


def mtdata2(fields: list[tuple[int, bytes]], *, extended: bool = False) -> bytes:
    data = b"".join(struct.pack(">HB", identifier, len(value)) + value for identifier, value in fields)
    return xbus(0x36, data, extended=extended)


def xsens_imu(
    counter: int = 7,
    ticks: int = 50_000,
    gyro: tuple[float, ...] = (0.25, -0.5, 0.75),
    accel: tuple[float, ...] = (0.5, -0.25, 9.75),
) -> bytes:
    stamps = [(0x1020, struct.pack(">H", counter)), (0x1060, struct.pack(">I", ticks))]
    return mtdata2([*stamps, (0x4020, big_floats(*accel)), (0x8020, big_floats(*gyro))])


def right_xbus(data: bytes, longest: int) -> list[Found]:
    """Every message of at most so many bytes of data whose checksum is right, at whatever offset."""
    found = []
    for start in range(len(data) - 4):
        if data[start : start + 2] != b"\xfa\xff":
            continue
        length, begin = data[start + 3], start + 4
        if length == 255:
            length, begin = int.from_bytes(data[start + 4 : start + 6], "big"), start + 6
        end = begin + length + 1
        if length <= longest and end <= len(data) and sum(data[start + 1 : end]) % 256 == 0:
            found.append(Found(start, end))
    return found


def crc32_mpeg2(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C11DB7 if crc & 0x80000000 else crc << 1) & 0xFFFFFFFF
    return crc


def stim(body: bytes, *, crc: int | None = None) -> bytes:
    padded = body + bytes(-len(body) % 4)
    return body + struct.pack(">I", crc32_mpeg2(padded) if crc is None else crc)


def int24(*values: int) -> bytes:
    return b"".join((value & 0xFFFFFF).to_bytes(3, "big") for value in values)


# Identifier to clusters (rate, acceleration, inclination, ...) of three values, temperatures, and AUX or PPS (TS1524,
# tables 5-20 and 5-21): written out, as the decoder computes them.
STIM_CONTENTS: dict[int, str] = {
    0x90: "r", 0x91: "ra", 0x92: "ri", 0x93: "rai", 0x94: "rt", 0xA5: "rat", 0xA6: "rit", 0xA7: "rait",
    0x98: "rx", 0x99: "rax", 0x9A: "rix", 0x9B: "raix", 0x9C: "rtx", 0xAD: "ratx", 0xAE: "ritx", 0xAF: "raitx",
    0xF0: "rx", 0xF1: "rax", 0xF2: "rix", 0xF3: "raix", 0xF4: "rtx", 0xF5: "ratx", 0xF6: "ritx", 0xF7: "raitx",
}  # fmt: skip
STIM_SPECIAL_SIZES = {
    0xB1: 20, 0xB3: 20, 0xB5: 20, 0xB7: 20, 0xBC: 26, 0xBD: 26, 0xBE: 21, 0xBF: 21, 0xD1: 40, 0xD2: 40
}  # fmt: skip


def stim300(
    identifier: int = 0x93,
    *,
    gyro: tuple[int, ...] = (1 << 14, -2 << 14, 1 << 13),
    accel: tuple[int, ...] = (0, 0, 1 << 19),
    inclination: tuple[int, ...] = (0, 0, 1 << 22),
    status: dict[str, int] | None = None,
    counter: int = 225,
    latency_us: int = 0,
) -> bytes:
    """A normal mode datagram in counts; status bytes by the letter of their cluster, "t" for all temperatures."""
    contents, said = STIM_CONTENTS[identifier], status or {}
    clusters = [letter for letter in contents if letter in "rai"]
    body = bytes([identifier])
    for letter in clusters:
        body += int24(*{"r": gyro, "a": accel, "i": inclination}[letter]) + bytes([said.get(letter, 0)])
    if "t" in contents:
        for _, degrees in zip(clusters, (25 * 256, 30 * 256, 35 * 256), strict=False):
            body += struct.pack(">3h", degrees, degrees, degrees) + bytes([said.get("t", 0)])
    if "x" in contents:
        body += int24(-5) + b"\0"
    return stim(body + struct.pack(">BH", counter, latency_us))


def stim_configuration(range_code: int = 0, units: tuple[int, int, int] = (0, 0, 0)) -> bytes:
    body = bytearray(22)
    body[0] = 0xBC
    for place, unit in zip((5, 8, 11), units, strict=True):
        body[place] = 0x70 | unit
    body[17], body[18] = range_code << 4 | range_code, range_code << 4
    return stim(bytes(body))


def stim_bytes(identifier: int) -> int:
    contents = STIM_CONTENTS.get(identifier)
    if contents is None:
        return STIM_SPECIAL_SIZES.get(identifier, 0)
    clusters = sum(letter in "rai" for letter in contents)
    return 1 + clusters * 10 + ("t" in contents) * clusters * 7 + ("x" in contents) * 4 + 3 + 4
