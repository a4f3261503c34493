"""The smoother of a deck, against the simulator's truth."""

from __future__ import annotations

import functools
import itertools
import math

import msgspec
import numpy as np
import pytest

from companion.component.statustext import LINE_BYTES
from companion.errors import CalibrationRefusedError
from companion.estimation.deck.deck import Deck, aim, more, progress
from companion.estimation.deck.smoother import passage
from companion.estimation.deck.waves import Fluid, Level, fit_waves, whitened
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import PROFILES
from companion.estimation.seconds.batch import Batch, BatchSource, summary
from companion.physics.frames import rotations
from sim.accuracy.deck import Voyage, feed, sail
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import Array, body_from_ned
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import Sea, Wave

UNITS = np.array([DEG_H] * 3 + [MG] * 3)
AROUND = (
    GradienterModel("axis", np.eye(3), (0.0, 0.0), 0.01, lag_s=0.4),
    CompassModel(magnetic=True, vehicle_from_sensor=np.eye(3), offset_deg=0.0, sigma_deg=1.0),
)


def attitude(aircraft: VirtualAircraft, t_s: float) -> Array:
    """Body to NED."""
    return body_from_ned(*aircraft.angles_rad(t_s)).T


def test_a_second_of_a_sea_turns_as_the_aircraft_has_turned() -> None:
    # A steep sea: five seconds of it cone by far more than the tolerance.
    sea = Sea(waves=(Wave(0.5, 15.0),), seed=2)
    aircraft = VirtualAircraft(Pose(3.0, -2.0, 40.0), Site(latitude_deg=90.0), motions=[sea])
    times = 20.0 + np.arange(1001) / 200.0
    rates, forces = aircraft.truth(times)
    # At the pole the Earth turns about the vertical alone.
    earth = np.array([body_from_ned(*aircraft.angles_rad(t))[:, 2] for t in times.tolist()]) * -7.292115e-5
    found = passage(times, rates - earth, forces)
    turn = attitude(aircraft, 20.0).T @ attitude(aircraft, 25.0)
    assert math.degrees(math.acos((np.trace(turn) - 1.0) / 2.0)) > 3.0
    assert math.degrees(np.linalg.norm(turn - found.turn)) < 1e-3
    # The bias that is put in comes out as its derivatives say.
    bias = np.radians([0.05, -0.04, 0.03])
    biased = passage(times, rates - earth + bias, forces)
    corrected = rotations(-biased.turned @ bias) @ biased.turn
    assert math.degrees(np.linalg.norm(corrected - found.turn)) < 0.02 * math.degrees(np.linalg.norm(bias)) * 5.0
    change = biased.velocity_m_s + biased.velocity_by_bias @ bias - found.velocity_m_s
    assert np.linalg.norm(change) < 0.02 * np.linalg.norm(biased.velocity_m_s - found.velocity_m_s)


def test_the_fluid_follows_as_a_first_order_lag_does() -> None:
    model = GradienterModel("axis", np.eye(3), (0.0, 0.0), 0.01, lag_s=0.4)
    times = np.arange(4000) / 200.0
    roll = np.radians(5.0) * np.sin(2.0 * math.pi * 0.2 * times)
    forces = 9.8 * np.column_stack([np.zeros_like(roll), -np.sin(roll), -np.cos(roll)])
    shown = Fluid(model).follow(times, forces)[:, 0]
    phase = 2.0 * math.pi * 0.2 * 0.4
    expected = 5.0 / math.hypot(1.0, phase) * np.sin(2.0 * math.pi * 0.2 * times - math.atan(phase))
    assert np.abs(shown - expected)[1000:].max() < 0.01


def test_whitened_waves_are_white_and_their_mean_is_known_better() -> None:
    random = np.random.default_rng(7)
    off = []
    for _ in range(40):
        times = np.arange(200.0)
        wave = sum(np.sin(2.0 * math.pi * f * times + p) for f, p in random.uniform([0.15, 0.0], [0.25, 6.3], (12, 2)))
        series = wave + 0.05 * random.normal(size=200)
        white = whitened(np.column_stack([np.ones(200), series]), fit_waves([series - series.mean()]))
        information = white[:, 0] @ white[:, 0]
        assert information**-0.5 < 0.2 * series.std() / math.sqrt(200.0)
        off.append(white[:, 0] @ white[:, 1] / information * math.sqrt(information))
    assert np.square(off).mean() < 1.5


