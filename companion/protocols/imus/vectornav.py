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
import math
import re
import struct
from typing import ClassVar

from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import WAIT, RejectedError, SentenceDecoder, check_imu, xor_checksum
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


@functools.lru_cache(maxsize=16)
def layout_of(header: bytes) -> tuple[struct.Struct, dict[str, int]]:
    """Parse the masks of a header: the frame before its CRC, and the places of what is used among its values.

    Raises:
        RejectedError: a field is unknown, or a group has none.
    """
    places: dict[str, int] = {}
    code, count = f"<{len(header)}x", 0
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
    used = {
        "gyro": None, "accel": None, "temperature": _first(places, _TEMPERATURES),
        "time": places.get("time_startup_ns"),
    }  # fmt: skip
    for kind in (slice(0, 2), slice(2, 4), slice(0, 4)):
        gyro, accel = _first(places, _RATES[kind]), _first(places, _ACCELERATIONS[kind])
        if gyro is not None and accel is not None:
            used |= {"gyro": gyro, "accel": accel}
            break
    return struct.Struct(code), {name: place for name, place in used.items() if place is not None}


def _first(places: dict[str, int], names: tuple[str, ...]) -> int | None:
    return next((places[name] for name in names if name in places), None)


_SYNC = 0xFA
_REPLIES = frozenset((b"VNRRG", b"VNWRG", b"VNWNV", b"VNRFS", b"VNRST", b"VNTAR", b"VNASY", b"VNSGB", b"VNCMD"))


class VectorNavDecoder(SentenceDecoder):
    """VectorNav outputs; gives `ImuSample`."""

    START = re.compile(rb"\xfa|\$(?:V(?:N|\Z)|\Z)")
    END = re.compile(rb"[^ -#%-~]")
    """The first byte that cannot be inside a sentence: a line end, a "$", or nothing printable."""
    LIMIT = 250
    """The longest asynchronous sentence has some 200 bytes."""
    device_clock_wraps_s: ClassVar[float | None] = 2**64 / 1e9
    clock_from_start: ClassVar[bool] = True

    def _size(self, buffer: bytes, at: int) -> int:
        if buffer[at] != _SYNC:
            return super()._size(buffer, at)
        available = len(buffer) - at
        if available < 2:
            return WAIT
        header_bytes = _header_bytes(buffer[at + 1])
        if available < header_bytes:
            return WAIT
        size = layout_of(buffer[at : at + header_bytes])[0].size + 2
        if available < size:
            return WAIT
        if binascii.crc_hqx(buffer[at + 1 : at + size], 0) != 0:
            raise RejectedError(reasons.CHECKSUM)
        return size

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[0] != _SYNC:
            return super()._decode(frame, t_s)
        layout, places = layout_of(frame[: _header_bytes(frame[1])])
        if "gyro" not in places:
            raise RejectedError(reasons.NOTHING_OF_USE)
        values, gyro, accel = layout.unpack_from(frame), places["gyro"], places["accel"]
        gyro_rad_s: Vector = values[gyro : gyro + 3]
        accel_m_s2: Vector = values[accel : accel + 3]
        temperature_degc = values[places["temperature"]] if "temperature" in places else None
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        t_device_s = values[places["time"]] / 1e9 if "time" in places else None
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, None, t_device_s)]

    def _read(self, body: bytes, t_s: float) -> list[Sample]:
        head, *fields = body.split(b",")
        if head == b"VNERR":
            raise RejectedError("VNERR")
        if head not in _SENTENCES:
            raise RejectedError(reasons.REPLY if head in _REPLIES else reasons.UNKNOWN_SENTENCE)
        count, vectors, temperature = _SENTENCES[head]
        if len(fields) != count:
            raise RejectedError(reasons.FIELD_COUNT)
        values = [float(field) for field in fields]
        if not math.isfinite(sum(values)):
            raise RejectedError(reasons.NON_FINITE)
        ax, ay, az, gx, gy, gz = values[vectors]
        gyro_rad_s, accel_m_s2, temperature_degc = (gx, gy, gz), (ax, ay, az), next(iter(values[temperature]), None)
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc)]


def _header_bytes(groups: int) -> int:
    if groups == 0 or groups & ~_KNOWN_GROUPS:
        raise RejectedError(reasons.UNKNOWN_GROUP)
    return 2 + 2 * groups.bit_count()


_SENTENCES: dict[bytes, tuple[int, slice, slice]] = {
    b"VNYMR": (12, slice(6, 12), slice(0, 0)),
    b"VNIMU": (11, slice(3, 9), slice(9, 10)),
}
"""Count of numbers, and the places of force and rate, and of the temperature."""


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
