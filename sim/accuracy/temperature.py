"""Gyro biases of aircraft over many days: at the next power-up, and calibrated in the middle of a warm-up.

Pieces and boards are those of `sim.thermal`. Each day a board warms up, and is motionless now and then. The simulation
draws one-second means directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import MeasuredBias, Point, PowerUp, by_power_up, kept
from companion.estimation.solution.curve import settling
from companion.estimation.solution.joint import at_end, with_warm
from companion.estimation.solution.prior import ExpectedImu, curve_of, expect, pose_effect
from sim.accuracy.figures import Claim, Errors, Section, covered, rms, stack
from sim.accuracy.stand import POSTURES, References, collected, samples, sites, solved, stand
from sim.earth import Array
from sim.imu_model import DEG_H, PARTS, AxisNoise
from sim.thermal import Curve, Piece, ThermalBoard

DAYS: Final = 20
TRIED: Final = ("icm42688p", "bmi088", "adis16405")
"""Parts whose scatter between power-ups includes the wander within each power-up."""
AMBIENT_DEGC: Final = (5.0, 40.0)
SESSION_S: Final = (300.0, 900.0)
AT_MOST: Final = 1.3
COVERS: Final = (93.0, 98.0)
_SHORTEST_S: Final = 3
_THERMOMETER_K: Final = 0.05
_TAUS_S: Final = 3.0 ** np.arange(8.0)
_UP: Final = (0.0, 0.0, -1.0)


@dataclass(frozen=True, slots=True)
class Day:
    """Readings of one day, one row per second."""

    degc: Array
    k_s: Array
    bias: Array
    still: Array


class AgingAircraft:
    def __init__(
        self, noise: AxisNoise, random: np.random.Generator, shown: Callable[[Array, float], Array] | None = None
    ) -> None:
        """`shown` maps the board's temperature each second, and the air's, to the thermometer's reading."""
        self._noise, self._random = noise, random
        self._shown = shown or (lambda board_degc, air_degc: board_degc)
        self._flicker_sigma = noise.flicker * math.sqrt(math.log(3.0) / math.pi)
        offset = math.sqrt(noise.scatter**2 - len(_TAUS_S) * self._flicker_sigma**2)
        usual = random.normal(0.0, 1000.0 * DEG_H, 3)
        self.piece = Piece.drawn(random, usual, np.full(3, offset), np.full(3, noise.per_kelvin))
        self.board = ThermalBoard.drawn(random)

    def day(self) -> Day:
        """Simulate the next day."""
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
        """Return flicker noise for so many seconds, a sum of Gauss-Markov processes with different time constants."""
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
        """Return the points, one per kelvin, that a daemon would store for the motionless seconds of a day."""
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


def power_up(part: str, seed: int, number: int) -> Errors:
    """Simulate an aircraft for twenty days; return the error at the next power-up, relative to the part's scatter."""
    random = np.random.default_rng([seed, number])
    scatter = PARTS[part].gyro.scatter
    aircraft = AgingAircraft(PARTS[part].gyro, random)
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
    return Errors(
        error=(np.array(expected.value) - truth) / scatter,
        sigma=np.sqrt(expected.variance) / scatter,
    )


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def power_up_section(runs: list[Errors], each: int) -> Section:
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
        error, sigma = (stack(own, n) for n in ("error", "sigma"))
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


RATES_K_MIN: Final = (0.5, 2.0, 5.0)
SPANS_S: Final = (15, 60)
_FLAT: Final = 5.0
"""Number of time constants after which a board counts as warm."""


@dataclass(frozen=True, slots=True, eq=False)
class MidRun:
    """Per span, (spans, 3): errors and sigmas at the end of the window, and when warm; rad/s; NaN: no estimate."""

    error: Array
    sigma: Array
    warm_error: Array
    warm_sigma: Array
    plain_error: Array
    """Error without the temperature curve."""
    plain_sigma: Array
    plain_warm_error: Array


