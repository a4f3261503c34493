"""Compasses besides the HMR3300: other NMEA 0183 devices, OceanServer's OS5000, RION's HCM370B, PNI's TRAX."""

from __future__ import annotations

import binascii
import re
import struct
from functools import reduce
from operator import xor
from typing import Any, Final, Literal

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import Compass, Frame, Gradienter, Magnetic, nmea

Sentence = Literal["HPR", "HDT"]
_COMMAND_LIMIT: Final = 64


class FluidCompass(Magnetic, Gradienter):
    """A compass with the tilt of a fluid gradienter: lag, offset and noise are parameters of `Gradienter`."""

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        noise_deg: float = 0.02,
        **more: Any,
    ) -> None:
        super().__init__(aircraft, seed=seed, noise_deg=noise_deg, **more)
        self.heading_error_deg, self.heading_noise_deg = heading_error_deg, heading_noise_deg
        self._heading_random = np.random.default_rng([seed, 15])
        self._pending = b""


class NmeaCompass(FluidCompass):
    """HMR3000 (Honeywell 900240): HPR, and HDT as other makers' compasses send it.

    From the factory, the compass has no sentence enabled. Questions such as `$PTNT,HPR*78` request one sentence. Tilt
    is the elevation of the board's axes (p. 15).
    """

    protocol = "nmea"
    baud = 19200
    default_rate_hz = 13.75

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        sentences: tuple[Sentence, ...] = ("HPR",),
        lag_s: float = 0.288,
        **more: Any,
    ) -> None:
        super().__init__(aircraft, lag_s=lag_s, **more)
        self.sentences = sentences

    def _lines(self, t_s: float) -> bytes:
        return b"".join(nmea(self._body(name, t_s)) for name in self.sentences)

    def _body(self, name: Sentence, t_s: float) -> str:
        roll, pitch = self.reading_deg(t_s)
        magnetic = self.magnetic_deg(t_s)
        if name == "HDT":
            return f"HCHDT,{_circle(magnetic + self.aircraft.site.declination_deg)},T"
        return f"PTNTHPR,{_circle(magnetic)},N,{pitch:.1f},N,{roll:.1f},N"

    def command(self, data: bytes, t_s: float) -> bytes:
        """Answer each valid question with its sentence; skip everything else."""
        answer = b""
        self._pending += data
        while b"\n" in self._pending:
            line, _, self._pending = self._pending.partition(b"\n")
            match = re.fullmatch(rb"\$((?:PTNT|TNHCQ),(HPR|HDT))\*([0-9A-F]{2})\r", line)
            if match and reduce(xor, match[1], 0) == int(match[3], 16):
                answer += nmea(self._body("HPR" if match[2] == b"HPR" else "HDT", t_s))
        self._pending = self._pending[-_COMMAND_LIMIT:]
        return answer

    def frames_until(self, t_s: float) -> list[Frame]:
        self.streaming = bool(self.sentences)
        return super().frames_until(t_s)


class Os5000(FluidCompass):
    """OceanServer OS5000: `$C` sentences (user's guide, format type 0x01).

    `<esc>R` and a number set the output rate, 0 stops the output. The tilt comes from accelerometers.
    """

    protocol = "os5000"
    baud = 19200
    default_rate_hz = 10.0

    def __init__(self, aircraft: VirtualAircraft, **more: Any) -> None:
        super().__init__(aircraft, law="euler", lag_s=0.0, **more)

    def _lines(self, t_s: float) -> bytes:
        roll, pitch = self.reading_deg(t_s)
        temperature = self.aircraft.temperature_degc(t_s)
        return nmea(f"C{_circle(self.magnetic_deg(t_s))}P{pitch:.1f}R{roll:.1f}T{temperature:.1f}")

    def command(self, data: bytes, t_s: float) -> bytes:
        """Obey `<esc>R<number><space>`; skip the other settings."""
        self._pending += data
        while match := re.search(rb"\x1b([A-Z*])(-?\d{1,6}) ", self._pending):
            self._pending = self._pending[match.end() :]
            if match[1] == b"R":
                self.streaming = match[2] != b"0"
        self._pending = self._pending[-_COMMAND_LIMIT:]
        return b""


def _circle(angle_deg: float) -> str:
    return f"{round(angle_deg * 10.0) % 3600 / 10.0:.1f}"


# ------------------------------------------------------------------------------------------------- RION


def rion_packet(command: int, data: bytes = b"") -> bytes:
    """Return a packet: 0x68, length, address 0, command, data, and the sum of all bytes but the first."""
    body = bytes([len(data) + 4, 0, command]) + data
    return b"\x68" + body + bytes([sum(body) % 256])


def rion_decimal(angle_deg: float, digits: int, decimals: int) -> bytes:
    """Encode an angle with two decimal digits per byte; the first digit is the sign."""
    text = f"{round(abs(angle_deg) * 10**decimals):0{digits - 1}d}"
    return bytes.fromhex(("1" if angle_deg < 0.0 and int(text) else "0") + text)


