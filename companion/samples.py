"""Sensor samples: one frozen structure per kind of sensor, with units in the field names.

`t_s` is the sampling time on the host's monotonic clock (the event loop's `time()`), in seconds. It comes from the
device's clock. Without one, it is the time of the read, minus the line time of the frame and of the bytes after it
(`protocols.decoding.clock`).
Vectors are in the sensor's own axes until a `mounting` has turned them into the vehicle's FRD.
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

    Specific force is what an accelerometer measures: (0, 0, -9.8) m/s^2 in FRD when level at rest.
    """

    t_s: float
    gyro_rad_s: Vector
    accel_m_s2: Vector
    temperature_degc: float | None = None
    sequence: int | None = None
    """The device's own counter, None where the protocol has none; unwrapped by `Decoder.receive`."""
    t_device_s: float | None = None
    """The device's own clock, None where the protocol has none; unwrapped by `Decoder.receive`."""
    breaks: int = 0
    """Number of restarts and clock jumps of the device so far; each may have changed its biases."""
    shared_variance: tuple[float, ...] | None = None
    """Variance (6,) of an error common to neighbouring samples, gyro then accelerometer; None: no such error."""


class TiltSample(msgspec.Struct, frozen=True, gc=False):
    """Both readings of a gradienter, in its own axes and by its own law (`physics.gradienter`)."""

    t_s: float
    x_deg: float
    y_deg: float
    temperature_degc: float | None = None


class CompassSample(msgspec.Struct, frozen=True, gc=False):
    """A heading, clockwise from north, in [0, 360)."""

    t_s: float
    heading_deg: float
    pitch_deg: float | None = None
    roll_deg: float | None = None
    north: Literal["magnetic", "true"] | None = None
    """North that the device reports; None: the configuration gives it."""
    temperature_degc: float | None = None


class MagSample(msgspec.Struct, frozen=True, gc=False):
    """A magnetic field vector in the device's axes; `counts` where the device gives no unit."""

    t_s: float
    field_gauss: Vector | None = None
    counts: tuple[int, int, int] | None = None


Sample = ImuSample | TiltSample | CompassSample | MagSample
