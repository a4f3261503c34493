"""More compasses: Honeywell's HMR3000 and what else speaks NMEA 0183, and OceanServer's OS5000.

Their tilt is that of `sim.devices.Gradienter`: lag, offset and noise are given in the same way.
"""

from __future__ import annotations

import math
import re
from functools import reduce
from operator import xor
from typing import Literal

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import Frame, Gradienter, Law, nmea

Sentence = Literal["HPR", "HDG", "HDM", "HDT", "THS", "XDR", "CCD"]
_COMMAND_LIMIT = 64


class TiltCompass(Gradienter):
    """What the compasses here have in common: a magnetic heading, and the tilt of a gradienter."""

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        law: Law = "axis",
        tilt_error_deg: tuple[float, float] = (0.0, 0.0),
        tilt_noise_deg: float = 0.02,
        lag_s: float = 0.0,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        pitch_error_deg, roll_error_deg = tilt_error_deg
        super().__init__(
            aircraft,
            seed=seed,
            law=law,
            offset_deg=(roll_error_deg, pitch_error_deg),
            noise_deg=tilt_noise_deg,
            lag_s=lag_s,
            mounting_deg=mounting_deg,
            rate_hz=rate_hz,
            clock_ppm=clock_ppm,
        )
        self.heading_error_deg, self.heading_noise_deg = heading_error_deg, heading_noise_deg
        self._heading_random = np.random.default_rng([seed, 15])
        self._pending = b""

    def magnetic_deg(self, t_s: float) -> float:
        """Magnetic heading with error and noise, not wrapped."""
        _, _, heading = self.aircraft.mounted_angles_rad(t_s, self._mounting)
        noise = self.heading_noise_deg * float(self._heading_random.standard_normal())
        return math.degrees(heading) - self.aircraft.site.declination_deg + self.heading_error_deg + noise

    def field_mg(self, t_s: float) -> list[float]:
        """Magnetic field in milligauss, in the device's own axes: forward, right, down."""
        declination = math.radians(self.aircraft.site.declination_deg)
        ned = np.array([280.0 * math.cos(declination), 280.0 * math.sin(declination), 450.0])
        field: list[float] = (self._mounting.T @ self.aircraft.body_from_ned(t_s) @ ned).tolist()
        return field


class NmeaCompass(TiltCompass):
    """HMR3000 (Honeywell 900240): any of its sentences, in its order; HDM and THS stand for other makers' compasses.

    It comes from the factory with none enabled. `$PTNT,HPR*78` and the like ask for one. Beyond the alarm level of a
    tilt, or with `magnetic_alarm`, HPR has empty fields. Tilt is the elevation of the board's axes (CCD, p. 15).
    """

    protocol = "nmea"
    baud = 19200
    default_rate_hz = 13.75

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        sentences: tuple[Sentence, ...] = ("HPR",),
        deviation_deg: float = 0.0,
        alarm_deg: float = 40.0,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        tilt_error_deg: tuple[float, float] = (0.0, 0.0),
        tilt_noise_deg: float = 0.02,
        lag_s: float = 0.288,
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(
            aircraft,
            seed=seed,
            heading_error_deg=heading_error_deg,
            heading_noise_deg=heading_noise_deg,
            tilt_error_deg=tilt_error_deg,
            tilt_noise_deg=tilt_noise_deg,
            lag_s=lag_s,
            mounting_deg=mounting_deg,
            rate_hz=rate_hz,
            clock_ppm=clock_ppm,
        )
        self.sentences, self.deviation_deg, self.alarm_deg = sentences, deviation_deg, alarm_deg
        self.magnetic_alarm = False

    def _lines(self, t_s: float) -> bytes:
        roll, pitch = self.reading_deg(t_s)
        magnetic = self.magnetic_deg(t_s)
        return b"".join(nmea(self._body(name, t_s, magnetic, pitch, roll)) for name in self.sentences)

    def _body(self, name: Sentence, t_s: float, magnetic_deg: float, pitch_deg: float, roll_deg: float) -> str:
        variation = self.aircraft.site.declination_deg
        if name == "HDG":
            sensor = _circle(magnetic_deg - self.deviation_deg)
            return f"HCHDG,{sensor},{_sided(self.deviation_deg)},{_sided(variation)}"
        if name == "HDM":
            return f"HCHDM,{_circle(magnetic_deg)},M"
        if name == "HDT":
            return f"HCHDT,{_circle(magnetic_deg + variation)},T"
        if name == "THS":
            return f"GPTHS,{_circle(magnetic_deg + variation)},A"
        x, y, z = self.field_mg(t_s)
        if name == "XDR":
            total = math.sqrt(x * x + y * y + z * z)
            field = f"G,{x:.1f},,MAGX,G,{y:.1f},,MAGY,G,{z:.1f},,MAGZ,G,{total:.1f},,MAGT"
            return f"HCXDR,A,{pitch_deg:.1f},D,PITCH,A,{roll_deg:.1f},D,ROLL,{field}"
        if name == "CCD":
            tangents = [round(32768.0 * math.tan(math.radians(angle))) for angle in (pitch_deg, roll_deg)]
            counts = [round(4.0 * each) for each in (x, y, z, math.sqrt(x * x + y * y + z * z))]
            return f"PTNTCCD,{','.join(map(str, tangents + counts))},{_circle(magnetic_deg)}"
        pitch, roll = self._alarmed(pitch_deg), self._alarmed(roll_deg)
        steady = pitch[0] and roll[0] and not self.magnetic_alarm
        heading = _circle(magnetic_deg) if steady else ""
        return f"PTNTHPR,{heading},{'P' if self.magnetic_alarm else 'N'},{','.join(pitch)},{','.join(roll)}"

    def _alarmed(self, angle_deg: float) -> tuple[str, str]:
        return ("", "P") if abs(angle_deg) > self.alarm_deg else (f"{angle_deg:.1f}", "N")

    def command(self, data: bytes, t_s: float) -> bytes:
        """One sentence for each right question; everything else is passed over."""
        answer = b""
        self._pending += data
        while b"\n" in self._pending:
            line, _, self._pending = self._pending.partition(b"\n")
            match = re.fullmatch(rb"\$((?:PTNT|TNHCQ),(HPR|CCD|HDG|HDT|XDR))\*([0-9A-F]{2})\r", line)
            if match and reduce(xor, match[1], 0) == int(match[3], 16):
                roll, pitch = self.reading_deg(t_s)
                name: Sentence = match[2].decode()  # type: ignore[assignment]
                answer += nmea(self._body(name, t_s, self.magnetic_deg(t_s), pitch, roll))
        self._pending = self._pending[-_COMMAND_LIMIT:]
        return answer

    def frames_until(self, t_s: float) -> list[Frame]:
        """None while no sentence is enabled."""
        self.streaming = bool(self.sentences)
        return super().frames_until(t_s)


