"""Gradienters with commands of their own: Jewell's tiltmeters, BEI's, RION's and WitMotion's inclinometers.

`stored` counts writes to the EEPROM, which a reader of the device must never cause.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.binary_imus import WIT_Z_UP, wit_angles_deg, wit_packet
from sim.compasses import RionCommands, rion_decimal, rion_packet
from sim.devices import Gradienter, SerialDevice, nmea
from sim.earth import Array, mounting_matrix

_COMMAND_LIMIT: Final = 64
_STORING: Final = ("SO-", "XYC", "XY-SET", "XY-MEMS")
"""First letters of the Jewell commands whose effect outlasts a power-off."""


class Jewell(Gradienter):
    """Jewell (Applied Geomechanics) tiltmeter: SIM, XDR or ASH lines (Tuff Tilt Digital manual, p. 12 to 18)."""

    protocol = "jewell"
    baud = 9600
    default_rate_hz = 4.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        output: Literal["SIM", "XDR", "ASH"] = "SIM",
        continuous: bool = True,
        **more: Any,
    ) -> None:
        super().__init__(aircraft, range_deg=50.0, **more)
        self.output, self.continuous = output, continuous
        self.streaming = continuous
        self.stored = 0
        self._pending = b""

    def power_on(self, t_s: float) -> bytes:
        """Stay silent unless the device is set to start by itself."""
        said = super().power_on(t_s)
        self.streaming = self.continuous
        return said

    def _lines(self, t_s: float) -> bytes:
        x, y = (self._clipped(value) for value in self.reading_deg(t_s))
        temperature = f"{self.aircraft.temperature_degc(t_s):07.3f}"
        if self.output == "SIM":
            return f"${x},{y},{temperature},N0000\r\n".encode()
        body = f"A,{y},D,N,A,{x},D,E,C,{temperature},C,T-N0000"
        return nmea(f"YXXDR,{body}") if self.output == "XDR" else f"$PASHS,XDR,{body}\r\n".encode()

    def _clipped(self, value_deg: float) -> str:
        return f"{max(-self.range_deg, min(self.range_deg, value_deg)):07.3f}"

    def command(self, data: bytes, t_s: float) -> bytes:
        """Handle `*ttssCMD` with CR LF, case-sensitive; of the settings only the output format has an effect."""
        answer = b""
        self._pending += data
        while b"\n" in self._pending:
            line, _, self._pending = self._pending.partition(b"\n")
            command = line.decode(errors="replace").strip()
            if not command.startswith("*9900"):
                continue
            command = command[5:]
            self.stored += command.startswith(_STORING)
            if command == "XY":
                answer += self._lines(t_s)
            elif command in ("SO-SIM", "SO-XDR", "SO-ASH"):
                self.output = command[3:]  # type: ignore[assignment]
            elif command.startswith("SO-"):
                answer += b"ERR XY-SO BAD PARAMETER\r\n"
            elif command in ("XYC2", "XYC-OFF"):
                self.continuous = self.streaming = command == "XYC2"
        self._pending = self._pending[-_COMMAND_LIMIT:]
        return answer


class BeiInclinometer(Gradienter):
    """BEI INC or AGS: the lines of the MEAS family at 8E1, other letters (BEI manual, p. 10 to 12).

    `polled` is its stored mode. Some letters set a mode until power-off. The same letters store the mode in the setup
    level, which "prog" enters while the output is stopped.
    """

    bits_per_byte = 11

    def __init__(self, aircraft: VirtualAircraft, *, polled: bool = False, **more: Any) -> None:
        super().__init__(aircraft, **more)
        self.polled = polled
        self.streaming = not polled
        self.setup = False
        self.stored = 0
        self._typed = ""

    def power_on(self, t_s: float) -> bytes:
        """Start in the user level and the stored mode; in polled mode, send the device information first."""
        super().power_on(t_s)
        self.setup, self.streaming = False, not self.polled
        return b"AGS030-2-S1\r\nSN:0001-001\r\nHV:01.0\r\nSV:01.0\r\n" if self.polled else b""

    def command(self, data: bytes, t_s: float) -> bytes:
        """Handle single letters; `f` and `*` are answered at once, unknown ones not at all."""
        answer = b""
        for letter in data.decode(errors="replace")[:_COMMAND_LIMIT]:
            if letter in "fF":
                self.streaming = letter == "F"
                if self.setup:
                    self.polled, self.stored = letter == "f", self.stored + 1
                answer += b"f" if letter == "f" else b""
            elif letter == "R" and not self.streaming:
                answer += self._lines(t_s)
            elif letter == "*":
                answer += b"SS" if self.setup else b"US"
            self._typed = (self._typed + letter)[-4:]
            if self._typed == "prog" and not self.streaming:
                self.setup = True
                answer += b"P"
        return answer


class RionInclinometer(Gradienter):
    """RION HCA726: elevation of each axis to a tenth of a millidegree, by MEMS, without a fluid.

    It only answers. Three bytes after the angles are undocumented; they are zero here.
    """

    protocol = "rion"
    baud = 9600

    def __init__(self, aircraft: VirtualAircraft, **more: Any) -> None:
        super().__init__(aircraft, lag_s=0.0, **more)
        self.streaming = False
        self._commands = RionCommands()

    def power_on(self, t_s: float) -> bytes:
        said = super().power_on(t_s)
        self.streaming = False
        return said

    def _lines(self, t_s: float) -> bytes:
        x, y = self.reading_deg(t_s)
        return rion_packet(0x84, rion_decimal(x, 8, 4) + rion_decimal(y, 8, 4) + bytes(3))

    def command(self, data: bytes, t_s: float) -> bytes:
        return b"".join(self._lines(t_s) for command, _ in self._commands.take(data) if command == 0x04)


class WitMotionInclinometer(SerialDevice):
    """WitMotion SINxT: angles only, 10 a second, X forward, Y left, Z up."""

    protocol = "witmotion"
    baud = 9600
    default_rate_hz = 10.0
    NOISE_DEG: Final = 0.003

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        mounting_deg: tuple[float, float, float] = WIT_Z_UP,
        **line: Any,
    ) -> None:
        super().__init__(aircraft, **line)
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = np.random.default_rng([seed, 23])

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [self._frame(float(time)) for time in times_s]

    def _frame(self, t_s: float) -> bytes:
        angles = np.array(wit_angles_deg(self.aircraft, t_s, self._mounting))
        angles[:2] += self.NOISE_DEG * self._random.standard_normal(2)
        return wit_packet(0x53, (angles / 180.0 * 32768.0).tolist())
