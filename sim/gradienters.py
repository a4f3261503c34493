"""More gradienters: Jewell's tiltmeters and BEI's inclinometers, with the commands that their manuals name.

Both measure as `sim.devices.Gradienter` does. `stored` counts what would have been written to their EEPROM, which
nobody who only reads them may do.
"""

from __future__ import annotations

import math
from typing import Literal

from sim.aircraft import VirtualAircraft
from sim.devices import Gradienter, Law, nmea

_COMMAND_LIMIT = 64
_STORING = ("SO-", "XYC", "XY-SET", "XY-MEMS")
"""Beginnings of a Jewell's commands whose effect outlasts its power."""


class Jewell(Gradienter):
    """Jewell (Applied Geomechanics) tiltmeter: SIM, XDR or ASH lines (Tuff Tilt Digital manual, p. 12 to 18).

    A LILY sticks at 330 microradians: give it `range_deg` accordingly and unit "M".
    """

    protocol = "jewell"
    baud = 9600
    default_rate_hz = 4.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        output: Literal["SIM", "XDR", "ASH"] = "SIM",
        unit: Literal["D", "M"] = "D",
        continuous: bool = True,
        law: Law = "axis",
        offset_deg: tuple[float, float] = (0.0, 0.0),
        noise_deg: float = 0.0005,
        lag_s: float = 0.43,
        range_deg: float = 50.0,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(
            aircraft,
            seed=seed,
            law=law,
            offset_deg=offset_deg,
            noise_deg=noise_deg,
            lag_s=lag_s,
            range_deg=range_deg,
            mounting_deg=mounting_deg,
            rate_hz=rate_hz,
            clock_ppm=clock_ppm,
        )
        self.output, self.unit, self.continuous = output, unit, continuous
        self.streaming = continuous
        self.stored = 0
        self._pending = b""

    def power_on(self, t_s: float) -> bytes:
        """Silent unless it is set to go on by itself."""
        said = super().power_on(t_s)
        self.streaming = self.continuous
        return said

    def _lines(self, t_s: float) -> bytes:
        x, y = (self._clipped(value) for value in self.reading_deg(t_s))
        temperature = f"{self.aircraft.temperature_degc(t_s):07.3f}"
        if self.output == "SIM":
            return f"${x},{y},{temperature},N0000\r\n".encode()
        body = f"A,{y},{self.unit},N,A,{x},{self.unit},E,C,{temperature},C,T-N0000"
        return nmea(f"YXXDR,{body}") if self.output == "XDR" else f"$PASHS,XDR,{body}\r\n".encode()

    def _clipped(self, value_deg: float) -> str:
        value_deg = max(-self.range_deg, min(self.range_deg, value_deg))
        return f"{value_deg if self.unit == 'D' else math.radians(value_deg) * 1e6:07.3f}"

    def command(self, data: bytes, t_s: float) -> bytes:
        """Commands `*ttssCMD` with CR LF, case-sensitive; of the settings only the output format has an effect."""
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

    `polled` is its stored mode. In the setup level, entered with "prog" while stopped, the letters that in the user
    level hold until power-off are stored.
    """

    def __init__(self, aircraft: VirtualAircraft, *, seed: int = 0, polled: bool = False, law: Law = "axis") -> None:
        super().__init__(aircraft, seed=seed, parity="even", law=law)
        self.polled = polled
        self.streaming = not polled
        self.setup = False
        self.stored = 0
        self._typed = ""

    def power_on(self, t_s: float) -> bytes:
        """In the user level, in the stored mode; polled, it begins with information about itself."""
        super().power_on(t_s)
        self.setup, self.streaming = False, not self.polled
        return b"AGS030-2-S1\r\nSN:0001-001\r\nHV:01.0\r\nSV:01.0\r\n" if self.polled else b""

    def command(self, data: bytes, t_s: float) -> bytes:
        """Single letters; `f` and `*` are answered at once, what is not known by nothing."""
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
