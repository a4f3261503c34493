"""Aircraft that are switched on day after day at other temperatures: what is known of the gyros at the next power-up.

Pieces and boards are those of `sim.thermal`; each day one warms up and stands still now and then. The days are means of
still seconds, drawn directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import MeasuredBias, Point, PowerUp, kept
from companion.estimation.solution.prior import expect, pose_effect
from sim.accuracy.figures import Claim, Section, covered, rms
from sim.earth import Array
from sim.imu_model import DEG_H, PARTS, AxisNoise
from sim.thermal import Board, Piece

DAYS: Final = 20
TRIED: Final = ("icm42688p", "bmi088", "adis16405")
"""Their scatter includes the wandering within each power-up."""
AMBIENT_DEGC: Final = (5.0, 40.0)
SESSION_S: Final = (300.0, 900.0)
AT_MOST: Final = 1.3
COVERS: Final = (93.0, 98.0)
_SHORTEST_S: Final = 3
_THERMOMETER_K: Final = 0.05
_TAUS_S: Final = 3.0 ** np.arange(8.0)
_UP: Final = (0.0, 0.0, -1.0)


@dataclass(frozen=True, slots=True)
class PowerUpRun:
    """Errors at the next power-up, (3,) each, in units of the part's run-to-run scatter."""

    error: Array
    sigma: Array


@dataclass(frozen=True, slots=True)
class Day:
    """A second is a row."""

    degc: Array
    k_s: Array
    bias: Array
    still: Array


class Aircraft:
    """One piece of a part on one board."""

    def __init__(
        self, noise: AxisNoise, random: np.random.Generator, shown: Callable[[Array, float], Array] | None = None
    ) -> None:
        """`shown` makes of the board's temperature each second, and that of the air, what a thermometer shows."""
        self._noise, self._random = noise, random
        self._shown = shown or (lambda board_degc, air_degc: board_degc)
        self._flicker_sigma = noise.flicker * math.sqrt(math.log(3.0) / math.pi)
        offset = math.sqrt(noise.scatter**2 - len(_TAUS_S) * self._flicker_sigma**2)
        usual = random.normal(0.0, 1000.0 * DEG_H, 3)
        self.piece = Piece.drawn(random, usual, np.full(3, offset), np.full(3, noise.per_kelvin))
        self.board = Board.drawn(random)

    def day(self) -> Day:
        """The next one."""
        random, count = self._random, int(self._random.uniform(*SESSION_S))
        turned_on = self.piece.turned_on(random)
        # Three times in ten it is switched on again while it is warm.
        cold = 1.0 if random.random() < 0.7 else random.uniform()
        air_degc = random.uniform(*AMBIENT_DEGC)
        temperature = self.board.switched_on(air_degc, cold)
        curve = self.piece.curve
        degc, die = (np.array([temperature(second - late) for second in range(count)]) for late in (0.0, curve.lag_s))
        bias = turned_on + curve.at((die - PARTS[TRIED[0]].reference_degc)[:, None]) + self._flicker(count)
        still, second = np.zeros(count, dtype=bool), int(random.uniform(5.0, 60.0))
        while second < count:
            length = int(random.uniform(5.0, 120.0))
            still[second : second + length] = True
            second += length + int(random.uniform(5.0, 60.0))
        degc = self._shown(degc, air_degc)
        return Day(degc + random.normal(0.0, _THERMOMETER_K, count), np.gradient(degc), bias, still)

    def _flicker(self, count: int) -> Array:
        """Of many time constants: Gauss-Markov processes that add up to it."""
        decay = np.exp(-1.0 / _TAUS_S)[:, None]
        sigma = self._flicker_sigma
        state = self._random.normal(0.0, sigma, (len(_TAUS_S), 3))
        found = np.empty((count, 3))
        kicks = self._random.normal(0.0, sigma, (count, len(_TAUS_S), 3)) * np.sqrt(1.0 - decay**2)
        for second in range(count):
            state = decay * state + kicks[second]
            found[second] = state.sum(axis=0)
        return found

    def seen(self, day: Day, number: int) -> list[Point]:
        """What a daemon remembers of its still seconds, by kelvin."""
        points = []
        kelvin = np.floor(day.degc)
        for step in dict.fromkeys(kelvin[day.still].tolist()):
            rows = day.still & (kelvin == step)
            count = int(rows.sum())
            if count < _SHORTEST_S:
                continue
            stat = self._noise.white / math.sqrt(count)
            bias = day.bias[rows].mean(axis=0) + self._random.normal(0.0, stat, 3)
            use = math.hypot(stat, self._noise.flicker)
            measured = MeasuredBias(
                bias=_vector(bias), sigma_stat=(stat,) * 3, sigma_use=(use,) * 3, sigma_shared=(0.0,) * 3
            )
            points.append(
                Point(
                    started_at="",
                    unix_s=86400.0 * number,
                    power_up=PowerUp(host=str(number), since_unix_s=86400.0 * number),
                    temperature_degc=float(day.degc[rows].mean()),
                    k_s=float(day.k_s[rows].mean()),
                    up=_UP,
                    gyro=measured,
                )
            )
        return points


