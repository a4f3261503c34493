"""Time until a warm-up no longer matters: predictions while it lasts, against the simulator's later temperature.

Every aircraft is switched on cold. A prediction is made every ten seconds, as by the daemon, until its truth is past.
The truth is the moment from which the rest of the warm-up stays below the arm gate's limit: kelvins, or by the curve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Final

import numpy as np

from companion.config.sections import Calibration
from companion.estimation.means.until_steady import UntilSteady, lasting_k, until_steady
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import by_power_up, kept
from companion.estimation.records.validity import DRIFT_SIGMAS
from companion.estimation.solution.curve import Curve, settling
from companion.estimation.solution.prior import curve_of
from companion.physics.frames import vector
from companion.samples import Vector
from sim.accuracy import temperature
from sim.accuracy.figures import Claim, Figure, Section
from sim.accuracy.temperature import AMBIENT_DEGC, DAYS, AgingAircraft
from sim.earth import Array
from sim.imu_model import DEG_H, PARTS
from sim.thermal import ThermalBoard

KNOWN: Final = ("first days", "first days, chip and board", "curve and earlier warm-ups")
"""What the companion knows of the board. `chip and board`: up to 30 % of the warming has a time constant below 60 s."""
BOARDS_S: Final = (60.0, 1200.0)
"""Time constants of boards without earlier warm-ups: real ones take 1 to 20 min, those of `sim.thermal` fewer."""
BOARDS_K: Final = (6.0, 30.0)
MEAN_S: Final = 10
FACTOR: Final = 1.5
_GOAL: Final = Calibration().target_gyro_sigma_deg_h * DEG_H
_LIMIT_K: Final = Calibration().max_temperature_change_degc
_LONGEST_S: Final = 7200
_OFTEN: Final = 30  # Number of means up to which every one is followed by a prediction; later every third
_MEANS: Final = 60
_THERMOMETER_K: Final = 0.05
_CHIP_SHARE: Final = 0.3
_CHIP_S: Final = (15.0, 60.0)
_SLACK_S: Final = MEAN_S / 2.0
_COVERS: Final = 90.0
_EARLY_S: Final = 120.0


@dataclass(frozen=True, slots=True, eq=False)
class Ready:
    """Predictions of one warm-up: rows of age, true time left, and the interval's low and high end, s."""

    rows: Array