class Os5000(TiltCompass):
    """OceanServer OS5000: `$C` sentences (user's guide, format type 0x01); with `vectors` those of field and gravity.

    `<esc>R` and a number set its rate, 0 stops it. Its tilt comes from accelerometers.
    """

    protocol = "os5000"
    baud = 19200
    default_rate_hz = 10.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        vectors: bool = False,
        heading_error_deg: float = 0.0,
        heading_noise_deg: float = 0.05,
        tilt_error_deg: tuple[float, float] = (0.0, 0.0),
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(
            aircraft,
            seed=seed,
            heading_error_deg=heading_error_deg,
            heading_noise_deg=heading_noise_deg,
            law="euler",
            tilt_error_deg=tilt_error_deg,
            mounting_deg=mounting_deg,
            rate_hz=rate_hz,
            clock_ppm=clock_ppm,
        )
        self.vectors = vectors

    def _lines(self, t_s: float) -> bytes:
        roll, pitch = self.reading_deg(t_s)
        temperature = self.aircraft.temperature_degc(t_s)
        body = f"C{_circle(self.magnetic_deg(t_s))}P{pitch:.1f}R{roll:.1f}T{temperature:.1f}"
        if self.vectors:
            x, y, z = self.field_mg(t_s)
            force = self._mounting.T @ self.aircraft.truth_at(t_s).force_m_s2 / -9.80665
            body += f"Mx{x:.2f}My{y:.2f}Mz{z:.2f}Ax{force[0]:.3f}Ay{force[1]:.3f}Az{force[2]:.3f}"
        return nmea(body)

    def command(self, data: bytes, t_s: float) -> bytes:
        """`<esc>R<number><space>` takes effect; the other settings are passed over."""
        self._pending += data
        while match := re.search(rb"\x1b([A-Z*])(-?\d{1,6}) ", self._pending):
            self._pending = self._pending[match.end() :]
            if match[1] == b"R":
                self.streaming = match[2] != b"0"
        self._pending = self._pending[-_COMMAND_LIMIT:]
        return b""


def _circle(angle_deg: float) -> str:
    """One decimal, in [0, 360)."""
    return f"{round(angle_deg * 10.0) % 3600 / 10.0:.1f}"


def _sided(angle_deg: float) -> str:
    return f"{abs(angle_deg):.1f},{'W' if angle_deg < 0.0 else 'E'}"
