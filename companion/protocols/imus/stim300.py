r"""Sensonor (Safran) STIM300 and STIM318: gyros, accelerometers, inclinometers in one datagram.

    id  (3 x int24, status)...  counter  latency (us)  CRC-32  [CR LF]        big-endian

Source: TS1524 rev. 31. Units: rate 2^-14 deg/s, inclination 2^-22 g, temperature 2^-8 degC. Acceleration: 2^-19 g for a
range of 10 g, which is assumed, 2^-20 for 5 g, 2^-18 for 30 g, 2^-16 for 80 g (2^-21 for the former 2 g).

*Range*: only the configuration datagram (table 5-16), sent at power-on, names the unit's range. The range of a unit
that already runs is found from gravity: a second at rest shows 1 g in one range only, because ranges differ by factors
of two. Until the range is known, samples far from 1 g in the assumed range are withheld.

*Time*: a sample is older than its datagram by the latency. *Counter*: internal samples, 2000 a second, modulo 256.

*Axes* are those of figure 6-4; at rest the axis that points up reads +1 g. The inclinometers become a `TiltSample`
of the law "axis": the elevation of each axis is the arc sine of its share of the measured gravity. So y, nose up, is
asin(X / |g|). And x, right side down, is -asin(Y / |g|) with Z down (Y right), or +asin(Y / |g|) with Z up (Y left).
The unit may lie on either side, with X forward. Beyond 60 degrees there is no `TiltSample`. Rates and forces stay in
the unit's own axes: with Z up, ROTATION_ROLL_180 makes them forward, right, down.

Datagrams: tables 5-13 to 5-23. Earlier revisions have datagrams with AUX (0x98 to 0x9C, 0xAD to 0xAF), rev. 31 has PPS
instead (0xF0 to 0xF7); both add one cluster of a 24-bit value and a status byte.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from typing import ClassVar, Final

from companion.physics.units import DEG, G
from companion.protocols.decoding.base import NO_FRAME, WAIT, Decoder, RejectedError, check_imu
from companion.samples import ImuSample, Sample, TiltSample, Vector

CRC_BYTES: Final = 4
CONFIGURATION: Final = (0xBC, 0xBD)

SPECIAL_BYTES: Final[dict[int, int]] = {
    **dict.fromkeys((0xB1, 0xB3, 0xB5, 0xB7), 20),  # part number, serial number
    **dict.fromkeys(CONFIGURATION, 26),
    **dict.fromkeys((0xBE, 0xBF), 21),  # extended error
    **dict.fromkeys((0xD1, 0xD2), 40),  # bias trim
}
"""Sizes, CRC included, of datagrams sent at start-up or on demand, by id; the second id of each pair ends in CR LF."""

_VECTOR = "bHbHbHB"
"""Struct format of three 24-bit numbers (each a signed first byte, then 16 unsigned bits) and a status byte."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def _layout(*, accel: bool, inclination: bool, temperature: bool, extra: bool) -> tuple[struct.Struct, dict[str, int]]:
    """Return the struct of a STIM300 datagram without its CRC, and for each block the index of its first value."""
    code, count = ">x" + _VECTOR, 7
    places: dict[str, int] = {}
    for name, present in (("accel", accel), ("inclination", inclination)):
        if present:
            places[name] = count
            code, count = code + _VECTOR, count + 7
    if temperature:
        for name in ("gyro", *places):
            places[f"{name}_temperature"] = count
            code, count = code + "hhhB", count + 4
    if extra:
        code, count = code + "xxxB", count + 1
    places["counter"] = count
    return struct.Struct(code + "BH"), places


def _normal_mode() -> dict[int, tuple[struct.Struct, dict[str, int]]]:
    layouts: dict[int, tuple[struct.Struct, dict[str, int]]] = {}
    for content in range(8):
        accel, inclination, temperature = bool(content & 1), bool(content & 2), bool(content & 4)
        plain = _layout(accel=accel, inclination=inclination, temperature=temperature, extra=False)
        extra = _layout(accel=accel, inclination=inclination, temperature=temperature, extra=True)
        first = 0xA0 if content > 4 else 0x90
        layouts |= {first + content: plain, first + 8 + content: extra, 0xF0 + content: extra}
    return layouts


