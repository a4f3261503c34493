"""Parts that warm up: by ramps, and by the curve of a box that was just switched on; judged by the next minute."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import allan_model, noise_profile
from sim.accuracy.experiments import FIELD_HEADING_DEG, FIELD_TILT_DEG, SPANS_S
from sim.accuracy.figures import Claim, Figure, Section, covered, rms, stack
from sim.accuracy.stand import (
    GRAVITY_ANOMALY_M_S2,
    POSTURES,
    STEADY_DEGC,
    References,
    Stand,
    biases,
    collected,
    samples,
    sigmas_use,
    sites,
    solved,
    stand,
)
from sim.earth import Array
from sim.imu_model import DEG_H, PARTS, UG
from sim.thermal import warming

NEXT_MINUTE_S: Final = 60.0
WARMING: Final = ("adis16405", "icm42688p", "bmi088", "vn100")
RAMPS: Final = (0.3, 1.0, 3.0, 10.0)
"""Rates of the gyro biases in (deg/h)/s; those of the accelerometers follow from the same temperature change."""
CURVES_S: Final = (60.0, 300.0, 1200.0)
"""Time constants of the warm-up curves."""
CURVE_K: Final = 20.0
LATE_S: Final = (5.0, 120.0)
"""Times from switch-on to the first reading."""
ON_S: Final = (0.0, 600.0, 3600.0)
"""Times since switch-on for a part at constant temperature."""
VN100: Final = (allan_model(8.9 * DEG_H, 5.0 * DEG_H), allan_model(99.0 * UG, 40.0 * UG))
"""Noise profile from VectorNav's data sheet; the catalogue has none for this IMU."""


@dataclass(frozen=True, slots=True)
class WarmupCase:
    """A temperature history; `thermometer`: the IMU has a thermometer."""

    thermometer: bool
    ramp_deg_h_s: float = 0.0
    curve_s: float = 0.0
    late_s: float = 0.0
    on_s: float = 0.0

    @property
    def is_steady(self) -> bool:
        """True: the temperature is constant."""
        return not self.ramp_deg_h_s and not self.curve_s

    def temperature(self, per_kelvin_rad_s: float) -> Callable[[float], float]:
        """Return a function of aircraft time that gives the temperature."""
        if self.curve_s:
            curve = warming(STEADY_DEGC - CURVE_K, STEADY_DEGC, self.curve_s)
            return lambda t_s: curve(t_s + self.late_s)
        rate = self.ramp_deg_h_s * DEG_H / per_kelvin_rad_s
        return lambda t_s: STEADY_DEGC + rate * t_s


def cases() -> tuple[WarmupCase, ...]:
    found: list[WarmupCase] = []
    for seen in (False, True):
        found += [WarmupCase(seen, on_s=on_s) for on_s in (ON_S if not seen else ON_S[:1])]
        found += [WarmupCase(seen, ramp_deg_h_s=ramp) for ramp in RAMPS]
        found += [WarmupCase(seen, curve_s=curve_s, late_s=late_s) for curve_s in CURVES_S for late_s in LATE_S]
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class WarmRun:
    """Errors against the mean bias of the next minute, sigma_use, and its share from the warm-up; (spans, 6)."""

    error: Array
    sigma: Array
    warm_up: Array


def warm(part: str, case: WarmupCase, seed: int, number: int) -> WarmRun:
    posture, site = POSTURES[number % 3], sites()[number % len(sites())]
    standing = stand(
        part,
        posture,
        site,
        (seed, 5, WARMING.index(part), cases().index(case), number),
        anomaly_m_s2=GRAVITY_ANOMALY_M_S2,
        temperature_degc=case.temperature(PARTS[part].gyro.per_kelvin),
    )
    profile = NoiseProfile("vn100", *VN100) if part == "vn100" else noise_profile(part)
    taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=profile)
    times, rows = samples(standing, SPANS_S[-1])
    references = References.drawn(FIELD_TILT_DEG, FIELD_HEADING_DEG, standing.random)
    error: list[Array] = []
    sigma: list[Array] = []
    warm_up: list[Array] = []
    for window in _windows(standing, taken, times, rows, thermometer=case.thermometer):
        if window is None:
            for each in (error, sigma, warm_up):
                each.append(np.full(6, np.nan))
            continue
        on = {name: age_s + case.on_s for name, age_s in window.powered_s.items()}
        imu = solved(standing, msgspec.structs.replace(window, powered_s=on), references).imus[0]
        error.append(biases(imu) - standing.bias(window.end_s, window.end_s + NEXT_MINUTE_S))
        sigma.append(sigmas_use(imu))
        warm_up.append(np.sqrt(imu.warm_up_variance))
    return WarmRun(np.array(error), np.array(sigma), np.array(warm_up))