def power_up(part: str, seed: int, number: int) -> PowerUpRun:
    """One aircraft of a part: twenty days, and what is known when it is switched on again."""
    random = np.random.default_rng([seed, number])
    scatter = PARTS[part].gyro.scatter
    aircraft = Aircraft(PARTS[part].gyro, random)
    known: tuple[Point, ...] = ()
    for day in range(DAYS):
        known = kept((*known, *aircraft.seen(aircraft.day(), day)))
    today = aircraft.day()
    truth = today.bias[0]
    now = Point(
        started_at="",
        unix_s=86400.0 * DAYS,
        power_up=PowerUp(host="today", since_unix_s=86400.0 * DAYS),
        temperature_degc=float(today.degc[0]),
        up=_UP,
    )
    expected = expect(known, "gyro", now, pose_effect(None), noise_profile(part).gyro)
    assert expected is not None
    return PowerUpRun(
        error=(np.array(expected.value) - truth) / scatter,
        sigma=np.sqrt(expected.variance) / scatter,
    )


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def section(runs: list[PowerUpRun], each: int) -> Section:
    """So many aircraft of every part."""
    lines = [
        "the gyros' bias at power-up, rms error in deg/h: by the curve, sigma, 2 sigma cover;",
        "over the scatter",
        "",
        f"{'':12}{'scatter':>8}{'curve':>8}{'sigma':>8}{'cover':>9}{'ratio':>8}",
    ]
    claims = []
    for k, part in enumerate(TRIED):
        scatter = PARTS[part].gyro.scatter / DEG_H
        own = runs[each * k : each * (k + 1)]
        error, sigma = (np.array([getattr(run, n) for run in own]) for n in ("error", "sigma"))
        ratio, share = rms(error), covered(error, sigma, 2.0).times(100.0)
        mean = float(np.sqrt(np.square(sigma).mean()))
        lines.append(
            f"{part:12}{scatter:8.0f}{ratio.value * scatter:8.1f}{mean * scatter:8.1f}{share.value:7.1f} %"
            f"{ratio.value:8.2f}"
        )
        claims.append(Claim(f"power-up, {part}: rms over run-to-run scatter", "", ratio, AT_MOST))
        claims.append(Claim(f"power-up, {part}: 2 sigma cover", "%", share, COVERS[1], COVERS[0]))
    low, high = AMBIENT_DEGC
    lines += [
        "",
        f"{DAYS} days of 5 to 15 min between {low:g} and {high:g} degC, 10 to 25 K of own warmth,",
        "still now and then.",
    ]
    return Section(f"At power-up, by temperature ({each} aircraft of each part)", lines, claims)