NORMAL_MODE: Final = _normal_mode()
FRAME_BYTES: Final = {name: values.size + CRC_BYTES for name, (values, _) in NORMAL_MODE.items()} | SPECIAL_BYTES


def is_whole(frame: bytes) -> bool:
    """Check the CRC-32/MPEG-2 at the end of a datagram; it covers the datagram, padded with zeros to whole words.

    CRC-32/MPEG-2 is zlib's CRC with reversed bit order and no final inversion, so zlib runs over mirrored bytes.
    """
    mirrored = frame.translate(_REVERSED)
    body = mirrored[:-CRC_BYTES]
    crc = zlib.crc32(body.ljust(len(body) + 3 & ~3, b"\0")) ^ 0xFFFFFFFF
    return crc == int.from_bytes(mirrored[-CRC_BYTES:], "little")


STARTING = "starting up"
FAULT = "fault reported"
OUTSIDE_CONDITIONS = "outside operating conditions"
RANGE_NOT_KNOWN = "accelerometer range not known"
OUTPUT_UNIT = "output unit"

REST_TICKS: Final = 2000  # Internal samples at rest (a second of them) that decide the accelerometers' range
REST_DEG_S: Final = 3.0  # the fastest rate that counts as "at rest"; a turn-on bias is a tenth of it

_ASSUMED_BITS = 19
_BITS = (16, 18, 19, 20, 21)
_RANGE_CODES = {0: 19, 2: 21, 3: 20, 4: 18, 6: 16}
"""Exponent n of the acceleration's unit 2^-n g, by range code: a nibble of the configuration's bytes 17 and 18."""
_GYRO_SCALE: Final = DEG / 2**14
_GYRO_UNIT, _ACCEL_UNIT, _INCLINATION_UNIT, _ACCEL_RANGE = 5, 8, 11, 17

_SYSTEM, _START_UP, _CONDITIONS, _OVERLOAD, _CHANNEL = 0x80, 0x40, 0x20, 0x10, 0x08
_IDENTIFIERS = re.compile(b"[" + b"".join(re.escape(bytes((name,))) for name in sorted(FRAME_BYTES)) + b"]")