def mid_warm_up(part: str, rate_k_min: float, seed: int, number: int) -> MidRun:
    """Simulate an aircraft's earlier days, then a stand during which the temperature rises at `rate_k_min`."""
    random = np.random.default_rng([seed, 77, number, round(10.0 * rate_k_min)])
    rate_k_s = rate_k_min / 60.0
    on_s = -1.0
    while on_s < 0.0:  # where it stands before the power came, it does not warm
        aircraft = AgingAircraft(PARTS[part].gyro, random)
        board, bends = aircraft.board, aircraft.piece.curve
        steepest = board.rise_k / board.time_constant_s
        on_s = board.time_constant_s * math.log(steepest / rate_k_s) - SPANS_S[-1] / 2.0
    points = kept([point for day in range(DAYS) for point in aircraft.seen(aircraft.day(), day)])
    profile = noise_profile(part)
    curve = curve_of(points, "gyro", profile.gyro)
    settles = settling([[(point.temperature_degc or 0.0, point.k_s) for point in one] for one in by_power_up(points)])
    switched_on = board.switched_on(random.uniform(*AMBIENT_DEGC))
    standing = stand(
        part,
        POSTURES[0],
        sites()[1],
        (seed, number),
        temperature_degc=lambda t_s: switched_on(t_s + on_s),
        curve=Curve(tuple(np.append(power, np.zeros(3)) for power in bends.powers), bends.lag_s),
    )
    times, rows = samples(standing, SPANS_S[-1])
    taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=profile)
    found: list[list[Array]] = []
    for window in collected(standing, taken, times, rows, SPANS_S):
        solution = solved(standing, window, References.drawn(0.05, 0.5, random))
        plain = solution.imus[0]
        path = None if plain.warming is None else plain.warming.path
        said, known = plain, ExpectedImu(name="imu")
        if curve is not None and path is not None:
            known = ExpectedImu(name="imu", along={"gyro": curve.along(path, settles, profile.gyro)})
            said, followed = at_end(plain, known, solution.shared)
            said = with_warm(said, known, followed)
        assert plain.gyro_rad_s is not None
        assert said.gyro_rad_s is not None
        truth = standing.bias(window.end_s - 0.5, window.end_s + 0.5)[:3]
        late_s = window.end_s + _FLAT * board.time_constant_s
        warm = standing.bias(late_s - 0.5, late_s + 0.5)[:3]
        told = said.when_warm
        unknown = np.full(3, np.nan)
        found.append([
            said.gyro_rad_s - truth,
            np.sqrt(np.diag(said.covariance)[:3]),
            unknown if told is None else np.array(told.gyro_bias_rad_s) - warm,
            unknown if told is None else np.array(told.gyro_sigma_rad_s),
            plain.gyro_rad_s - truth,
            np.sqrt(np.diag(plain.use_covariance)[:3]),
            plain.gyro_rad_s - warm,
        ])  # fmt: skip
    return MidRun(*(np.array(each) for each in zip(*found, strict=True)))


def mid_warm_up_section(runs: list[MidRun], each: int) -> Section:
    lines = [
        "gyros, rms error in deg/h, sigma, 2 sigma cover:",
        "at the end of the window without and with the curve; when warm, as foretold;",
        "what the calibration is off by then",
        "",
        f"{'':27}{'without':>16}{'with':>23}{'when warm':>23}{'off by':>8}",
    ]
    claims = []
    flat = iter(runs)
    for part in TRIED:
        ends: list[tuple[Array, Array]] = []
        warms: list[tuple[Array, Array]] = []
        for rate in RATES_K_MIN:
            own = [next(flat) for _ in range(each)]
            for k, span in enumerate(SPANS_S):
                error, sigma, warm, of_warm, plain, of_plain, later = (
                    np.array([getattr(run, name)[k] for run in own]) for name in MidRun.__dataclass_fields__
                )
                told = np.isfinite(of_warm).all(axis=1)
                ends.append((error, sigma))
                warms.append((warm[told], of_warm[told]))
                size, before = rms(error).times(1.0 / DEG_H), rms(plain).times(1.0 / DEG_H)
                share, foreseen = covered(error, sigma, 2.0).times(100.0), covered(*warms[-1], 2.0).times(100.0)
                then, left = rms(warm[told]).times(1.0 / DEG_H), rms(later).times(1.0 / DEG_H)
                lines.append(
                    f"{part if rate == RATES_K_MIN[0] and not k else '':11}{rate:4g} K/min{span:5d} s"
                    f"{before.value:9.1f}{rms(of_plain).value / DEG_H:7.1f}"
                    f"{size.value:9.1f}{rms(sigma).value / DEG_H:7.1f}{share.value:6.1f}%"
                    f"{then.value:9.1f}{rms(of_warm[told]).value / DEG_H:7.1f}{foreseen.value:6.1f}%{left.value:8.0f}"
                )
        for words, pairs in (("at the end", ends), ("when warm", warms)):
            errors, sigmas = (np.concatenate(one) for one in zip(*pairs, strict=True))
            claims.append(
                Claim(
                    f"in mid-warm-up, {part}, {words}: 2 sigma cover",
                    "%",
                    covered(errors, sigmas, 2.0).times(100.0),
                    COVERS[1],
                    COVERS[0],
                )
            )
    lines += ["", f"{DAYS} days before as above; the rate is that of the middle of the minute."]
    return Section(f"In mid-warm-up ({each} aircraft of each part and rate)", lines, claims)
