"""Level without a gradienter: the simulator's aircraft turned on a spot, and how its board sits."""

from __future__ import annotations

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.alignment.align import Alignment, Complaint, in_words, turned
from companion.estimation.alignment.align_model import Ground, PoseMeans
from companion.estimation.alignment.faces import Sides, faces, mounting
from companion.physics.frames import rotation_matrix
from companion.physics.units import DEG, DEG_H, MG
from sim.aircraft import Pose, VirtualAircraft
from sim.hands import Hands
from sim.imu_model import ImuModel
from sim.scenario import site_at
from tests.support.windows import imu_means

Floats = NDArray[np.float64]

SITE = site_at(47.0, 11.0, 600.0)
G = SITE.gravity_m_s2
HALF = (0.0, 180.0, 360.0)
QUARTERS = (0.0, 90.0, 180.0, 270.0)
TWELVE = [
    (90, 0),
    (-90, 0),
    (0, -90),
    (0, 90),
    (0, 180),
    (0, 0),
    (45, 0),
    (-45, 0),
    (0, 45),
    (0, -135),
    (45, 90),
    (-45, 90),
]
BOARD_DEG = (1.2, -0.8, 0.0)
SIGMA = 0.02 * MG


def model(aircraft: VirtualAircraft, board_deg: tuple[float, float, float] = BOARD_DEG) -> ImuModel:
    return ImuModel(
        aircraft,
        "perfect",
        accel_bias_m_s2=(np.array([25.0, -40.0, 12.0]) * MG).tolist(),
        accel_scale=(0.004, -0.006, 0.003),
        gyro_bias_rad_s=(np.array([120.0, -80.0, 60.0]) * DEG_H).tolist(),
        mounting_deg=board_deg,
    )


def on_spot(
    slope_deg: tuple[float, float], headings_deg: tuple[float, ...], *, counted: float = 1.0
) -> list[PoseMeans]:
    """Stands without noise; headings counted by a gyro whose scale is `counted`."""
    aircraft = VirtualAircraft(Pose(slope_deg[0], slope_deg[1], 70.0), SITE)
    hands, imu, stands, t_s = Hands(aircraft), model(aircraft), [], 0.0
    for k, heading in enumerate(headings_deg):
        if k:
            t_s = hands.turn(t_s, heading - headings_deg[k - 1])
        read = imu.expected(t_s + 1.0)
        means = imu_means(read[:3], 5.0 * DEG_H, read[3:], SIGMA)
        sigma_rad = (0.15 if k else 0.01) * DEG
        turned_rad = heading * counted * DEG
        stands.append(PoseMeans((means,), None, (1.0, 1.0), turned_rad, sigma_rad, on_spot=True, counted=k > 0))
    return stands


def solved(stands: list[PoseMeans]) -> Alignment:
    across = 7.292115e-5 * math.cos(47.0 * DEG)
    rate = np.array([0.0, 0.0, -7.292115e-5 * math.sin(47.0 * DEG)])
    return turned(stands, Ground(G, 3e-4, rate, np.diag([across**2 / 2.0, across**2 / 2.0, 1e-18])))


def level_bias() -> Floats:
    aircraft = VirtualAircraft(Pose(), SITE)
    return np.asarray(model(aircraft).expected(0.0)[3:] + np.array([0.0, 0.0, G]))


@pytest.mark.parametrize("headings", [HALF, QUARTERS], ids=["half", "quarters"])
@pytest.mark.parametrize("slope_deg", [(0.0, 0.0), (0.4, -0.3), (3.0, 4.0), (-5.0, 0.0)])
def test_level_bias_and_slope_are_found_on_any_slope(
    slope_deg: tuple[float, float], headings: tuple[float, ...]
) -> None:
    found = solved(on_spot(slope_deg, headings))
    assert found.complaint is None
    assert found.checked
    # What the priors of bias and board leave of it is far below what marks can do; they alone, with half a turn, share
    # what the cosine of the slope takes of bias and lean.
    atol = 0.05 if headings == QUARTERS else 0.07
    np.testing.assert_allclose(found.imus[0].level_bias_m_s2[:2] / MG, level_bias()[:2] / MG, atol=atol)
    steepest = math.degrees(math.acos(math.cos(slope_deg[0] * DEG) * math.cos(slope_deg[1] * DEG)))
    assert found.slope_deg == pytest.approx(steepest, abs=0.03)
    sigma = np.sqrt(np.diag(found.imus[0].level_covariance_m2_s4))[:2] / MG
    # Two headings leave it open how the board leans across the slope (3 deg, one sigma): 0.18 mg more.
    assert sigma.max() < (0.26 if headings == QUARTERS or max(map(abs, slope_deg)) < 1.0 else 0.31)


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["clockwise", "anticlockwise"])
def test_a_whole_circle_tells_how_wrong_a_gyro_counts(way: float) -> None:
    """1.5 % of half a turn is 2.7 deg: 2 mg on 5 deg of slope, if it were believed."""
    for headings in (HALF, QUARTERS):
        imu = solved(on_spot((5.0, 0.0), tuple(way * each for each in headings), counted=1.015)).imus[0]
        assert np.abs(imu.level_bias_m_s2 - level_bias())[:2].max() / MG < 0.05


