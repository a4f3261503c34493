"""Turns under a standing aircraft: detection, waiting, and the rest in sigma."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel
from companion.estimation.noise.allan import noise_profile
from companion.estimation.noise.lines import fit_slope
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import solve
from companion.estimation.turning.turn import Turn
from companion.physics.units import DEG, DEG_H
from sim.accuracy import turning
from tests.support.extent import extent
from tests.support.still_aircraft import HEADING, Feeder, imu, settings

Floats = NDArray[np.float64]
FOREVER = settings(target_gyro_sigma_rad_s=1e-9, target_accel_sigma_m_s2=1e-9)


class Stand:
    """IMUs at rest, and a compass of a tenth of a degree of noise where there is one."""

    def __init__(self, *names: str, compass: bool = False) -> None:
        names = names or ("fc",)
        parts = [imu(name, noise_profile("icm42688p")) for name in names]
        self.collector = RollingCollector(FOREVER, parts, compass=HEADING if compass else None)
        self.feed = Feeder(self.collector, names)
        self.noise = np.random.default_rng(5)
        self.heading: Callable[[float], float] = lambda _t: 350.0
        if compass:
            self.feed.heading = lambda t: (self.heading(t) + 0.1 * self.noise.standard_normal()) % 360.0

    def add(self, rate_deg_s: tuple[float, float, float], *names: str) -> None:
        """Add a bias to the gyros from now on."""
        more = np.array([*rate_deg_s, 0.0, 0.0, 0.0]) * DEG
        self.feed.change = lambda name, _t, rows: rows + more if not names or name in names else rows

    def turn(self, rate_deg_s: float) -> None:
        since_s, from_deg = self.feed.now_s, self.heading(self.feed.now_s)
        self.heading = lambda t: from_deg + rate_deg_s * (t - since_s)
        self.add((0.0, 0.0, rate_deg_s))

    def warnings(self) -> tuple[str, ...]:
        model = CompassModel(magnetic=False, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=1.0)
        window = self.collector.window(self.feed.now_s)
        return solve(window, local_earth(Whereabouts(45.0)), None, model, What.GYROS).warnings

    def says(self, seconds: float) -> str:
        """Obstacle after so long."""
        self.feed.run(seconds)
        return self.feed.waiting_for() or ""


def test_on_still_ground_nothing_turns() -> None:
    stand = Stand(compass=True)
    assert not stand.says(100.0)
    turn = stand.collector.turn
    assert turn.by == "compass and gyros"
    assert abs(turn.rate_rad_s) < 3.0 * turn.sigma_rad_s < 0.002 * DEG


@pytest.mark.parametrize("rate_deg_s", [-0.02, 0.05, 0.4, -2.0])
def test_a_turn_from_the_start_is_named_and_never_ready(rate_deg_s: float) -> None:
    stand = Stand(compass=True)
    stand.turn(rate_deg_s)
    stand.feed.run(20.0)
    for _ in range(60):
        line = stand.says(1.0)
        assert line.startswith("the aircraft turns ")
        assert ("to the right" if rate_deg_s > 0.0 else "to the left") in line
        assert float(line.split()[3]) == pytest.approx(abs(rate_deg_s), rel=0.15)


@pytest.mark.parametrize("rate_deg_s", [0.05, 0.15, 0.45])
def test_a_turn_after_a_rest_is_named_without_a_compass_for_as_long_as_it_lasts(rate_deg_s: float) -> None:
    stand = Stand()
    stand.feed.run(40.0)
    stand.add((0.0, 0.0, -rate_deg_s))
    stand.feed.run(30.0)
    for _ in range(120):
        line = stand.says(1.0)
        assert line.startswith("the aircraft turns ")
        assert "to the left, or gyro fc has changed: if it stands still, restart the companion" in line


@pytest.mark.parametrize(
    ("rate_deg_s", "names"), [((0.0, 0.0, 0.8), ("own",)), ((0.7, 0.2, 0.3), ())], ids=["one of two", "across"]
)
def test_a_gyro_that_changes_unlike_a_turn_has_changed_itself(
    rate_deg_s: tuple[float, float, float], names: tuple[str, ...]
) -> None:
    stand = Stand("fc", "own")
    stand.feed.run(40.0)
    stand.add(rate_deg_s, *names)
    for _ in range(60):
        assert "turns" not in stand.says(1.0)
    assert not stand.says(1.0)
    assert abs(stand.collector.turn.rate_rad_s) < 0.01 * DEG


def test_a_gyro_that_changes_while_the_heading_stands_has_changed() -> None:
    stand = Stand(compass=True)
    stand.feed.run(40.0)
    stand.add((0.0, 0.0, 0.1))
    assert not stand.says(40.0)
    assert abs(stand.collector.turn.rate_rad_s) < 0.005 * DEG


def test_a_field_that_turns_while_the_gyros_do_not_is_in_nobodys_way() -> None:
    stand = Stand(compass=True)
    stand.feed.run(130.0)
    since_s = stand.feed.now_s
    stand.heading = lambda t: 350.0 + 0.03 * (t - since_s)
    stand.feed.run(45.0)  # before that it could be either
    for _ in range(15):
        assert not stand.says(2.0)
    turn = stand.collector.turn
    assert turn.by == "gyros"
    assert turn.variance < (0.005 * DEG) ** 2
    assert any(words.endswith("gyros do not: move away from iron") for words in stand.warnings())


def test_a_level_that_nobody_saw_at_rest_makes_no_iron_of_a_turn() -> None:
    stand = Stand()
    stand.turn(0.15)
    assert not stand.says(100.0)
    assert not stand.collector.turn.is_told
    stand.collector.expect(gradienter=False, compass=True)
    stand.feed.heading = stand.heading
    stand.feed.run(40.0)
    for _ in range(20):
        assert stand.says(3.0).startswith("the aircraft turns 0.15")


def test_a_coarse_compass_may_hide_a_turn_and_sigma_says_so() -> None:
    stand = Stand()
    stand.collector.expect(gradienter=False, compass=True)
    since_s = stand.feed.now_s
    for rate_deg_s in (0.0, 0.03):
        stand.feed.heading = lambda t, rate=rate_deg_s: float(np.floor(20.1 + rate * (t - since_s)))
        stand.feed.run(25.0)
    stand.add((0.0, 0.0, 0.03))
    turn = stand.collector.turn
    assert turn.by == "compass"
    assert 3.0 * math.sqrt(turn.variance) > 0.03 * DEG


def test_warming_up_is_no_turn() -> None:
    stand = Stand()
    begun_s = stand.feed.now_s

    def warming(_name: str, times: Floats, rows: Floats) -> Floats:
        drift = 300.0 * DEG_H * (1.0 - np.exp(-(times - begun_s) / 100.0))
        return np.asarray(rows + drift[:, None] * np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))

    stand.feed.change = warming
    for _ in range(60):
        assert "turns" not in stand.says(5.0)


# ------------------------------------------------------------------------------------------------------------ slopes


def test_the_sigma_of_a_slope_covers_white_noise_and_wander() -> None:
    random, slots = np.random.default_rng(3), np.arange(60)
    white = random.normal(size=(60, 4000))
    wander = np.zeros((60, 4000))
    for time_constant_s in 0.3 * 3.0 ** np.arange(8):
        state, decay = random.normal(size=4000), math.exp(-1.0 / time_constant_s)
        for row in wander:
            state = decay * state + math.sqrt(1.0 - decay**2) * random.normal(size=4000)
            row += 0.3 * state
    walk = np.cumsum(random.normal(size=(60, 4000)), axis=0)
    # Two sigmas of a normal error are 95.4 %. Slow wander that one minute does not show among its white noise, and what
    # the line takes of a walk, nobody can know from that minute.
    for values, least, most in (
        (white, 0.93, 0.98),
        (wander, 0.89, 0.98),
        (walk, 0.89, 0.98),
        (white + wander, 0.84, 0.98),
    ):
        found = fit_slope(slots, values)
        covered = np.mean(np.abs(found.per_s) < 2.0 * np.sqrt(found.variance))
        assert least < covered < most
    # White noise is hardly ever taken for a walk.
    sigma = np.sqrt(fit_slope(slots, white).variance)
    assert np.quantile(sigma, 0.95) < 2.5 * np.median(sigma)
    # What white noise alone leaves, and a little for the wander that could not be told from it.
    assert np.median(np.sqrt(fit_slope(slots, white).variance)) == pytest.approx(math.sqrt(12.0 / 60**3), rel=0.25)


def test_words_have_as_many_digits_as_it_takes() -> None:
    assert Turn(rate_rad_s=0.01234 * DEG).in_words == "turns 0.012 deg/s to the right"
    assert Turn(rate_rad_s=-1.98 * DEG).in_words == "turns 2.0 deg/s to the left"
    assert Turn().variance == 0.0


# ----------------------------------------------------------------------------------------- through and through


@pytest.mark.parametrize("rate_deg_s", extent(whole=turning.RATES_DEG_S, a_slice=(0.0, 0.02, 0.15)))
def test_no_error_above_three_sigmas_is_ever_ready(rate_deg_s: float) -> None:
    count = extent(whole=1000, a_slice=6)
    found = [turning.run(case) for case in turning.cases(rate_deg_s, count, first=100)]
    assert max(one.worst for one in found) <= turning.SIGMAS
    if rate_deg_s == 0.0:
        assert sum(one.refused for one in found) <= max(0.005 * sum(one.looks for one in found), 2)