class Stim300Decoder(Decoder):
    """Decoder of STIM300 datagrams into `ImuSample` (if they hold acceleration) and `TiltSample` (inclination).

    Datagrams have no start mark: after a loss, decoding continues at the next right CRC. An unusable tilt counts as
    rejected even if its datagram gave an `ImuSample`.
    """

    START = _IDENTIFIERS
    sequence_modulus: ClassVar[int | None] = 256

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._forget()

    def _forget(self) -> None:
        self._in_step = True
        self._accel_bits = [_ASSUMED_BITS] * 3
        self._range_known = False
        self._rest_bits = self._rest_ticks = 0
        self._counter: int | None = None
        self._imu_unit_right = self._inclination_unit_right = True

    def interrupted(self) -> None:
        super().interrupted()
        self._forget()

    def _size(self, buffer: bytes, at: int) -> int:
        size = FRAME_BYTES[buffer[at]]
        frame = buffer[at : at + size]
        if len(frame) < size:
            return WAIT
        was_in_step, self._in_step = self._in_step, is_whole(frame)
        if was_in_step and not self._in_step:
            raise RejectedError("checksum")
        return size if self._in_step else NO_FRAME

    def _configure(self, frame: bytes) -> None:
        codes = (frame[_ACCEL_RANGE] >> 4, frame[_ACCEL_RANGE] & 0x0F, frame[_ACCEL_RANGE + 1] >> 4)
        known = [_RANGE_CODES.get(code) for code in codes]
        bits = [each for each in known if each is not None]
        if len(bits) == 3:
            self._accel_bits, self._range_known = bits, True
        # Low nibble: 0 rate, 2 average rate, 8 and 10 their delayed forms; other codes are angles or velocities.
        self._imu_unit_right = frame[_GYRO_UNIT] & 0x05 == 0 and frame[_ACCEL_UNIT] & 0x0D == 0
        self._inclination_unit_right = frame[_INCLINATION_UNIT] & 0x0D == 0

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[0] in CONFIGURATION:
            self._configure(frame)
        if frame[0] in SPECIAL_BYTES:
            raise RejectedError("reply")
        layout, places = NORMAL_MODE[frame[0]]
        values = layout.unpack_from(frame)
        counter, latency_us = values[places["counter"] :]
        t_s -= latency_us * 1e-6
        samples: list[Sample] = []
        refused: RejectedError | None = None
        if "accel" in places:
            try:
                samples.append(self._imu(places, values, counter, t_s))
            except RejectedError as error:
                refused = error
        if "inclination" in places:
            try:
                samples.append(self._tilt(places, values, t_s))
            except RejectedError as error:
                if samples:
                    self.rejected[str(error)] += 1
                refused = refused or error
        if not samples:
            raise refused or RejectedError("nothing of use")
        return samples

    def _imu(self, places: dict[str, int], values: tuple[int, ...], counter: int, t_s: float) -> ImuSample:
        accel = places["accel"]
        if not self._imu_unit_right:
            raise RejectedError(OUTPUT_UNIT)
        if values[6] or values[accel + 6]:
            _check_status(values[6] | values[accel + 6])
        gx, gy, gz = _int24(values, 0)
        ax, ay, az = _int24(values, accel)
        if not self._range_known:
            self._judge_range(math.hypot(gx, gy, gz) / 2**14, math.hypot(ax, ay, az), counter)
        bx, by, bz = self._accel_bits
        gyro_rad_s = (gx * _GYRO_SCALE, gy * _GYRO_SCALE, gz * _GYRO_SCALE)
        accel_m_s2 = (ax * G / (1 << bx), ay * G / (1 << by), az * G / (1 << bz))
        temperature_degc = _temperature(values, places.get("gyro_temperature"))
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        return ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, counter)

    def _judge_range(self, rate_deg_s: float, magnitude: float, counter: int) -> None:
        at_rest = next((bits for bits in _BITS if 0.9 < magnitude / (1 << bits) < 1.1), 0)
        if not at_rest or rate_deg_s > REST_DEG_S or at_rest != self._rest_bits:
            self._rest_bits, self._rest_ticks = at_rest, 0
        elif self._counter is not None:
            self._rest_ticks += (counter - self._counter) & 0xFF
        self._counter = counter
        if self._rest_bits and self._rest_ticks >= REST_TICKS:
            self._accel_bits, self._range_known = [self._rest_bits] * 3, True
        elif not 0.7 < magnitude / (1 << _ASSUMED_BITS) < 1.4:
            raise RejectedError(RANGE_NOT_KNOWN)

    def _tilt(self, places: dict[str, int], values: tuple[int, ...], t_s: float) -> TiltSample:
        inclination = places["inclination"]
        if not self._inclination_unit_right:
            raise RejectedError(OUTPUT_UNIT)
        if values[inclination + 6]:
            _check_status(values[inclination + 6])
        x, y, z = _int24(values, inclination)
        gravity = math.hypot(x, y, z)
        if not 0.5 < gravity / 2**22 < 1.75:
            raise RejectedError("out of range")
        if abs(z) < 0.5 * gravity:
            raise RejectedError("over range")
        right_down = math.asin(y / gravity) / DEG
        nose_up = math.asin(x / gravity) / DEG
        temperature_degc = _temperature(values, places.get("inclination_temperature"))
        return TiltSample(t_s, right_down if z > 0 else -right_down, nose_up, temperature_degc)


def _int24(values: tuple[int, ...], at: int) -> Vector:
    return (
        values[at] << 16 | values[at + 1],
        values[at + 2] << 16 | values[at + 3],
        values[at + 4] << 16 | values[at + 5],
    )


def _temperature(values: tuple[int, ...], at: int | None) -> float | None:
    if at is None or values[at + 3]:
        return None
    return (values[at] + values[at + 1] + values[at + 2]) / 768.0


def _check_status(status: int) -> None:
    if status & _START_UP:
        raise RejectedError(STARTING)
    if status & (_SYSTEM | _CHANNEL):
        raise RejectedError(FAULT)
    if status & _OVERLOAD:
        raise RejectedError("over range")
    if status & _CONDITIONS:
        raise RejectedError(OUTSIDE_CONDITIONS)