@pytest.mark.parametrize(
    ("voyage", "gyro_deg_h", "accel_mg"),
    [
        (Voyage(), 40.0, 1.0),
        (Voyage(waves=(Wave(0.1, 8.0),), turn_deg_s=-0.5, part="bmi088"), 60.0, 1.0),
    ],
    ids=["sea", "swell"],
)
def test_two_minutes_give_biases_within_what_is_claimed(voyage: Voyage, gyro_deg_h: float, accel_mg: float) -> None:
    for seed in range(3):
        found = sail(voyage, [120], seed)
        error, sigma = found.error[0] / UNITS, found.sigma[0] / UNITS
        assert np.abs(error / sigma).max() < 4.0
        assert np.abs(error[:3]).max() < gyro_deg_h
        assert np.abs(error[3:5]).max() < accel_mg
        assert sigma[:3].max() < gyro_deg_h


def test_what_goes_up_comes_down_and_the_vertical_accelerometer_is_known_by_it() -> None:
    found = [sail(Voyage(), [120], seed) for seed in range(20, 26)]
    error, sigma = (np.array([getattr(one, name)[0][5] for one in found]) / MG for name in ("error", "sigma"))
    assert sigma.max() < 0.06
    assert 0.25 < np.sqrt(np.square(error / sigma).mean()) < 1.6


@pytest.mark.parametrize("stuck", ["gradienter", "compass"])
def test_a_sensor_that_repeats_itself_on_a_swaying_deck_is_named(stuck: str) -> None:
    deck = Deck(*AROUND)
    deck.set_imu(ImuInput(name="imu", rotation=np.eye(3), profile=PROFILES["icm42688p"]))
    aircraft = VirtualAircraft(Pose(), Site(latitude_deg=45.0), motions=Voyage().motions(8))
    imu = ImuModel(aircraft, "icm42688p", seed=8)
    feed(deck, imu, 91, np.random.default_rng(8), 1.0)
    assert not isinstance(deck.work(range(1, 91)).run(), CalibrationRefusedError)
    for slot in range(65, 91):
        if stuck == "compass":
            deck._headings[slot] = deck._headings[65]
        else:
            level = deck._streams["imu"].levels[slot]
            first = deck._streams["imu"].levels[65].reading
            off = level.difference + first - level.reading
            deck._streams["imu"].levels[slot] = Level(first, off, level.slope)
    found = deck.work(range(1, 91)).run()
    assert isinstance(found, CalibrationRefusedError)
    assert str(found) == f"{stuck} is stuck: the same for 26 s while it sways"


def test_half_a_circle_leaves_no_part_of_the_earths_rate() -> None:
    # On the equator the Earth's rate lies in the horizon, and comes from ahead at first and from astern at last; near
    # the pole it stands upright. What else makes an error is the same at both.
    def error(latitude_deg: float) -> Array:
        voyage = Voyage(waves=(), turn_deg_s=1.5, part="perfect", gyro_axes_sigma=0.0, latitude_deg=latitude_deg)
        return np.array(sail(voyage, [120], 1).error[0][:2]) / DEG_H

    assert np.abs(error(0.0) - error(80.0)).max() < 0.3
    # And that is the gradienter's zero (1 sigma: 0.01 deg): so far the turn's axis is off.
    assert np.abs(error(0.0)).max() < 3.0 * math.radians(0.01) * 1.5 * 3600.0


