"""RION devices that answer 0x68 frames: a compass (HCM370B and HCM705B manuals) and an inclinometer (HCA726)."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import Gradienter, SerialDevice
from sim.earth import Array, mounting_matrix

LONGEST_COMMAND: Final = 16


def packet(command: int, data: bytes = b"", address: int = 0) -> bytes:
    """0x68, length, address, command, data, and the sum of all but the first."""
    body = bytes([len(data) + 4, address, command]) + data
    return b"\x68" + body + bytes([sum(body) % 256])


def decimal(angle_deg: float, digits: int, decimals: int) -> bytes:
    """Two digits a byte, of which the first one is the sign."""
    text = f"{round(abs(angle_deg) * 10**decimals):0{digits - 1}d}"
    return bytes.fromhex(("1" if angle_deg < 0.0 and int(text) else "0") + text)


class _Answering:
    """The commands that both obey: read (04) and output mode (0C); the address is 00, and FF is everybody's."""

    def __init__(self) -> None:
        self._pending = b""

    def take(self, data: bytes) -> list[tuple[int, bytes]]:
        """Whole commands in what has come so far."""
        commands = []
        self._pending += data
        while len(self._pending) >= 2:
            size = self._pending[1] + 1
            if self._pending[0] == 0x68 and 5 <= size <= LONGEST_COMMAND:
                if len(self._pending) < size:
                    break
                frame = self._pending[:size]
                if sum(frame[1:-1]) % 256 == frame[-1] and frame[2] in (0x00, 0xFF):
                    commands.append((frame[3], frame[4:-1]))
                    self._pending = self._pending[size:]
                    continue
            self._pending = self._pending[1:]
        return commands


class RionCompass(SerialDevice):
    """HCM370B: pitch nose up, roll right side down, heading (magnetic), to a hundredth of a degree; 9600 8N1.

    It comes in the mode in which it only answers; 0C 01 makes it speak by itself.
    """

    protocol = "rion"
    baud = 9600
    default_rate_hz = 5.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        automatic: bool = False,
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(aircraft, rate_hz=rate_hz, clock_ppm=clock_ppm)
        self.heading_error_deg, self.heading_noise_deg = heading_error_deg, heading_noise_deg
        self.streaming = self.automatic = automatic
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = np.random.default_rng([seed, 22])
        self._ears = _Answering()

    def power_on(self, t_s: float) -> bytes:
        """The output mode is remembered."""
        said = super().power_on(t_s)
        self.streaming = self.automatic
        return said

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        """One frame a sample."""
        return [self.reading(float(time)) for time in times_s]

    def reading(self, t_s: float) -> bytes:
        """The answer to 04."""
        _, _, heading = self.aircraft.mounted_angles_rad(t_s, self._mounting)
        noise = self.heading_noise_deg * float(self._random.standard_normal())
        magnetic = math.degrees(heading) - self.aircraft.site.declination_deg + self.heading_error_deg + noise
        x, y, z = (self._mounting.T @ self.aircraft.truth_at(t_s).force_m_s2).tolist()
        pitch, roll = math.degrees(math.atan2(x, math.hypot(y, z))), math.degrees(math.atan2(-y, -z))
        hundredths = round(magnetic * 100.0) % 36000
        return packet(0x84, decimal(pitch, 6, 2) + decimal(roll, 6, 2) + decimal(hundredths / 100.0, 6, 2))

    def command(self, data: bytes, t_s: float) -> bytes:
        """Answers to whole commands."""
        answer = b""
        for command, argument in self._ears.take(data):
            if command == 0x04:
                answer += self.reading(t_s)
            elif command == 0x0C and argument in (b"\0", b"\1"):
                self.streaming = self.automatic = argument == b"\1"
                answer += packet(0x8C, b"\0")
        return answer


class RionInclinometer(Gradienter):
    """HCA726: x and y to a tenth of a millidegree; MEMS, so that each axis gives its own elevation, without a fluid.

    Only answers. Three bytes after the angles are unknown; they are zero here.
    """

    protocol = "rion"
    baud = 9600

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        offset_deg: tuple[float, float] = (0.0, 0.0),
        noise_deg: float = 0.0005,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__(
            aircraft, seed=seed, offset_deg=offset_deg, noise_deg=noise_deg, lag_s=0.0, mounting_deg=mounting_deg
        )
        self.streaming = False
        self._ears = _Answering()

    def power_on(self, t_s: float) -> bytes:
        """It says nothing by itself."""
        said = super().power_on(t_s)
        self.streaming = False
        return said

    def _lines(self, t_s: float) -> bytes:
        noise = self.noise_deg * self._random.standard_normal(2)
        x, y = (self._settle(t_s) + np.asarray(self.offset_deg) + noise).tolist()
        return packet(0x84, decimal(x, 8, 4) + decimal(y, 8, 4) + bytes(3))

    def command(self, data: bytes, t_s: float) -> bytes:
        """Answers to whole commands."""
        return b"".join(self._lines(t_s) for command, _ in self._ears.take(data) if command == 0x04)