class RionCommands:
    """Collects the commands that a RION device obeys: read (04) and output mode (0C), to address 00 or FF."""

    LONGEST: Final = 16

    def __init__(self) -> None:
        self._pending = b""

    def take(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the complete commands received so far."""
        commands = []
        self._pending += data
        while len(self._pending) >= 2:
            size = self._pending[1] + 1
            if self._pending[0] == 0x68 and 5 <= size <= self.LONGEST:
                if len(self._pending) < size:
                    break
                frame = self._pending[:size]
                if sum(frame[1:-1]) % 256 == frame[-1] and frame[2] in (0x00, 0xFF):
                    commands.append((frame[3], frame[4:-1]))
                    self._pending = self._pending[size:]
                    continue
            self._pending = self._pending[1:]
        return commands


class RionCompass(Compass):
    """HCM370B: pitch nose up, roll right side down, heading (magnetic), to a hundredth of a degree; 9600 8N1.

    The factory mode only answers requests; 0C 01 starts automatic output, also after a power-off (HCM370B and HCM705B
    manuals).
    """

    protocol = "rion"
    baud = 9600
    default_rate_hz = 5.0
    STREAM = 22

    def __init__(self, aircraft: VirtualAircraft, *, automatic: bool = False, **more: Any) -> None:
        super().__init__(aircraft, **more)
        self.streaming = self.automatic = automatic
        self._commands = RionCommands()

    def power_on(self, t_s: float) -> bytes:
        """Start in the mode that was last set."""
        said = super().power_on(t_s)
        self.streaming = self.automatic
        return said

    def reading(self, t_s: float) -> bytes:
        pitch, roll = self.tilt_deg(t_s)
        hundredths = round(self.magnetic_deg(t_s) * 100.0) % 36000
        angles = (pitch, roll, hundredths / 100.0)
        return rion_packet(0x84, b"".join(rion_decimal(angle, 6, 2) for angle in angles))

    def command(self, data: bytes, t_s: float) -> bytes:
        answer = b""
        for command, argument in self._commands.take(data):
            if command == 0x04:
                answer += self.reading(t_s)
            elif command == 0x0C and argument in (b"\0", b"\1"):
                self.streaming = self.automatic = argument == b"\1"
                answer += rion_packet(0x8C, b"\0")
        return answer


# -------------------------------------------------------------------------------------------------- PNI


def pni_packet(frame_id: int, payload: bytes = b"") -> bytes:
    """Return a packet: byte count, frame id, payload, CRC-16/XMODEM."""
    head = (len(payload) + 5).to_bytes(2, "big") + bytes([frame_id]) + payload
    return head + binascii.crc_hqx(head, 0).to_bytes(2, "big")


class PniCompass(Compass):
    """PNI TRAX: heading (magnetic), pitch nose up and roll right side down (PNI TRAX manual r06, p. 36-50).

    The factory mode is poll mode: the answer to kGetData has the components that kSetDataComponents has chosen. A
    power-off without kSave deletes this choice. kStartContinuousMode and kStopContinuousMode are obeyed.
    """

    protocol = "pni"
    baud = 38400
    default_rate_hz = 10.0
    STREAM = 21
    FACTORY_COMPONENTS: Final = (5, 79)
    """Component ids of the factory setting: heading and its status. The real factory setting is not documented."""

    def __init__(self, aircraft: VirtualAircraft, *, continuous: bool = False, **more: Any) -> None:
        super().__init__(aircraft, **more)
        self.streaming = self.continuous = continuous
        self.saves = 0
        self.components: tuple[int, ...] = self.FACTORY_COMPONENTS
        self._saved: tuple[int, ...] = self.FACTORY_COMPONENTS

    def power_on(self, t_s: float) -> bytes:
        """Forget settings that were not saved."""
        said = super().power_on(t_s)
        self.streaming, self.components, self._pending = self.continuous, self._saved, b""
        return said

    def reading(self, t_s: float) -> bytes:
        known = self._values(t_s)
        data = bytes([len(self.components)])
        for component in self.components:
            value = known[component]
            data += bytes([component]) + (bytes([value]) if isinstance(value, int) else struct.pack(">f", value))
        return pni_packet(5, data)

    def _values(self, t_s: float) -> dict[int, float | int]:
        heading = self.magnetic_deg(t_s)
        pitch, roll = self.tilt_deg(t_s)
        g = (self._mounting.T @ self.aircraft.truth_at(t_s).force_m_s2 / 9.80665).tolist()
        field_ut = (self.field_gauss(t_s) * 100.0).tolist()
        return {
            5: round(heading % 360.0, 2) % 360.0,
            7: self.aircraft.temperature_degc(t_s),
            8: 0,  # distorted
            9: 1,  # calibrated
            **dict(zip((21, 22, 23), g, strict=True)),
            24: pitch,
            25: roll,
            **dict(zip((27, 28, 29), field_ut, strict=True)),
            79: 1,
        }

    def command(self, data: bytes, t_s: float) -> bytes:
        """Obey frames with a correct CRC; skip everything else byte by byte."""
        answer = b""
        self._pending += data
        while len(self._pending) >= 2:
            size = int.from_bytes(self._pending[:2], "big")
            if 5 <= size <= _COMMAND_LIMIT:
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
            return pni_packet(2, b"TRAX1208")
        if frame_id == 3 and payload and len(payload) == 1 + payload[0]:
            if set(payload[1:]) <= set(self._values(t_s)):
                self.components = tuple(payload[1:])
        elif frame_id == 4 and not self.streaming:
            return self.reading(t_s)
        elif frame_id == 9:
            self.saves += 1
            self._saved = self.components
            return pni_packet(16, b"\0\0")
        elif frame_id in (21, 22):
            self.streaming = frame_id == 21
        return b""