def test_half_a_turn_and_back_leaves_the_gyros_scale_open_and_the_sigma_says_so() -> None:
    imu = solved(on_spot((5.0, 0.0), (0.0, 180.0, 0.0), counted=1.015)).imus[0]
    off = np.abs(imu.level_bias_m_s2 - level_bias())[:2]
    sigma = np.sqrt(np.diag(imu.level_covariance_m2_s4))[:2]
    assert (off < 2.0 * sigma).all()
    assert sigma.max() > 0.7 * MG


def test_a_turn_that_the_stands_contradict_is_named() -> None:
    stands = on_spot((5.0, 0.0), QUARTERS)
    for k in (2, 3):
        stands[k] = dataclasses.replace(stands[k], heading_rad=stands[k].heading_rad + 12.0 * DEG)
    found = solved(stands)
    assert found.complaint is not None
    said = in_words(found.complaint, gradienter=False)
    assert said.startswith("pose 3: it was not turned as the gyros say, off by 12 deg")


def held(board_deg: tuple[float, float, float], orientation: str = "ROTATION_NONE") -> Sides:
    stands = []
    for k, (pitch, roll) in enumerate(TWELVE):
        aircraft = VirtualAircraft(Pose(pitch + 3.0 * math.sin(k), roll + 4.0 * math.cos(k), 30.0 * k), SITE)
        # In the sensor's axes, as `ImuModel` gives them.
        stands.append((model(aircraft, board_deg).expected(0.0)[3:], np.full(3, SIGMA)))
    found = faces(stands, G, 0.0)
    return Sides(found.figures, found.sigma, rotation_matrix(orientation))


def test_the_boards_tilt_is_found_on_a_slope() -> None:
    found = solved(on_spot((3.0, -4.0), QUARTERS))
    board = mounting(found.imus[0], held(BOARD_DEG), G)
    # The board is turned against the base: level looks as if the aircraft were tilted the other way round.
    level = rotation_matrix(BOARD_DEG).T @ np.array([0.0, 0.0, -1.0])
    assert board.roll_rad / DEG == pytest.approx(math.degrees(math.atan2(-level[1], -level[2])), abs=0.003)
    assert board.pitch_rad / DEG == pytest.approx(math.degrees(math.asin(level[0])), abs=0.003)
    assert board.sigma_rad.max() / DEG < 0.03


def test_the_orientation_of_a_turned_board_is_taken_off() -> None:
    """The autopilot sends in the aircraft's axes; `faces` is in the sensor's."""
    orientation = rotation_matrix("ROTATION_YAW_90")
    known = held((0.0, 0.0, 0.0))
    level = solved(on_spot((1.0, 1.0), QUARTERS)).imus[0]
    bias, scale = known.figures[:3], known.figures[3:6]
    tilt = np.array([math.sin(2.0 * DEG), 0.0, -math.cos(2.0 * DEG)])
    read = orientation @ ((1.0 + scale) * (orientation.T @ tilt * G) + bias)
    nose_up = dataclasses.replace(level, level_bias_m_s2=read + np.array([0.0, 0.0, G]))
    board = mounting(nose_up, msgspec.structs.replace(known, vehicle_from_sensor=orientation), G)
    assert board.pitch_rad / DEG == pytest.approx(2.0, abs=1e-3)
    assert board.roll_rad / DEG == pytest.approx(0.0, abs=1e-3)


def test_the_covariance_of_the_tilt_is_that_of_what_it_is_made_of() -> None:
    """Against drawing biases and readings at random."""
    level, known = solved(on_spot((0.5, 0.0), QUARTERS)).imus[0], held(BOARD_DEG)
    said = mounting(level, known, G).sigma_rad
    rng = np.random.default_rng(4)
    drawn = []
    for _ in range(400):
        figures = rng.normal(known.figures, known.sigma)
        bias = rng.multivariate_normal(level.level_bias_m_s2, level.level_covariance_m2_s4)
        one = mounting(
            dataclasses.replace(level, level_bias_m_s2=bias), msgspec.structs.replace(known, figures=figures), G
        )
        drawn.append([one.roll_rad, one.pitch_rad])
    np.testing.assert_allclose(np.std(drawn, axis=0), said, rtol=0.15)


def test_without_a_gradienter_none_is_blamed() -> None:
    loose = Complaint(("accelerometer", 2, "fc"), 7.0, 3.0 * MG)
    assert "gradienter" in in_words(loose)
    assert in_words(loose, gradienter=False).startswith("pose 2: imu fc is off by 3.0 mg (7 sigma): is something loose")
