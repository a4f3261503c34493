"""Accelerometers from the length of gravity: against the simulator's aircraft, held in any way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.faces import BIAS, SCALE, SHEAR, Face, FacesEstimate, faces, missing, seen_before
from companion.estimation.alignment.poses import PoseRequest
from companion.physics.frames import rotation_matrix
from companion.physics.units import MG
from sim.aircraft import Pose, VirtualAircraft
from sim.scenario import site_at
from tests.support.extent import extent

Floats = NDArray[np.float64]

SITE = site_at(40.0, 116.0, 50.0)
NOISE = 0.02 * MG
HELD: dict[str, tuple[float, float]] = {
    "level": (0, 0),
    "on its back": (0, 180),
    "nose up": (90, 0),
    "nose down": (-90, 0),
    "left side down": (0, -90),
    "right side down": (0, 90),
}
EDGES = [(45, 0), (-45, 0), (0, 45), (0, -135), (45, 90), (-45, 90)]
TWELVE = [*HELD.values(), *EDGES]
"""Pitch and roll, degrees."""


class Sensor:
    """A triad with bias, scale and shear, read while somebody holds the aircraft by hand."""

    def __init__(self, seed: int = 0, noise_m_s2: float = NOISE) -> None:
        self.rng = np.random.default_rng(seed)
        self.noise = noise_m_s2
        self.truth = self.rng.normal(size=9) * np.repeat([20.0 * MG, 0.006, 0.004], 3)
        sx, sy, sz, xy, xz, yz = self.truth[3:]
        self.response = np.array([[1 + sx, xy, xz], [xy, 1 + sy, yz], [xz, yz, 1 + sz]])

    def up(self, pitch_deg: float, roll_deg: float, by_hand_deg: float = 5.0) -> Floats:
        pitch, roll = self.rng.normal(size=2) * by_hand_deg
        aircraft = VirtualAircraft(Pose(pitch_deg + pitch, roll_deg + roll, self.rng.uniform(0.0, 360.0)), SITE)
        return np.asarray(aircraft.truth_at(0.0).force_m_s2)

    def read(self, force_m_s2: Floats) -> Face:
        noise = self.rng.normal(size=3) * self.noise
        return (self.response @ force_m_s2 + self.truth[BIAS] + noise, np.full(3, max(self.noise, 1e-6)))

    def held(self, poses: list[tuple[float, float]]) -> list[Face]:
        return [self.read(self.up(*pose)) for pose in poses]


def solved(stands: list[Face]) -> FacesEstimate:
    return faces(stands, SITE.gravity_m_s2, 3e-4)


def test_readings_without_noise_give_every_figure() -> None:
    sensor = Sensor(1, noise_m_s2=0.0)
    found = faces(sensor.held(TWELVE), SITE.gravity_m_s2, 0.0)
    np.testing.assert_allclose(found.figures[BIAS] / MG, sensor.truth[BIAS] / MG, atol=1e-4)
    np.testing.assert_allclose(found.figures[3:], sensor.truth[3:], atol=1e-7)
    assert found.left_out == found.in_doubt == ()


def test_the_stated_sigma_covers_the_error_and_is_small() -> None:
    off = []
    for seed in range(extent(whole=600, a_slice=200)):
        sensor = Sensor(seed)
        found = solved(sensor.held(TWELVE))
        assert not found.left_out
        off.append((found.figures - sensor.truth) / found.sigma)
        assert found.sigma[BIAS].max() < 0.03 * MG
        assert found.sigma[SCALE].max() < 1e-4
    covered = (np.abs(off) < 2.0).mean()
    assert 0.93 <= covered <= 0.98


def test_what_stands_do_not_tell_keeps_the_sigma_of_before() -> None:
    level = solved(Sensor(2).held([(0, 0)]))
    assert level.sigma[BIAS].min() > 20.0 * MG
    six = solved(Sensor(2).held(list(HELD.values())))
    assert six.sigma[SHEAR].min() > 1e-3, "six faces tell no shear"
    assert solved(Sensor(2).held(TWELVE)).sigma[SHEAR].max() < 1e-4


def test_a_stand_given_twice_adds_nothing_and_is_known_again() -> None:
    sensor = Sensor(3)
    poses = list(HELD.values())[:4]
    stands = sensor.held(poses)
    before = solved(stands)
    again = sensor.read(sensor.up(*poses[2]))
    up = np.linalg.solve(sensor.response, again[0] - sensor.truth[BIAS])
    assert seen_before(before, up / np.linalg.norm(up), np.eye(3)) == 2
    assert seen_before(before, np.array([0.0, 1.0, 0.0]), np.eye(3)) is None
    # Two stands that are 5 deg apart tell a little, and no more than that.
    assert solved([*stands, again]).sigma[BIAS].max() > 0.5 * before.sigma[BIAS].max()


@pytest.mark.parametrize("off_mg", [3.0, -10.0])
def test_a_wrong_stand_is_named_and_left_out(off_mg: float) -> None:
    named = wrong = 0
    for seed in range(40):
        sensor = Sensor(seed)
        stands = sensor.held(TWELVE)
        bad = seed % 12
        up = stands[bad][0] / np.linalg.norm(stands[bad][0])
        stands[bad] = (stands[bad][0] + off_mg * MG * up, stands[bad][1])
        found = solved(stands)
        named += found.left_out == (bad,)
        wrong += bool(found.left_out) and found.left_out != (bad,)
        assert found.left_out or bad in found.in_doubt, "it does not go unseen"
        if found.left_out == (bad,):
            assert (np.abs(found.figures - sensor.truth) < 5.0 * found.sigma).all()
            assert found.off_m_s2[bad] / MG == pytest.approx(off_mg, rel=0.3)
    assert named >= 34
    assert wrong <= 1


@pytest.mark.parametrize("seed", range(20))
def test_a_wrong_stand_among_the_asked_ones_does_not_end_the_alignment(seed: int) -> None:
    """Every fit on the way goes through, also where the others without one pose are no gravity."""
    sensor, bad = Sensor(seed), seed % 11
    found = solved(obeying(sensor, np.eye(3), {bad: 10.0 * MG})[1])
    assert found.left_out == (bad,)
    assert (np.abs(found.figures - sensor.truth) < 5.0 * found.sigma).all()


def test_scatter_beyond_the_sigmas_widens_them() -> None:
    sensor = Sensor(6)
    poses = [*TWELVE, *((30.0 * k, 47.0 * k) for k in range(20))]
    stands = sensor.held([(float(pitch), float(roll)) for pitch, roll in poses])
    honest = solved(stands)
    proud = solved([(stand[0], stand[1] / 5.0) for stand in stands])
    assert not proud.left_out
    np.testing.assert_allclose(proud.sigma[BIAS], honest.sigma[BIAS], rtol=0.5)


def test_what_the_biases_do_until_they_are_used_widens_theirs_alone() -> None:
    stands = Sensor(7).held(TWELVE)
    now = solved(stands)
    later = faces(stands, SITE.gravity_m_s2, 3e-4, wander_m_s2=np.full(3, 0.5 * MG))
    np.testing.assert_allclose(later.sigma[BIAS], np.hypot(now.sigma[BIAS], 0.5 * MG))
    np.testing.assert_array_equal(later.sigma[3:], now.sigma[3:])


def test_readings_that_are_no_gravity_are_refused() -> None:
    stands = [(np.array(force), np.full(3, NOISE)) for force in ((30.0, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.2))]
    with pytest.raises(CalibrationRefusedError, match="no gravity"):
        solved(stands)


@pytest.mark.parametrize("mounting", ["ROTATION_NONE", "ROTATION_YAW_90", "ROTATION_ROLL_180_YAW_45"])
def test_it_says_which_stand_is_missing_until_nothing_is(mounting: str) -> None:
    """The words are of the aircraft, however its sensor is mounted; who obeys them is done within twelve stands."""
    sensor = Sensor(8)
    obeyed, stands = obeying(sensor, rotation_matrix(mounting))
    assert len(set(obeyed)) == len(obeyed)
    assert set(obeyed[:6]) == set(HELD)
    assert 11 <= len(obeyed) <= 12
    found = solved(stands)
    assert (np.abs(found.figures - sensor.truth)[:6] < 4.0 * found.sigma[:6]).all()


def obeying(sensor: Sensor, turned: Floats, off_m_s2: Mapping[int, float] = {}) -> tuple[list[str], list[Face]]:
    """Return the sides asked for, and what is read there; `off_m_s2`: error of gravity's length in these stands."""
    obeyed: list[str] = []
    stands: list[Face] = []
    wish: PoseRequest | None = PoseRequest("level")
    while wish is not None:
        obeyed.append(wish.words.partition(":")[0])
        force, sigma = sensor.read(turned.T @ sensor.up(*_middle(obeyed[-1])))
        stands.append((force * (1.0 + off_m_s2.get(len(stands), 0.0) / SITE.gravity_m_s2), sigma))
        wish = missing(solved(stands), turned)
    return obeyed, stands


def _middle(side: str) -> tuple[float, float]:
    """Pitch and roll of a side, or half-way to a second one: "on its back with nose half up"."""
    other, _, half = side.rpartition(" with ")
    names = [other or "level", half.replace(" half", "")] if " half " in half else [side]
    up = np.zeros(3)
    for name in names:
        pitch, roll = np.radians(HELD[name])
        up += [np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)]
    up /= np.linalg.norm(up)
    return float(np.degrees(np.arcsin(up[0]))), float(np.degrees(np.arctan2(-up[1], -up[2])))


def test_where_every_side_has_been_seen_a_side_may_be_held_again() -> None:
    """Else it would ask for a side, and refuse it, for ever."""
    sensor, turned = Sensor(11), np.eye(3)
    stands = sensor.held([(pitch, roll) for pitch in range(-90, 91, 45) for roll in range(-180, 180, 45)])
    # So noisy that something stays open.
    stands = [(one[0], 100.0 * one[1]) for one in stands]
    found = solved(stands)
    wish = missing(found, turned)
    assert wish is not None
    up = sensor.up(*_middle(wish.words.partition(":")[0]))
    assert seen_before(found, up / np.linalg.norm(up), turned) is None
