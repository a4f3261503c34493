"""Serial devices of the virtual aircraft: the quantities that they measure and the bytes that they send.

A device knows no port and no loop: `frames_until(t_s)` gives every frame that is complete by an aircraft time, so that
a test can have minutes of traffic at once; `sim.pty_device` serves the same frames on a pty in real time.
Formats: the vendors' documents named at each class.
"""

from __future__ import annotations

import binascii
import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import xor
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.earth import Array, mounting_matrix
from sim.imu_model import ImuModel

Law = Literal["axis", "slope", "euler"]
_COMMAND_LIMIT = 64
"""Maximum length of an unfinished command in bytes; a longer one is dropped."""


class Frame(NamedTuple):
    """One transmission of a device; times in aircraft seconds."""

    sampled_s: float
    """Time at which the quantity was sampled."""
    complete_s: float
    """Time at which the last bit has left the device."""
    data: bytes


def nmea(body: str) -> bytes:
    """Return the sentence `$body*hh` with the XOR of the body, and CR LF."""
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n".encode()


class SerialDevice(ABC):
    """A device that sends a frame every 1/rate seconds.

    Args:
        rate_hz: frames per second; None: the device's own rate.
        clock_ppm: excess speed of the device's clock over the aircraft's.
    """

    protocol: str
    """Name of the protocol in the companion's configuration."""
    baud: int
    bits_per_byte = 10
    default_rate_hz: float

    def __init__(self, aircraft: VirtualAircraft, *, rate_hz: float | None = None, clock_ppm: float = 0.0) -> None:
        self.aircraft = aircraft
        self.rate_hz = self.default_rate_hz if rate_hz is None else rate_hz
        self.clock_ppm = clock_ppm
        self.streaming = True
        self._period_s = 1.0 / (self.rate_hz * (1.0 + clock_ppm * 1e-6))
        self._start_s = 0.0
        self._next = 0

    def power_on(self, t_s: float) -> bytes:
        """Start the device at this time; return its first output (often nothing)."""
        self._start_s, self._next = t_s, 0
        self.streaming = True
        return self.banner()

    def banner(self) -> bytes:
        """Return the output at power-on."""
        return b""

    @property
    def next_sample_s(self) -> float:
        return self._start_s + self._next * self._period_s

    def line_time_s(self, size: int) -> float:
        """Return the transmission time of so many bytes."""
        return size * self.bits_per_byte / self.baud

    def frames_until(self, t_s: float) -> list[Frame]:
        """Return all frames sampled up to and including this time that were not returned before."""
        count = math.floor((t_s - self._start_s) / self._period_s + 1e-6) + 1 - self._next
        if count <= 0:
            return []
        times: Array = self._start_s + np.arange(self._next, self._next + count, dtype=np.float64) * self._period_s
        self._next += count
        encoded = self.encode(times, self._next - count)
        if not self.streaming:
            return []
        return [
            Frame(time, time + self.line_time_s(len(data)), data)
            for time, data in zip(times.tolist(), encoded, strict=True)
        ]

    @abstractmethod
    def encode(self, times_s: Array, first: int) -> Sequence[bytes]:
        """Encode the frames of samples at these times; `first` is the number of the first since power-on."""

    def command(self, data: bytes, t_s: float) -> bytes:
        """Handle bytes sent to the device and return its answer. Unknown commands are ignored."""
        return b""


COUNTS_PER_GAUSS = 4000.0
"""Scale of the virtual HMR3300's magnetometer lines; the data sheet gives their counts no unit."""


class Magnetic:
    """Magnetic heading and field of a mounted device; a mixin for device classes."""

    aircraft: VirtualAircraft
    _mounting: Array
    heading_error_deg: float
    heading_noise_deg: float
    _heading_random: np.random.Generator

    def magnetic_deg(self, t_s: float) -> float:
        """Return the magnetic heading with error and noise, not wrapped."""
        _, _, heading = self.aircraft.mounted_angles_rad(t_s, self._mounting)
        noise = self.heading_noise_deg * float(self._heading_random.standard_normal())
        return math.degrees(heading - self.aircraft.declination_rad(t_s)) + self.heading_error_deg + noise

    def field_gauss(self, t_s: float) -> Array:
        """Return the magnetic field in the device's axes: forward, right, down."""
        field: Array = self._mounting.T @ self.aircraft.field_gauss(t_s)
        return field


