r"""VectorNav VN-100 and relatives: ASCII and binary asynchronous outputs on one port, in any mixture.

    $VNYMR,yaw,pitch,roll,mag x 3,accel x 3,gyro x 3*hh\r\n            degrees, gauss, m/s^2, rad/s
    $VNIMU,mag x 3,accel x 3,gyro x 3,temperature,pressure*hh\r\n      uncompensated; degrees Celsius, kPa
    0xFA groups masks fields crc                                       see below

Source: VectorNav UM001. Axes are X forward, Y right, Z down; level and at rest the accelerometer reads z = -9.8.

A binary frame is 0xFA, a byte with one bit a group, one little-endian 16-bit mask of fields a group, the fields in
ascending order of their bits, and a CRC-16/XMODEM, big-endian, over all but the first byte ("Binary Output Messages").
Only groups 1 (common) and 3 (IMU) are known here. The length of an unknown field is unknown, and so is everything
after it; older firmware gave some bits other meanings, which then fails the CRC. Nothing is guessed.
"""

from __future__ import annotations

import binascii
import functools
import re
import struct
from dataclasses import dataclass
from typing import ClassVar

from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import (
    WAIT,
    FrameDecoder,
    RejectedError,
    body_of_sentence,
    check_imu,
    numbers,
    xor_checksum,
)
from companion.protocols.decoding.dialogue import WakeDialogue
from companion.samples import ImuSample, Sample, Vector

_Fields = tuple[tuple[str, str], ...]

_COMMON: _Fields = (
    ("time_startup_ns", "Q"),
    ("time_gps_ns", "Q"),
    ("time_sync_in_ns", "Q"),
    ("yaw_pitch_roll_deg", "3f"),
    ("quaternion", "4f"),
    ("angular_rate_rad_s", "3f"),
    ("position", "3d"),
    ("velocity", "3f"),
    ("accel_m_s2", "3f"),
    ("uncompensated_accel_and_gyro", "6f"),
    ("mag_temperature_pressure", "5f"),
    ("delta_theta_velocity", "7f"),
    ("ins_status", "H"),
    ("sync_in_count", "I"),
    ("time_gps_pps_ns", "Q"),
)
_IMU: _Fields = (
    ("imu_status", "H"),
    ("uncompensated_mag_gauss", "3f"),
    ("uncompensated_accel_m_s2", "3f"),
    ("uncompensated_gyro_rad_s", "3f"),
    ("temperature_degc", "f"),
    ("pressure_kpa", "f"),
    ("delta_theta", "4f"),
    ("delta_velocity", "3f"),
    ("mag_gauss", "3f"),
    ("imu_accel_m_s2", "3f"),
    ("imu_angular_rate_rad_s", "3f"),
    ("saturation", "H"),
)
_GROUPS: dict[int, _Fields] = {0x01: _COMMON, 0x04: _IMU}
_KNOWN_GROUPS = 0x05

# Rate and acceleration that belong together first: compensated ones, as $VNYMR has them, before uncompensated ones.
_RATES: tuple[str, ...] = (
    "angular_rate_rad_s",
    "imu_angular_rate_rad_s",
    "uncompensated_gyro",
    "uncompensated_gyro_rad_s",
)
_ACCELERATIONS: tuple[str, ...] = ("accel_m_s2", "imu_accel_m_s2", "uncompensated_accel", "uncompensated_accel_m_s2")
_TEMPERATURES = ("temperature_degc", "temperature")
_PARTS = {
    "uncompensated_accel_and_gyro": {"uncompensated_accel": 0, "uncompensated_gyro": 3},
    "mag_temperature_pressure": {"temperature": 3},
}


