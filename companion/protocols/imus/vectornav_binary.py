"""VectorNav binary outputs: which fields a header announces, where they lie, and what to make of them.

A frame is 0xFA, a byte with one bit a group, one little-endian 16-bit mask of fields a group, the fields in ascending
order of their bits, and a CRC-16/XMODEM, big-endian, over all but the first byte (UM001, "Binary Output Messages").
Only groups 1 (common) and 3 (IMU) are known here. The length of an unknown field is unknown, and so is everything
after it; older firmware gave some bits other meanings, which then fails the CRC. Nothing is guessed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from companion.protocols.decoding.base import NOTHING_OF_USE, UNKNOWN_FIELD, UNKNOWN_GROUP, RejectedError
from companion.protocols.decoding.checks import check_attitude, check_imu, check_vector
from companion.samples import AttitudeSample, ImuSample, MagSample, Sample, Vector

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

MAX_FRAME_BYTES = (
    2 + sum(2 + struct.calcsize("<" + "".join(code for _, code in group)) for group in _GROUPS.values()) + 2
)

# Rate and acceleration that belong together first: compensated ones, as $VNYMR has them, before uncompensated ones.
_RATES: tuple[str, ...] = (
    "angular_rate_rad_s",
    "imu_angular_rate_rad_s",
    "uncompensated_gyro",
    "uncompensated_gyro_rad_s",
)
_ACCELERATIONS: tuple[str, ...] = ("accel_m_s2", "imu_accel_m_s2", "uncompensated_accel", "uncompensated_accel_m_s2")
_MAGS = ("mag", "mag_gauss", "uncompensated_mag_gauss")
_TEMPERATURES = ("temperature_degc", "temperature")
_PARTS = {
    "uncompensated_accel_and_gyro": {"uncompensated_accel": 0, "uncompensated_gyro": 3},
    "mag_temperature_pressure": {"mag": 0, "temperature": 3},
}


def header_bytes(groups: int) -> int:
    """The length of a header, from the sync byte to the last mask, that announces these groups.

    Raises:
        RejectedError: a group that is not known here, or none.
    """
    if groups == 0 or groups & ~_KNOWN_GROUPS:
        raise RejectedError(UNKNOWN_GROUP)
    return 2 + 2 * groups.bit_count()


@dataclass(frozen=True, slots=True)
class Layout:
    """What one kind of frame holds: its length and the place of each value among the unpacked ones."""

    frame_bytes: int
    payload: struct.Struct
    payload_offset: int
    time_startup: int | None
    imu: tuple[int, int] | None
    temperature: int | None
    attitude: int | None
    mag: int | None

    def samples(self, frame: bytes, start: int, t_s: float) -> list[Sample]:
        """The samples in a frame that begins at `start` and has passed its CRC.

        Raises:
            RejectedError: a value is not finite or out of range, or there is nothing of use in it.
        """
        values = self.payload.unpack_from(frame, start + self.payload_offset)
        samples: list[Sample] = []
        if self.imu is not None:
            gyro, accel = self.imu
            gyro_rad_s: Vector = values[gyro : gyro + 3]
            accel_m_s2: Vector = values[accel : accel + 3]
            temperature_degc = None if self.temperature is None else values[self.temperature]
            check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
            t_device_s = None if self.time_startup is None else values[self.time_startup] / 1e9
            samples.append(ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, None, t_device_s))
        if self.attitude is not None:
            yaw_deg, pitch_deg, roll_deg = values[self.attitude : self.attitude + 3]
            check_attitude(yaw_deg, pitch_deg, roll_deg)
            samples.append(AttitudeSample(t_s, yaw_deg, pitch_deg, roll_deg))
        if self.mag is not None:
            field_gauss: Vector = values[self.mag : self.mag + 3]
            check_vector(field_gauss)
            samples.append(MagSample(t_s, field_gauss))
        if not samples:
            raise RejectedError(NOTHING_OF_USE)
        return samples


def layout_of(header: bytes) -> Layout:
    """Read a whole header.

    Raises:
        RejectedError: a field that is not known here, or a group without fields.
    """
    places: dict[str, int] = {}
    code, count = "<", 0
    masks = iter(struct.unpack_from(f"<{len(header) // 2 - 1}H", header, 2))
    for group, fields in _GROUPS.items():
        if not header[1] & group:
            continue
        mask = next(masks)
        if mask == 0 or mask >> len(fields):
            raise RejectedError(UNKNOWN_FIELD)
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
        attitude=places.get("yaw_pitch_roll_deg"),
        mag=_first(places, _MAGS),
    )


def _first(places: dict[str, int], names: tuple[str, ...]) -> int | None:
    return next((places[name] for name in names if name in places), None)


def _pair(places: dict[str, int]) -> tuple[int, int] | None:
    """Where rate and acceleration stand: both compensated, else both uncompensated, else whatever there is."""
    for kind in (slice(0, 2), slice(2, 4), slice(0, 4)):
        gyro, accel = _first(places, _RATES[kind]), _first(places, _ACCELERATIONS[kind])
        if gyro is not None and accel is not None:
            return gyro, accel
    return None