def _windows(standing: Stand, taken: ImuInput, times: Array, rows: Array, *, thermometer: bool) -> list[Window | None]:
    """Return the windows after each span; None from the first refusal on: too fast a drift looks like motion."""
    for count in range(len(SPANS_S), 0, -1):
        spans = SPANS_S[:count]
        until = times < 1.0 + spans[-1]
        try:
            found = collected(standing, taken, times[until], rows[until], spans, thermometer=thermometer)
        except CalibrationRefusedError:
            continue
        return [*found, *[None] * (len(SPANS_S) - count)]
    return [None] * len(SPANS_S)


# The table.

_GYRO: Final = slice(0, 3)
_ACCEL: Final = slice(3, 6)
_LEAST: Final = 90.0
_ON: Final = {0.0: "just on", 600.0: "10 min on", 3600.0: "1 h on"}


def section(runs: list[WarmRun], each: int) -> Section:
    flat = iter(runs)
    by_case = {(part, case): [next(flat) for _ in range(each)] for part in WARMING for case in cases()}
    lines = [
        f"gyros against the bias of the next {NEXT_MINUTE_S:.0f} s; 2 sigma of sigma_use cover, %; rms sigma, deg/h",
        "(accelerometers: below, what must hold)",
        "",
        f"{'':27}{'no thermometer':>38}{'thermometer':>35}",
        f"{'':27}" + f"{'10 s 30 s 60 s':>17}{'10 s 30 s 60 s':>18}" * 2,
    ]
    claims = []
    for part in WARMING:
        lowest: dict[str, list[Figure]] = {f"{what}{of}": [] for of in ("", ", accel") for what in ("ramps", "curves")}
        for row, (words, wanted) in enumerate(_rows()):
            line = f"{part if not row else '':10}{words:17}"
            for thermometer in (False, True):
                mine = [run for case in wanted if case.thermometer == thermometer for run in by_case[part, case]]
                if not mine:
                    continue
                error, sigma = stack(mine, "error"), stack(mine, "sigma")
                shares, accel = (
                    [covered(error[:, at, part_of], sigma[:, at, part_of], 2.0).times(100.0) for at in range(3)]
                    for part_of in (_GYRO, _ACCEL)
                )
                sizes = [rms(sigma[:, at, _GYRO]).times(1.0 / DEG_H) for at in range(3)]
                line += "   " + "".join(f"{share.value:5.0f}" for share in shares)
                line += "   " + "".join(f"{size.value:5.0f}" for size in sizes)
                if not wanted[0].is_steady:
                    what = "curves" if wanted[0].curve_s else "ramps"
                    lowest[what] += shares
                    lowest[f"{what}, accel"] += accel
            lines.append(line)
        claims += [
            Claim(
                f"{part}, {what}: least that 2 sigma cover{'' if 'accel' in what else ', next minute'}",
                "%",
                min(found),
                100.0,
                _LEAST,
            )
            for what, found in lowest.items()
        ]
    lines += [
        "",
        f"Ramps in (deg/h)/s, from the first second on. Curves: {CURVE_K:g} K in so many minutes (time constant), seen",
        f"from {' and '.join(f'{late:g} s' for late in LATE_S)} after the switch-on.",
    ]
    return Section(f"Warm-up ({each} stands in each case)", lines, claims)


def _rows() -> list[tuple[str, list[WarmupCase]]]:
    """Return title and cases of each table row, with and without a thermometer."""
    every = cases()
    rows = [
        (f"steady, {words}", [case for case in every if case.is_steady and case.on_s == on_s])
        for on_s, words in _ON.items()
    ]
    rows += [(f"ramp {ramp:g}", [case for case in every if case.ramp_deg_h_s == ramp]) for ramp in RAMPS]
    rows += [
        (f"curve {curve_s / 60.0:g} min", [case for case in every if case.curve_s == curve_s]) for curve_s in CURVES_S
    ]
    return rows
