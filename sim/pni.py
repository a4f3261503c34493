"""A PNI TRAX: a tilt-compensated compass that answers binary frames (PNI TRAX manual r06, p. 36-50)."""

from __future__ import annotations

import binascii
import math
import struct
from typing import Final

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import SerialDevice
from sim.earth import Array, mounting_matrix

LONGEST_COMMAND: Final = 64
FACTORY_COMPONENTS: Final = (5, 79)
"""Heading and its status. What a device really comes with is not documented."""


def packet(frame_id: int, payload: bytes = b"") -> bytes:
    """Byte count, frame id, payload, CRC-16/XMODEM."""
    head = (len(payload) + 5).to_bytes(2, "big") + bytes([frame_id]) + payload
    return head + binascii.crc_hqx(head, 0).to_bytes(2, "big")


class PniCompass(SerialDevice):
    """Heading (magnetic), pitch nose up and roll right side down, from accelerometers and so fooled by acceleration.

    It comes in poll mode: kGetData is answered with the components that kSetDataComponents has chosen, which a new
    power-on forgets unless kSave has come. kStartContinuousMode and kStopContinuousMode are obeyed.
    """

    protocol = "pni"
    baud = 38400
    default_rate_hz = 10.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        tilt_error_deg: tuple[float, float] = (0.0, 0.0),
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        continuous: bool = False,
        big_endian: bool = True,
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(aircraft, rate_hz=rate_hz, clock_ppm=clock_ppm)
        self.heading_error_deg, self.heading_noise_deg, self.tilt_error_deg = (
            heading_error_deg,
            heading_noise_deg,
            tilt_error_deg,
        )
        self.continuous, self.big_endian = continuous, big_endian
        self.distorted = False
        self.calibrated = True
        self.saves = 0
        """How often it has been told to write to its non-volatile memory."""
        self.components: tuple[int, ...] = FACTORY_COMPONENTS
        self._saved: tuple[int, ...] = FACTORY_COMPONENTS
        self.streaming = continuous
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = np.random.default_rng([seed, 21])
        self._pending = b""

    def power_on(self, t_s: float) -> bytes:
        """What was not saved is forgotten."""
        said = super().power_on(t_s)
        self.streaming, self.components, self._pending = self.continuous, self._saved, b""
        return said

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        """One kGetDataResp a sample."""
        return [self.reading(float(time)) for time in times_s]

    def reading(self, t_s: float) -> bytes:
        """The answer to kGetData."""
        known = self._values(t_s)
        data = bytes([len(self.components)])
        for component in self.components:
            value = known[component]
            data += bytes([component])
            data += bytes([value]) if isinstance(value, int) else struct.pack(">f" if self.big_endian else "<f", value)
        return packet(5, data)

    def _values(self, t_s: float) -> dict[int, float | int]:
        site = self.aircraft.site
        _, _, true_heading = self.aircraft.mounted_angles_rad(t_s, self._mounting)
        heading = math.degrees(true_heading) - site.declination_deg + self.heading_error_deg
        heading += self.heading_noise_deg * float(self._random.standard_normal())
        x, y, z = (self._mounting.T @ self.aircraft.truth_at(t_s).force_m_s2).tolist()
        declination = math.radians(site.declination_deg)
        ned_ut = np.array([28.0 * math.cos(declination), 28.0 * math.sin(declination), 45.0])
        field = (self._mounting.T @ self.aircraft.body_from_ned(t_s) @ ned_ut).tolist()
        return {
            5: round(heading % 360.0, 2) % 360.0,
            7: self.aircraft.temperature_degc(t_s),
            8: int(self.distorted),
            9: int(self.calibrated),
            **dict(zip((21, 22, 23), (x / 9.80665, y / 9.80665, z / 9.80665), strict=True)),
            24: math.degrees(math.atan2(x, math.hypot(y, z))) + self.tilt_error_deg[0],
            25: math.degrees(math.atan2(-y, -z)) + self.tilt_error_deg[1],
            **dict(zip((27, 28, 29), field, strict=True)),
            79: 1,
        }

    def command(self, data: bytes, t_s: float) -> bytes:
        """Frames with a right CRC are obeyed; everything else is passed over byte by byte."""
        answer = b""
        self._pending += data
        while len(self._pending) >= 2:
            size = int.from_bytes(self._pending[:2], "big")
            if 5 <= size <= LONGEST_COMMAND:
                if len(self._pending) < size:
                    break
                body, crc = self._pending[: size - 2], self._pending[size - 2 : size]
                if binascii.crc_hqx(body, 0) == int.from_bytes(crc, "big"):
                    self._pending = self._pending[size:]
                    answer += self._obey(body[2], body[3:], t_s)
                    continue
            self._pending = self._pending[1:]
        return answer

    def _obey(self, frame_id: int, payload: bytes, t_s: float) -> bytes:
        if frame_id == 1:
            return packet(2, b"TRAX1208")
        if frame_id == 3 and payload and len(payload) == 1 + payload[0]:
            chosen = tuple(payload[1:])
            if set(chosen) <= set(self._values(t_s)):
                self.components = chosen
        elif frame_id == 4 and not self.streaming:
            return self.reading(t_s)
        elif frame_id == 9:
            self.saves += 1
            self._saved = self.components
            return packet(16, b"\0\0")
        elif frame_id in (21, 22):
            self.streaming = frame_id == 21
        return b""