def until_ready(known: str, part: str, seed: int, number: int) -> Ready:
    random = np.random.default_rng([seed, 38, [*PARTS].index(part), KNOWN.index(known), number])
    board = ThermalBoard(random.uniform(*BOARDS_K), math.exp(random.uniform(*np.log(BOARDS_S))))
    tau_s, learned = None, None
    if known == KNOWN[2]:
        aircraft = AgingAircraft(PARTS[part].gyro, random)
        board = aircraft.board
        points = kept([point for day in range(DAYS) for point in aircraft.seen(aircraft.day(), day)])
        learned = curve_of(points, "gyro", noise_profile(part).gyro)
        tau_s = settling([[(p.temperature_degc or 0.0, p.k_s) for p in one] for one in by_power_up(points)])
    air_degc = random.uniform(*AMBIENT_DEGC)
    share, chip_s = random.uniform(0.0, _CHIP_SHARE) if known == KNOWN[1] else 0.0, random.uniform(*_CHIP_S)
    end_degc = air_degc + board.rise_k

    def degc(t_s: Array) -> Array:
        slow, chip = (np.exp(-np.maximum(t_s, 0.0) / each) for each in (board.time_constant_s, chip_s))
        return np.asarray(end_degc - board.rise_k * ((1.0 - share) * slow + share * chip))

    limit = partial(_limit_k, learned)
    seconds = np.arange(random.uniform(5.0, 60.0), _LONGEST_S)
    ready_s = int(np.flatnonzero(end_degc - degc(seconds) > limit(end_degc))[-1]) + 1
    shown = degc(seconds[:ready_s]) + random.normal(0.0, _THERMOMETER_K, ready_s)
    means = shown[: ready_s // MEAN_S * MEAN_S].reshape(-1, MEAN_S).mean(axis=1)
    rows = []
    ends_s = MEAN_S * (np.arange(len(means), dtype=np.float64) + 0.5)
    for count in range(1, len(means) + 1):
        if count > _OFTEN and count % 3:
            continue
        taken = slice(max(count - _MEANS, 0), count)
        found = until_steady(ends_s[taken], means[taken], limit, tau_s=tau_s)
        if found is not None:
            rows.append([MEAN_S * count, ready_s - ends_s[count - 1], found.low_s, found.high_s])
    return Ready(np.array(rows).reshape(-1, 4))


def _limit_k(curve: Curve | None, end_degc: float) -> float:
    if curve is None:
        return _LIMIT_K

    def drift(then_degc: float, now_degc: float) -> tuple[Vector, Vector]:
        mean, variance = curve.change((then_degc, 0.0), (now_degc, 0.0))
        return vector(mean), vector(variance)

    return lasting_k(drift, end_degc, DRIFT_SIGMAS * _GOAL, _LIMIT_K)


def _covered(run: Ready) -> float:
    _, left, low, high = run.rows.T
    return float(((low - _SLACK_S <= left) & (left <= high + _SLACK_S)).mean())


def _first(run: Ready) -> tuple[float, float] | None:
    """Return age, s, and predicted over true time of the first prediction that is shown as one figure."""
    for age_s, left_s, low_s, high_s in run.rows:
        if (figure := UntilSteady(low_s, high_s, 0.0).figure_s) is not None:
            return float(age_s), figure[0] / float(left_s)
    return None


def section(runs: list[Ready], each: int) -> Section:
    lines = [
        "share of predictions whose 90 % interval holds the truth, of all and of those in the second minute;",
        f"the first that is shown as one figure: within a factor of {FACTOR:g}, how many warm-ups have one,",
        "its median age",
        "",
        f"{'':40}{'interval':>9}{'minute 2':>9}{'figure':>9}{'have one':>9}{'age, s':>8}",
    ]
    claims, flat = [], iter(runs)
    for known in KNOWN:
        together: list[Ready] = []
        for part in temperature.TRIED:
            own = [run for run in islice(flat, each) if len(run.rows)]
            together += own
            share, early, near, ages_s = _figures(own)
            lines.append(
                f"{known if part == temperature.TRIED[0] else '':28}{part:12}{share.value:7.1f} %{early.value:7.1f} %"
                f"{near.value:7.1f} %{len(ages_s):9d}{np.median(ages_s or [math.nan]):8.0f}"
            )
        share, early, near, _ = _figures(together)
        claims.append(Claim(f"{known}: interval holds the truth", "%", share, 100.0, _COVERS))
        claims.append(Claim(f"{known}: in the second minute", "%", early, 100.0, _COVERS))
        claims.append(Claim(f"{known}: figure within {FACTOR:g}", "%", near, 100.0, _COVERS))
    lines += [
        "",
        f"Predictions every {MEAN_S} s, after 5 min every {3 * MEAN_S} s. Boards of the first days: time constants",
        f"of {BOARDS_S[0]:g} to {BOARDS_S[1]:g} s, {BOARDS_K[0]:g} to {BOARDS_K[1]:g} K; others as in power-up.",
    ]
    return Section(f"Time until ready ({each} warm-ups of each part)", lines, claims)


def _figures(runs: Sequence[Ready]) -> tuple[Figure, Figure, Figure, list[float]]:
    firsts = [first for run in runs if (first := _first(run)) is not None]
    near = [float(1.0 / FACTOR <= ratio <= FACTOR) for _, ratio in firsts]
    early = [Ready(run.rows[run.rows[:, 0] <= _EARLY_S]) for run in runs if run.rows[0, 0] <= _EARLY_S]
    shares = _mean([_covered(run) for run in runs]), _mean([_covered(run) for run in early])
    return *shares, _mean(near), [age_s for age_s, _ in firsts]


def _mean(values: Sequence[float]) -> Figure:
    """Return the mean of shares in percent."""
    if not values:
        return Figure(math.nan, math.nan)
    count = len(values)
    # At 0 or 100 % the scatter says nothing: then as of one more that is on the other side.
    return Figure(float(np.mean(values)), max(float(np.std(values)) / math.sqrt(count), 1.0 / count)).times(100.0)
