"""The table of the deck: voyages at sea and stands on still ground, beside the bound and the ground's own way."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from companion.estimation.noise.allan import PROFILES, floor_variance
from sim.accuracy.deck import DeckRun, Voyage, sail
from sim.accuracy.experiments import many
from sim.accuracy.figures import Claim, Figure, Section, covered, rms
from sim.accuracy.stand import NEXT_S
from sim.imu_model import DEG_H, MG

SPANS_S: Final = (120, 600)
STILL_S: Final = (60, 120)
STILL: Final = Voyage(waves=(), turn_deg_s=0.0)
_TRIADS: Final = (
    ("gyros, deg/h", DEG_H, slice(0, 3)),
    ("horizontal accelerometers, mg", MG, slice(3, 5)),
    ("vertical accelerometer, mg", MG, slice(5, 6)),
)
MOST: Final = {("gyros, deg/h", 120): 40.0, ("gyros, deg/h", 600): 10.0,
               ("horizontal accelerometers, mg", 120): 1.0, ("horizontal accelerometers, mg", 600): 0.4}  # fmt: skip


def deck(voyages: int, stands: int, seed: int, jobs: int) -> Section:
    """The table, and what must hold of it."""
    sea = many(sail, [(Voyage(), SPANS_S, 10_000 * seed + number) for number in range(voyages)], jobs)
    still = many(sail, [(STILL, STILL_S, 10_000 * seed + 5_000 + number) for number in range(stands)], jobs)
    lines = [
        "rms error against the mean bias of the next 180 s",
        "",
        f"{'rms':>51}{'+-':>6}{'sigma':>8}{'2 sigma covers':>16}",
    ]
    claims: list[Claim] = []
    for index, span in enumerate(SPANS_S):
        lines += _rows(f"sea, {span} s", sea, index)
        twice = covered(_stack(sea, "error")[:, index], _stack(sea, "sigma")[:, index], 2.0)
        claims.append(Claim(f"deck, {span} s: 2 sigma covers", "%", twice.times(100.0), 98.0, 93.0))
        for name, unit, part in _TRIADS[:2]:
            found = rms(_stack(sea, "error")[:, index, part] / unit)
            claims.append(Claim(f"deck, {span} s: {name}", "", found, MOST[name, span], 0.0))
    for index, span in enumerate(STILL_S):
        lines += _rows(f"still, {span} s", still, index)
        share = _over_the_ground(still, index, span)
        claims.append(Claim(f"still ground, {span} s: gyro sigma over that at rest", "", share, 1.5, 0.0))
    return Section(f"On a deck ({voyages} voyages, {stands} stands)", lines, claims)


def _rows(title: str, runs: list[DeckRun], index: int) -> list[str]:
    lines = []
    errors, sigmas = _stack(runs, "error")[:, index], _stack(runs, "sigma")[:, index]
    for name, unit, part in _TRIADS:
        error, sigma = errors[:, part], sigmas[:, part]
        found, twice = rms(error / unit), covered(error, sigma, 2.0)
        size = float(np.sqrt(np.square(sigma).mean())) / unit
        digits = 1 if unit == DEG_H else 3
        lines.append(
            f"{title:13}{name:30}{found.value:8.{digits}f}{found.error:6.{digits}f}"
            f"{size:8.{digits}f}{100.0 * twice.value:12.1f} %"
        )
    return lines


def _over_the_ground(runs: list[DeckRun], index: int, span_s: int) -> Figure:
    """Sigma of the gyros over that of a mean of as long, V(T, H)."""
    model = PROFILES[STILL.part].gyro
    at_rest = math.sqrt(model.white**2 / span_s + float(floor_variance(model.flicker, model.walk, span_s, NEXT_S)))
    return rms(_stack(runs, "sigma")[:, index, :3] / at_rest)


def _stack(runs: list[DeckRun], name: str) -> Any:
    return np.array([getattr(run, name) for run in runs])