class OfPairs(Deck):
    """All readings of its IMU, which lies turned by 90 degrees, are off by the same, and say how far about."""

    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    sigma = np.array([100.0, 0.0, 30.0, 5.0, 0.0, 2.0]) * UNITS

    def __init__(self, gradienter: GradienterModel, compass: CompassModel, seed: int) -> None:
        super().__init__(gradienter, compass)
        self.off = self.sigma * np.random.default_rng([seed, 8]).standard_normal(6)

    def set_imu(self, imu: ImuInput, batches: BatchSource | None = None, raw: BatchSource | None = None) -> None:
        super().set_imu(msgspec.structs.replace(imu, rotation=self.rotation))

    def take_imu(self, name: str, batch: Batch, times: Array, rows: Array) -> None:
        rows = np.hstack([rows[:, :3] @ self.rotation, rows[:, 3:] @ self.rotation]) + self.off
        found = msgspec.structs.replace(summary(batch.slot, times, rows), shared_variance=np.square(self.sigma))
        super().take_imu(name, found, times, rows)


def test_what_all_floats_have_wrong_in_common_is_in_sigma_as_large_as_it_is() -> None:
    voyage = Voyage(waves=(), turn_deg_s=0.0)
    runs = [sail(voyage, [30], seed, functools.partial(OfPairs, seed=seed)) for seed in range(16)]
    sigma = np.mean([run.sigma[0] for run in runs], axis=0) / UNITS
    ratio = np.sqrt(np.mean([np.square(run.error[0] / run.sigma[0]) for run in runs], axis=0))
    assert sigma[3:] == pytest.approx([0.15, 5.0, 2.0], abs=0.05)  # ahead of the aircraft is the sensor's second axis
    assert sigma[1] > 100.0 > 50.0 > sigma[0]
    assert ratio[[1, 2, 4, 5]] == pytest.approx(1.0, abs=0.4)


@pytest.mark.parametrize(
    ("voyage", "goal_deg_h", "least_s", "factor"),
    [(Voyage(turn_deg_s=0.0), 5.5, 90, 1.5), (Voyage(turn_deg_s=0.8), 13.0, 120, 2.5)],
    ids=["at its mooring", "turning"],
)
def test_the_time_that_is_said_is_the_time_it_takes(
    voyage: Voyage, goal_deg_h: float, least_s: int, factor: float
) -> None:
    """Within a factor, or a window: of a short turn nobody knows yet how much it will tell."""
    aircraft = VirtualAircraft(Pose(2.0, -1.0, 70.0), Site(latitude_deg=45.0), motions=voyage.motions(5))
    deck = Deck(*AROUND)
    deck.set_imu(ImuInput(name="imu", rotation=np.eye(3), profile=PROFILES["icm42688p"]))
    feed(deck, ImuModel(aircraft, "icm42688p", seed=5), 212, np.random.default_rng(5), 1.0)
    past: list[int] = []
    said: list[tuple[float, float, float]] = []
    for end in range(60, 211, 30 if least_s > 100 else 15):
        found = deck.work(range(1, 1 + end)).run()
        assert not isinstance(found, CalibrationRefusedError)
        past.append(end)
        said.append(aim(end, found[1][0], goal_deg_h * DEG_H))
        sigma, goal, _ = said[-1]
        if sigma <= goal:
            break
    done_s = past[-1]
    assert sigma <= goal
    assert done_s >= least_s
    for end, (_, _, whole_s) in zip(past, said[:-1], strict=False):
        left_s = done_s - end
        assert left_s / factor - 15.0 <= whole_s - end <= left_s * factor + 15.0, (end, whole_s, done_s)


def test_it_fits_into_one_statustext() -> None:
    seconds = (1, 55, 89, 91, 300, 1139)
    deg_h = [progress(sigma, goal, "deg/h") for sigma, goal in ((9.96, 5.0), (412.0, 6.13), (52.0, 49.6))]
    mg = [progress(sigma, goal, "mg") for sigma, goal in ((0.271, 0.2), (1.34, 0.051))]
    for left_s, words in itertools.product(seconds, deg_h + mg):
        assert len(f"{more(left_s)}: {words}") <= LINE_BYTES
    assert (more(1), more(55), more(89), more(91), more(300)) == (
        "some 10 s more", "some 60 s more", "some 90 s more", "some 2 min more", "some 5 min more",
    )  # fmt: skip
    assert deg_h == ["10 deg/h, goal 5.0", "412 deg/h, goal 6.1", "52 deg/h, goal 50"]
    assert mg == ["0.27 mg, goal 0.20", "1.3 mg, goal 0.05"]
