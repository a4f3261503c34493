"""The tables of aircraft turned and propped up by hand, and what must hold of them."""

from __future__ import annotations

from typing import Final

import numpy as np

from sim.accuracy.by_hand import BY_HAND, PLACEMENT_DEG, PROPPED_DEG, SLOPE_DEG, STAND_S, TURNS, HandRun
from sim.accuracy.figures import Claim, Figure, Section, covered, rms
from sim.earth import Array
from sim.imu_model import MG

_DEGREE: Final = float(np.radians(1.0))
_BIAS: Final = slice(0, 3)
_SCALE: Final = slice(3, 6)
TURN_MG: Final = 0.25
BIAS_MG: Final = 0.15
SCALE_PERCENT: Final = 0.02
LEVEL_DEG: Final = 0.03
COVERS: Final = (93.0, 98.0)


def section(runs: list[HandRun], each: int) -> Section:
    """So many aircraft of every part."""
    parts = {part: runs[each * k : each * (k + 1)] for k, part in enumerate(BY_HAND)}
    lines: list[str] = []
    claims: list[Claim] = []
    for make in (_turns, _faces, _level):
        lines += [*make(parts, claims), ""]
    lines += [
        f"{STAND_S} s each; turned on marks met to {PLACEMENT_DEG:g} deg, gyros of 1 %, 0.5 % from square;",
        f"propped up within {PROPPED_DEG:g} deg on ground that slopes by {SLOPE_DEG:g}.",
        "Biases against their mean over the next 3 min.",
        "New boards: bias 20 mg, scale 0.5 %, shear 0.3 %, put in within 1 deg, gravity 30 mGal off.",
    ]
    return Section(f"By hand, without a gradienter ({each} aircraft of each part)", lines, claims)


def _stack(runs: list[HandRun], name: str) -> Array:
    return np.array([getattr(run, name) for run in runs])


def _covers(words: str, errors: Array, sigmas: Array, claims: list[Claim]) -> Figure:
    found = covered(errors, sigmas, 2.0).times(100.0)
    claims.append(Claim(f"{words}: 2 sigma cover", "%", found, COVERS[1], COVERS[0]))
    return found


def _turns(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "headings: horizontal bias when level, rms mg, mean sigma, 2 sigma cover; slope, rms deg",
        "",
        f"{'on a slope of':14}" + "".join(f"{part:>27}" for part in parts),
    ]
    for row, (headings, slope) in enumerate(TURNS):
        line = f"{headings} on {slope:3.1f} deg "
        for part, runs in parts.items():
            error, sigma = _stack(runs, "turn")[:, row], _stack(runs, "turn_sigma")[:, row]
            found = rms(error).times(1.0 / MG)
            mean = float(sigma.mean()) / MG
            share = covered(error, sigma, 2.0).times(100.0)
            off = rms(_stack(runs, "slope")[:, row]).times(1.0 / _DEGREE)
            line += f"{found.value:8.3f}{mean:6.3f}{share.value:5.0f} %{off.value:6.3f}"
            claims.append(Claim(f"turn, {part}, {headings} on {slope:g} deg: rms", "mg", found, TURN_MG))
        lines.append(line)
    every = [run for runs in parts.values() for run in runs]
    for headings in (2, 4):
        rows = [row for row, turn in enumerate(TURNS) if turn[0] == headings]
        error, sigma = (_stack(every, name)[:, rows] for name in ("turn", "turn_sigma"))
        _covers(f"turn, {headings} headings", error, sigma, claims)
    return lines


def _faces(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "twelve stands: bias, rms mg, and scale, rms %",
        "",
        f"{'':12}{'companion':>15}{'sigma':>15}{'2 sigma':>8}",
    ]
    for part, runs in parts.items():
        errors, sigma = _stack(runs, "faces"), _stack(runs, "faces_sigma")
        bias, scale = rms(errors[:, _BIAS]).times(1.0 / MG), rms(errors[:, _SCALE]).times(100.0)
        line = f"{part:12}{bias.value:8.3f}{scale.value:7.4f}"
        claims.append(Claim(f"faces, {part}: bias, rms", "mg", bias, BIAS_MG))
        claims.append(Claim(f"faces, {part}: scale, rms", "%", scale, SCALE_PERCENT))
        share = _covers(f"faces, {part}", errors, sigma, claims)
        checked = Figure(100.0 * float(_stack(runs, "faces_checked").mean()), 0.0)
        line += f"{sigma[:, _BIAS].mean() / MG:8.3f}{100.0 * sigma[:, _SCALE].mean():7.4f}{share.value:6.0f} %"
        claims.append(Claim(f"faces, {part}: no good stand blamed", "%", checked, 100.0, 98.0))
        lines.append(line)
    return lines


def _level(parts: dict[str, list[HandRun]], claims: list[Claim]) -> list[str]:
    lines = [
        "the board against the base, on 5 deg of slope: rms deg, 2 sigma cover; a firmware's own level there",
        "",
    ]
    for part, runs in parts.items():
        error, sigma = _stack(runs, "level"), _stack(runs, "level_sigma")
        found, theirs = (rms(one).times(1.0 / _DEGREE) for one in (error, _stack(runs, "level_firmware")))
        claims.append(Claim(f"level, {part}: rms", "deg", found, LEVEL_DEG))
        share = _covers(f"level, {part}", error, sigma, claims)
        lines.append(f"{part:12}{found.value:8.4f}{share.value:7.0f} %{theirs.value:8.2f}")
    return lines