class Compass(Magnetic, SerialDevice):
    """A compass that takes its tilt from accelerometers, so that every acceleration disturbs it.

    Args:
        aircraft: the truth.
        seed: seed of the noise.
        heading_error_deg, heading_noise_deg: constant error, and one sigma of the noise of a reading.
        mounting_deg: roll, pitch, yaw of the device's axes relative to the vehicle's.
        line: arguments of `SerialDevice`.
    """

    STREAM: ClassVar[int]
    """Number of the device's stream of random numbers."""

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **line: Any,
    ) -> None:
        super().__init__(aircraft, **line)
        self.heading_error_deg, self.heading_noise_deg = heading_error_deg, heading_noise_deg
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = self._heading_random = np.random.default_rng([seed, self.STREAM])
        self._pending = b""

    def tilt_deg(self, t_s: float) -> tuple[float, float]:
        """Return pitch (nose up) and roll (right side down) from the accelerometers."""
        x, y, z = (self._mounting.T @ self.aircraft.truth_at(t_s).force_m_s2).tolist()
        return math.degrees(math.atan2(x, math.hypot(y, z))), math.degrees(math.atan2(-y, -z))

    @abstractmethod
    def reading(self, t_s: float) -> bytes:
        """Return one reading as the device sends it."""

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [self.reading(float(time)) for time in times_s]


class HMR3300(Compass):
    """Honeywell HMR3300 magnetic compass: `123.4, 18.6, -0.5` CR LF at 8 Hz, 19200 8N1 (Honeywell data sheet).

    `*S` toggles the stream, `*Q` asks for one line while stopped, `*H` and `*M` choose heading or magnetometer lines.
    """

    protocol = "hmr3300"
    baud = 19200
    default_rate_hz = 8.0
    STREAM = 5

    def __init__(self, aircraft: VirtualAircraft, **more: Any) -> None:
        super().__init__(aircraft, **more)
        self.field_noise_gauss = 0.0003
        self.magnetometer_mode = False

    def banner(self) -> bytes:
        """Send model and firmware; the real device's exact words are not documented."""
        return b"HMR3300 V1.00\r\n"

    def reading(self, t_s: float) -> bytes:
        if self.magnetometer_mode:
            field = self.field_gauss(t_s) + self.field_noise_gauss * self._random.standard_normal(3)
            counts = field * COUNTS_PER_GAUSS
            return ", ".join(str(round(float(count))) for count in counts).encode() + b"\r\n"
        tenths = round(self.magnetic_deg(t_s) * 10.0) % 3600
        pitch, roll = self.tilt_deg(t_s)
        return f"{tenths / 10.0:.1f}, {_tidy(pitch, 1)}, {_tidy(roll, 1)}\r\n".encode()

    def command(self, data: bytes, t_s: float) -> bytes:
        """Handle commands ending with CR or LF; unknown ones are answered `#I`."""
        answer = b""
        self._pending += data
        while True:
            ends = [at for at in (self._pending.find(b"\r"), self._pending.find(b"\n")) if at >= 0]
            if not ends:
                self._pending = self._pending[-_COMMAND_LIMIT:]
                return answer
            command, self._pending = self._pending[: min(ends)].strip().upper(), self._pending[min(ends) + 1 :]
            if command == b"*S":
                self.streaming = not self.streaming
            elif command == b"*Q":
                answer += b"" if self.streaming else self.reading(t_s)
            elif command in (b"*H", b"*M"):
                self.magnetometer_mode = command == b"*M"
            elif command:
                answer += b"#I\r\n"


