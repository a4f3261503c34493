"""The table of parts that warm up."""

from __future__ import annotations

from typing import Final

import numpy as np

from sim.accuracy.figures import Claim, Figure, Section, covered, rms
from sim.accuracy.warmup import CURVE_K, CURVES_S, LATE_S, NEXT_MINUTE_S, RAMPS, WARMING, Case, WarmRun, cases
from sim.imu_model import DEG_H

_GYRO: Final = slice(0, 3)
_ACCEL: Final = slice(3, 6)
_LEAST: Final = 90.0
_ON: Final = {0.0: "just on", 600.0: "10 min on", 3600.0: "1 h on"}


def section(runs: list[WarmRun], each: int) -> Section:
    """Of every part, case after case: so many runs each."""
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
                error, sigma = np.array([run.error for run in mine]), np.array([run.sigma for run in mine])
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


def _rows() -> list[tuple[str, list[Case]]]:
    """Words and cases of every line, with and without a thermometer."""
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
