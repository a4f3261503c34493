r"""Text line of this project for an IMU on a microcontroller; defined in docs/imu_line.md.

    $IMU,<seq>,<t_us>,<gx>,<gy>,<gz>,<ax>,<ay>,<az>,<T>*hh\r\n

`seq` counts samples modulo 2^16. `t_us` is the board's clock in microseconds modulo 2^32. Rates are in rad/s, specific
force in m/s^2, `T` in degrees Celsius or empty. `hh` is the exclusive or of everything between "$" and "*".
"""

from __future__ import annotations

from typing import ClassVar

from companion.protocols.decoding.base import RejectedError, SentenceDecoder, check_imu
from companion.samples import ImuSample, Sample


class ImuLineDecoder(SentenceDecoder):
    """Decoder of `$IMU` lines into `ImuSample`; the longest sensible line has some 110 bytes."""

    device_clock_wraps_s: ClassVar[float | None] = 2**32 / 1e6
    sequence_modulus: ClassVar[int | None] = 2**16

    def _read(self, body: bytes, t_s: float) -> list[Sample]:
        if not body.startswith(b"IMU,"):
            raise RejectedError("unknown sentence")
        fields = body.split(b",")
        if len(fields) != 10:
            raise RejectedError("field count")
        sequence, t_us, (gx, gy, gz, ax, ay, az) = int(fields[1]), int(fields[2]), map(float, fields[3:9])
        temperature_degc = float(fields[9]) if fields[9] else None
        if not (0 <= sequence <= 0xFFFF and 0 <= t_us <= 0xFFFFFFFF):
            raise RejectedError("out of range")
        gyro_rad_s, accel_m_s2 = (gx, gy, gz), (ax, ay, az)
        check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, sequence, t_us / 1e6)]
