r"""VectorNav VN-100 and relatives: ASCII and binary asynchronous outputs on one port, in any mix.

    $VNYMR,yaw,pitch,roll,mag x 3,accel x 3,gyro x 3*hh\r\n            degrees, gauss, m/s^2, rad/s
    $VNIMU,mag x 3,accel x 3,gyro x 3,temperature,pressure*hh\r\n      uncompensated; degrees Celsius, kPa
    0xFA groups masks fields crc                                       see below

Source: VectorNav UM001. Axes are X forward, Y right, Z down; level and at rest the accelerometer reads z = -9.8.

A binary frame ("Binary Output Messages") is 0xFA, a byte with one bit per group, and one little-endian 16-bit mask of
fields per group. The fields follow in ascending order of their bits, then a CRC-16/XMODEM, big-endian, over all but the
first byte. Only groups 1 (common) and 3 (IMU) are decoded. An unknown field has an unknown length, so its whole frame
is rejected. Older firmware gave some bits other meanings; such frames fail the CRC.
"""

from __future__ import annotations

import binascii
import functools
import math
import re
import struct
from typing import ClassVar, Final

from companion.protocols.decoding.base import WAIT, RejectedError, SentenceDecoder, check_imu, xor_checksum
from companion.protocols.decoding.dialogue import WakeDialogue
from companion.samples import ImuSample, Sample, Vector

_GROUPS: Final[dict[int, tuple[str, dict[int, dict[str, int]]]]] = {
    # Times since start, of GPS and since a sync pulse; yaw, pitch, roll; quaternion; rate (5), position, velocity,
    # acceleration (8); uncompensated acceleration and rate (9); field, temperature, pressure (10); increments; states.
    0x01: (
        "Q Q Q 3f 4f 3f 3d 3f 3f 6f 5f 7f H I Q",
        {
            0: {"time": 0},
            5: {"gyro": 0},
            8: {"accel": 0},
            9: {"raw accel": 0, "raw gyro": 3},
            10: {"temperature": 3},
        },
    ),
    # State; uncompensated field, acceleration (2), rate (3); temperature (4), pressure; increments; field,
    # acceleration (9), rate (10); saturation.
    0x04: (
        "H 3f 3f 3f f f 4f 3f 3f 3f 3f H",
        {
            2: {"imu raw accel": 0},
            3: {"imu raw gyro": 0},
            4: {"imu temperature": 0},
            9: {"imu accel": 0},
            10: {"imu gyro": 0},
        },
    ),
}
"""Groups: formats of all fields in the order of their bits; for some bits, indices of used values within the field."""
_KNOWN_GROUPS: Final = 0x05
# Preferred order: rate and acceleration from one group first, and compensated values (as in $VNYMR) before raw ones.
_SOURCES: Final = ("", "imu ", "raw ", "imu raw ")


@functools.lru_cache(maxsize=16)
def layout_of(header: bytes) -> tuple[struct.Struct, dict[str, int]]:
    """Return the struct of a frame without its CRC, and the index of each value used; RejectedError: unknown field."""
    places: dict[str, int] = {}
    code, count = f"<{len(header)}x", 0
    masks = iter(struct.unpack_from(f"<{len(header) // 2 - 1}H", header, 2))
    for group, (formats, used) in _GROUPS.items():
        if not header[1] & group:
            continue
        mask = next(masks)
        fields = formats.split()
        if mask == 0 or mask >> len(fields):
            raise RejectedError("unknown field")
        for bit, field in enumerate(fields):
            if mask & 1 << bit:
                places.update({part: count + offset for part, offset in used.get(bit, {}).items()})
                code += field
                count += int(field[:-1] or 1)
    found: dict[str, int] = {name: places[name] for name in ("time", "temperature") if name in places}
    if "imu temperature" in places:
        found["temperature"] = places["imu temperature"]
    for sources in (_SOURCES[:2], _SOURCES[2:], _SOURCES):
        gyro, accel = (
            next((places[source + part] for source in sources if source + part in places), None)
            for part in ("gyro", "accel")
        )
        if gyro is not None and accel is not None:
            found |= {"gyro": gyro, "accel": accel}
            break
    return struct.Struct(code), found


_SYNC = 0xFA
_REPLIES = frozenset((b"VNRRG", b"VNWRG", b"VNWNV", b"VNRFS", b"VNRST", b"VNTAR", b"VNASY", b"VNSGB", b"VNCMD"))


class VectorNavDecoder(SentenceDecoder):
    START = re.compile(rb"\xfa|\$(?:V(?:N|\Z)|\Z)")
    END = re.compile(rb"[^ -#%-~]")
    """First byte that cannot be inside a sentence: a line end, a "$", or an unprintable byte."""
    LIMIT = 250  # the longest asynchronous sentence has some 200 bytes
    device_clock_wraps_s: ClassVar[float | None] = 2**64 / 1e9
    clock_from_start: ClassVar[bool] = True
    _layout: tuple[struct.Struct, dict[str, int]]  # Layout of the binary frame that was checked last

    def _size(self, buffer: bytes, at: int) -> int:
        if buffer[at] != _SYNC:
            return super()._size(buffer, at)
        groups = buffer[at + 1]
        if groups == 0 or groups & ~_KNOWN_GROUPS:
            raise RejectedError("unknown group")
        end = at + 2 + 2 * groups.bit_count()
        if end > len(buffer):
            return WAIT
        self._layout = layout_of(buffer[at:end])
        return self._layout[0].size + 2

    def _check(self, frame: bytes) -> None:
        if frame[0] == _SYNC and binascii.crc_hqx(frame[1:], 0) != 0:
            raise RejectedError("checksum")

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[0] != _SYNC:
            return super()._decode(frame, t_s)
        layout, places = self._layout
        if "gyro" not in places:
            raise RejectedError("nothing of use")
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
            raise RejectedError("reply" if head in _REPLIES else "unknown sentence")
        count, vectors, temperature = _SENTENCES[head]
        if len(fields) != count:
            raise RejectedError("field count")
        values = [float(field) for field in fields]
        if not math.isfinite(sum(values)):
            raise RejectedError("non-finite")
        ax, ay, az, gx, gy, gz = values[vectors]
        gyro_rad_s, accel_m_s2, temperature_degc = (gx, gy, gz), (ax, ay, az), next(iter(values[temperature]), None)
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc)]


_SENTENCES: dict[bytes, tuple[int, slice, slice]] = {
    b"VNYMR": (12, slice(6, 12), slice(0, 0)),
    b"VNIMU": (11, slice(3, 9), slice(9, 10)),
}
"""Sentences: count of numbers, slice with acceleration and rate, slice with the temperature (empty: none)."""


def _command(body: bytes) -> bytes:
    return b"$%b*%02X\r\n" % (body, xor_checksum(body))


class VectorNavDialogue(WakeDialogue):
    """Commands that end a pause of the outputs, then select the factory's output, $VNYMR, on the port in use.

    UM001: a pause changes no register (p. 56). A write of register 6 without a port acts on the port in use (p. 63).
    Registers survive a reset only after $VNWNV, which is never sent (p. 54). A device without any output is rare.
    Binary outputs (register 75) stay unchanged, because they name a port by its number, which is unknown.
    """

    SAYINGS = (
        (_command(b"VNASY,1"), "outputs resumed with $VNASY,1"),
        (_command(b"VNWRG,06,14"), "$VNYMR chosen with $VNWRG,06,14, until power is cut"),
    )