def header_bytes(groups: int) -> int:
    """Return the length of a header with these groups; raise RejectedError for an unknown group, or none."""
    if groups == 0 or groups & ~_KNOWN_GROUPS:
        raise RejectedError(reasons.UNKNOWN_GROUP)
    return 2 + 2 * groups.bit_count()


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of one kind of frame: its length and the place of each value among the unpacked ones."""

    frame_bytes: int
    payload: struct.Struct
    payload_offset: int
    time_startup: int | None
    imu: tuple[int, int] | None
    temperature: int | None

    def samples(self, frame: bytes, start: int, t_s: float) -> list[Sample]:
        """Return the samples of a frame at `start` with a right CRC; raise RejectedError where none is of use."""
        values = self.payload.unpack_from(frame, start + self.payload_offset)
        if self.imu is None:
            raise RejectedError(reasons.NOTHING_OF_USE)
        gyro, accel = self.imu
        gyro_rad_s: Vector = values[gyro : gyro + 3]
        accel_m_s2: Vector = values[accel : accel + 3]
        temperature_degc = None if self.temperature is None else values[self.temperature]
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        t_device_s = None if self.time_startup is None else values[self.time_startup] / 1e9
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, None, t_device_s)]


@functools.lru_cache(maxsize=16)
def layout_of(header: bytes) -> Layout:
    """Parse a whole header; raise RejectedError for an unknown field, or a group without fields."""
    places: dict[str, int] = {}
    code, count = "<", 0
    masks = iter(struct.unpack_from(f"<{len(header) // 2 - 1}H", header, 2))
    for group, fields in _GROUPS.items():
        if not header[1] & group:
            continue
        mask = next(masks)
        if mask == 0 or mask >> len(fields):
            raise RejectedError(reasons.UNKNOWN_FIELD)
        for bit, (name, field_code) in enumerate(fields):
            if mask & 1 << bit:
                parts = _PARTS.get(name, {name: 0})
                places.update({part: count + offset for part, offset in parts.items()})
                code += field_code
                count += int(field_code[:-1] or 1)
    payload = struct.Struct(code)
    return Layout(
        frame_bytes=len(header) + payload.size + 2,
        payload=payload,
        payload_offset=len(header),
        time_startup=places.get("time_startup_ns"),
        imu=_pair(places),
        temperature=_first(places, _TEMPERATURES),
    )


def _first(places: dict[str, int], names: tuple[str, ...]) -> int | None:
    return next((places[name] for name in names if name in places), None)


def _pair(places: dict[str, int]) -> tuple[int, int] | None:
    for kind in (slice(0, 2), slice(2, 4), slice(0, 4)):
        gyro, accel = _first(places, _RATES[kind]), _first(places, _ACCELERATIONS[kind])
        if gyro is not None and accel is not None:
            return gyro, accel
    return None


SENTENCE_LIMIT = 250
"""Bytes of a sentence after its "$"; the longest asynchronous one has some 200."""

_SYNC = 0xFA
_DOLLAR = ord("$")
_START = re.compile(rb"[\xfa$]")
_END_OF_TEXT = re.compile(rb"[^ -#%-~]")
"""The first byte that cannot be inside a sentence: a line end, a "$", or nothing printable."""

_REPLIES = frozenset((b"VNRRG", b"VNWRG", b"VNWNV", b"VNRFS", b"VNRST", b"VNTAR", b"VNASY", b"VNSGB", b"VNCMD"))


class VectorNavDecoder(FrameDecoder):
    """VectorNav outputs; gives `ImuSample`."""

    device_clock_wraps_s: ClassVar[float | None] = 2**64 / 1e9
    clock_from_start: ClassVar[bool] = True

    def _next(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        if buffer[at] == _SYNC:
            return self._binary(buffer, at, origin, samples)
        if buffer[at] == _DOLLAR:
            return self._sentence(buffer, at, origin, samples)
        match = _START.search(buffer, at)
        return match.start() if match else len(buffer)

    def _binary(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        available = len(buffer) - at
        if available < 2:
            return WAIT
        try:
            header_size = header_bytes(buffer[at + 1])
            if available < header_size:
                return WAIT
            layout = layout_of(buffer[at : at + header_size])
        except RejectedError as error:
            return self._reject(error.reason, at + 1)
        if available < layout.frame_bytes:
            return WAIT
        end = at + layout.frame_bytes
        if binascii.crc_hqx(buffer[at + 1 : end], 0) != 0:
            return self._reject(reasons.CHECKSUM, at + 1)
        return self._accept(samples, layout.samples, buffer, at, self._time_of(origin + end), end=end)

    def _sentence(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        begin = buffer[at : at + 3]
        if not b"$VN".startswith(begin):
            return at + 1
        limit = at + 1 + SENTENCE_LIMIT
        match = _END_OF_TEXT.search(buffer, at + 1, limit)
        if match is None:
            return WAIT if len(buffer) < limit else self._reject(reasons.TOO_LONG, at + 1)
        end = match.start()
        if buffer[end] not in b"\r\n":
            return self._reject(reasons.CUT_SHORT, end)
        return self._accept(samples, _decode, buffer[at:end], self._time_of(origin + end + 1), end=end)


_SENTENCES: dict[bytes, tuple[int, slice, slice]] = {
    b"VNYMR": (12, slice(6, 12), slice(0, 0)),
    b"VNIMU": (11, slice(3, 9), slice(9, 10)),
}
"""Count of numbers, and the places of force and rate, and of the temperature."""


def _decode(sentence: bytes, t_s: float) -> list[Sample]:
    head, *fields = body_of_sentence(sentence).split(b",")
    if head == b"VNERR":
        raise RejectedError("VNERR")
    if head not in _SENTENCES:
        raise RejectedError(reasons.REPLY if head in _REPLIES else reasons.UNKNOWN_SENTENCE)
    count, vectors, temperature = _SENTENCES[head]
    if len(fields) != count:
        raise RejectedError(reasons.FIELD_COUNT)
    values = numbers(fields)
    ax, ay, az, gx, gy, gz = values[vectors]
    gyro_rad_s, accel_m_s2, temperature_degc = (gx, gy, gz), (ax, ay, az), next(iter(values[temperature]), None)
    check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
    return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc)]


def _command(body: bytes) -> bytes:
    return b"$%b*%02X\r\n" % (body, xor_checksum(body))


class VectorNavDialogue(WakeDialogue):
    """First end a pause of the outputs, then choose the factory's output, $VNYMR, on the port that we speak on.

    UM001: p. 56 (a pause changes no register), p. 63 (register 6 without a port is that of the port in use), p. 54
    (registers are kept over a reset only by $VNWNV, which is never sent from here). A device without any output set is
    rare; binary outputs (register 75) are not touched, as they name a port by its number, which is not known here.
    """

    SAYINGS = (
        (_command(b"VNASY,1"), "outputs resumed with $VNASY,1"),
        (_command(b"VNWRG,06,14"), "$VNYMR chosen with $VNWRG,06,14, until power is cut"),
    )
