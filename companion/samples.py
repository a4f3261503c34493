"""Sensor samples: one frozen structure per kind of sensor, with units in the field names.

`t_s` is the sampling time in seconds on the host's monotonic clock (the event loop's `time()`). It is computed from the
device's clock. Without a device clock, it is the time of the read, minus the transmission time on the serial line of
the frame and of the bytes after it (`protocols.decoding.clock`).
Vectors are in the sensor's own axes until the `mounting` has rotated them to the vehicle's axes (FRD).
"""

from __future__ import annotations

from typing import Final, Literal

import msgspec

Vector = tuple[float, float, float]
Triad = Literal["gyro", "accel"]
TRIADS: Final[tuple[Triad, Triad]] = ("gyro", "accel")


def rows_of(triad: Triad) -> slice:
    return slice(0, 3) if triad == "gyro" else slice(3, 6)


class ImuSample(msgspec.Struct, frozen=True, gc=False):
    """Angular rate and specific force of one IMU at one instant.

    An accelerometer measures the specific force: (0, 0, -9.8) m/s^2 in FRD if it is horizontal and at rest.
    """

    t_s: float
    gyro_rad_s: Vector
    accel_m_s2: Vector
    temperature_degc: float | None = None
    sequence: int | None = None
    """Sample counter of the device, continued at wrap-around (`Decoder.receive`); None: the protocol has no counter."""
    t_device_s: float | None = None
    """Time on the device's clock, continued at wrap-around (`Decoder.receive`); None: the protocol has no clock."""
    breaks: int = 0
    """Number of restarts and clock jumps of the device before this sample; each can have changed the biases."""
    shared_variance: tuple[float, ...] | None = None
    """Variance of an error common to neighbouring samples: gyro x, y, z, accelerometer x, y, z; None: no such error."""


class TiltSample(msgspec.Struct, frozen=True, gc=False):
    """Both tilt readings of a gradienter, in its own axes; `physics.gradienter` defines the meaning of the angles."""

    t_s: float
    x_deg: float
    y_deg: float
    temperature_degc: float | None = None


class CompassSample(msgspec.Struct, frozen=True, gc=False):
    """Heading of a compass in degrees clockwise from north, in [0, 360)."""

    t_s: float
    heading_deg: float
    pitch_deg: float | None = None
    roll_deg: float | None = None
    north: Literal["magnetic", "true"] | None = None
    """Kind of north to which the heading refers; None: the device does not report it, the configuration defines it."""
    temperature_degc: float | None = None


class MagSample(msgspec.Struct, frozen=True, gc=False):
    """Magnetic field vector in the device's axes; `counts` replaces `field_gauss` if the device reports no unit."""

    t_s: float
    field_gauss: Vector | None = None
    counts: tuple[int, int, int] | None = None


Sample = ImuSample | TiltSample | CompassSample | MagSample