def _tidy(value: float, digits: int) -> str:
    """Format a decimal number; write zero without a minus sign."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


class Gradienter(SerialDevice):
    """Two-axis fluid tilt sensor, `X=+00.430` CR LF `Y=-00.084` CR LF at 10 Hz (MEAS DPG2 and BEI INC manuals).

    x: right side down +, y: nose up +, by one of three laws of the apparent gravity in the sensor's own axes
    (forward, right, down): "axis": elevation of each axis; "slope": slope of the liquid, atan of a ratio of components;
    "euler": roll and pitch themselves. The fluid follows with a first-order lag of 0.43 s, and like every pendulum it
    shows acceleration as tilt. Beyond the range, signs replace the digits.
    """

    protocol = "inclinometer_xy"
    baud = 9600
    default_rate_hz = 10.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        law: Law = "axis",
        offset_deg: tuple[float, float] = (0.0, 0.0),
        noise_deg: float = 0.0005,
        lag_s: float = 0.43,
        range_deg: float = 30.0,
        resolution_deg: float = 0.001,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        **line: Any,
    ) -> None:
        super().__init__(aircraft, **line)
        self.law, self.offset_deg, self.noise_deg, self.lag_s = law, offset_deg, noise_deg, lag_s
        self.range_deg, self.resolution_deg = range_deg, resolution_deg
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = np.random.default_rng([seed, 6])
        self._fluid: tuple[float, Array] | None = None

    def tilt_deg(self, t_s: Array) -> Array:
        """Return the tilt x and y (n, 2) by the law, for the apparent gravity at times (n), without lag and errors."""
        gravity = -(self.aircraft.truth(t_s).force_m_s2 @ self._mounting)
        forward, right, down = (gravity / np.linalg.norm(gravity, axis=1, keepdims=True)).T
        if self.law == "axis":
            x, y = np.arcsin(right), np.arcsin(-forward)
        elif self.law == "slope":
            x, y = np.arctan2(right, down), np.arctan2(-forward, down)
        else:
            x, y = np.arctan2(right, down), np.arcsin(-forward)
        degrees: Array = np.degrees(np.column_stack([x, y]))
        return degrees

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [self._lines(float(time)) for time in times_s]

    def _lines(self, t_s: float) -> bytes:
        x, y = self.reading_deg(t_s)
        return self._line("X", x) + self._line("Y", y)

    def reading_deg(self, t_s: float) -> tuple[float, float]:
        """Return the reading x, y with lag, offset and noise."""
        noise = self.noise_deg * self._random.standard_normal(2)
        x, y = self._settle(t_s) + np.asarray(self.offset_deg) + noise
        return float(x), float(y)

    def _line(self, axis: str, value_deg: float) -> bytes:
        if abs(value_deg) > self.range_deg:
            return f"{axis}={'+' * 7 if value_deg > 0 else '-' * 7}\r\n".encode()
        value = round(value_deg / self.resolution_deg) * self.resolution_deg
        return f"{axis}={value + 0.0 if abs(value) >= 0.0005 else 0.0:+07.3f}\r\n".encode()

    def _settle(self, t_s: float) -> Array:
        """Integrate the fluid's lag: exact for a tilt that is constant between steps of 10 ms."""
        if self._fluid is None:
            self._fluid = (t_s, self.tilt_deg(np.array([t_s]))[0])
        since_s, reading = self._fluid
        span = t_s - since_s
        if span > 0.0:
            aircraft = self.aircraft
            quiet = aircraft.still_at(since_s) and aircraft.still_at(t_s)
            count = 1 if quiet else max(1, min(1000, math.ceil(span / 0.01)))
            times = since_s + span * np.arange(1, count + 1) / count
            keep = math.exp(-span / count / self.lag_s) if self.lag_s > 0.0 else 0.0
            for tilt in self.tilt_deg(times):
                reading = tilt + keep * (reading - tilt)
            self._fluid = (t_s, reading)
        return reading

    def command(self, data: bytes, t_s: float) -> bytes:
        """Handle single characters (MEAS): `s` stop, `S` start, `R` one reading while stopped, `V` version."""
        answer = b""
        for character in data[:_COMMAND_LIMIT]:
            if character == ord("s"):
                self.streaming = False
                answer += b"s"
            elif character == ord("S"):
                self.streaming = True
            elif character == ord("R") and not self.streaming:
                answer += self._lines(t_s)
            elif character == ord("V"):
                answer += b"DPL2 V1.8.0\r\n"
        return answer


class ImuDevice(SerialDevice):
    """A serial IMU: 200 readings a second of one model."""

    default_rate_hz = 200.0

    def __init__(self, imu: ImuModel, **line: Any) -> None:
        super().__init__(imu.aircraft, **line)
        self.imu = imu

    def _readings(self, times_s: Array, first: int) -> Iterator[tuple[float, float, list[float]]]:
        """Yield aircraft time, device time since power-on, and six numbers of each sample."""
        readings = self.imu.read(times_s, self._period_s).tolist()
        for number, (time, reading) in enumerate(zip(times_s.tolist(), readings, strict=True), first):
            yield time, number / self.rate_hz, reading


class VectorNavBinary(ImuDevice):
    """VectorNav VN-100 binary output, groups 05, masks 0121 and 0010 (VectorNav UM001).

    TimeStartup (u64, ns), AngularRate (3 f32, rad/s), Accel (3 f32, m/s^2), Temperature (f32, degC); CRC-16/XMODEM,
    big-endian, over everything after the sync byte FA. 44 bytes, 88 kbit/s at 200 Hz.
    """

    protocol = "vectornav"
    baud = 115200

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [
            vectornav_packet(device_s, reading, self.imu.temperature_degc(time))
            for time, device_s, reading in self._readings(times_s, first)
        ]


def vectornav_packet(startup_s: float, reading: Sequence[float], temperature_degc: float) -> bytes:
    body = struct.pack("<BHHQ7f", 0x05, 0x0121, 0x0010, round(startup_s * 1e9), *reading, temperature_degc)
    return b"\xfa" + body + struct.pack(">H", binascii.crc_hqx(body, 0))


class ImuLine(ImuDevice):
    """The project's own line for home-made IMUs: `$IMU,seq,t_us,gx,gy,gz,ax,ay,az,T*hh` in rad/s, m/s^2 and degC.

    `seq` is 16 bits, `t_us` 32 bits since power-on; both wrap. About 82 bytes, 164 kbit/s at 200 Hz.
    """

    protocol = "imu_line"
    baud = 230400

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        lines = []
        for number, (time, device_s, reading) in enumerate(self._readings(times_s, first), first):
            rate = ",".join(f"{value:.7f}" for value in reading[:3])
            force = ",".join(f"{value:.5f}" for value in reading[3:])
            stamp = round(device_s * 1e6) % 2**32
            lines.append(
                nmea(f"IMU,{number % 65536},{stamp},{rate},{force},{self.imu.temperature_degc(time):.2f}")
            )  # fmt: skip
        return lines
