"""The attitude estimator against the simulator's truth and against rotations written out by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.attitude.estimator import Attitude, AttitudeEstimator, AttitudeSettings, Phase
from companion.attitude.strapdown import HEADING_UNKNOWN_RAD
from companion.estimation.noise.allan import noise_profile
from companion.physics.units import DEG, DEG_H, MG
from companion.samples import ImuSample
from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import body_from_ned, mounting_matrix
from sim.flight import BankedCircles, MovingAircraft, Shuttle
from sim.imu_model import ImuModel
from tests.support.extent import extent

NORTH = Site(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0, declination_deg=3.0)
SOUTH = Site(latitude_deg=-33.0, longitude_deg=151.0, height_m=0.0, declination_deg=12.0)
GYRO = noise_profile("icm42688p").gyro
SURE = np.diag([0.05, 0.05, 1.0]) ** 2 * DEG**2


def settings(site: Site = NORTH, **changes: object) -> AttitudeSettings:
    known = AttitudeSettings(
        vehicle_from_sensor=np.eye(3),
        gravity_m_s2=site.gravity_m_s2,
        latitude_deg=site.latitude_deg,
        gyro_noise=GYRO,
        gyro_bias_rad_s=(0.0, 0.0, 0.0),
        gyro_covariance=np.eye(3) * (5.0 * DEG_H) ** 2,
        accel_bias_m_s2=(0.0, 0.0, 0.0),
        accel_sigma_m_s2=(0.2 * MG,) * 3,
    )
    return dataclasses.replace(known, **changes)  # type: ignore[arg-type]


def samples(
    imu: ImuModel, until_s: float, *, since_s: float = 0.0, rate_hz: float = 200.0
) -> Iterator[list[ImuSample]]:
    """Batches of a quarter of a second; each sample is the mean over the interval that its time ends."""
    step = 1.0 / rate_hz
    count = round(0.25 * rate_hz)
    at = since_s
    while at < until_s - 1e-9:
        times = at + step * np.arange(count, dtype=np.float64)
        readings = imu.read(times + 0.5 * step, step).tolist()
        yield [
            ImuSample(float(time) + step, (a, b, c), (d, e, f))
            for time, (a, b, c, d, e, f) in zip(times, readings, strict=True)
        ]
        at += count * step


def error_deg(found: Attitude, aircraft: VirtualAircraft) -> tuple[float, float]:
    """Tilt and heading error, by the turn that is left between truth and estimate in NED."""
    w, x, y, z = found.quaternion
    left = Rotation.from_quat([x, y, z, w]) * Rotation.from_matrix(aircraft.body_from_ned(found.t_s))
    north, east, down = left.as_rotvec(degrees=True)
    return math.hypot(north, east), abs(down)


def follow(
    estimator: AttitudeEstimator,
    imu: ImuModel,
    until_s: float,
    *,
    phase: Phase = "flight",
    rate_hz: float = 200.0,
    **how: object,
) -> list[tuple[float, float]]:
    errors = []
    for batch in samples(imu, until_s, rate_hz=rate_hz):
        estimator.update(batch, phase=phase, **how)  # type: ignore[arg-type]
        found = estimator.attitude()
        assert found is not None
        errors.append(error_deg(found, imu.aircraft))
    return errors


def rms(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


@pytest.mark.parametrize("rate_hz", extent(whole=[50.0, 200.0, 1000.0], a_slice=[50.0, 200.0]))
def test_a_perfect_imu_gives_the_perfect_attitude(rate_hz: float) -> None:
    aircraft = MovingAircraft(Shuttle(start_s=1.0), Pose(2.0, 9.52, 300.0), SOUTH)
    estimator = AttitudeEstimator(settings(SOUTH))
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    errors = follow(estimator, ImuModel(aircraft, "perfect"), 60.0, rate_hz=rate_hz)
    # The heading has nothing but the rates, the Earth's rotation included.
    assert max(heading for _, heading in errors) < 0.005
    # The leveller takes the accelerations for tilt, a little.
    assert max(tilt for tilt, _ in errors) < 0.5


def test_the_earth_turns_below_an_aircraft_at_rest() -> None:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0), NORTH)
    for latitude_deg, expected_deg in ((48.0, 0.0), (None, 15.04 * math.sin(48.0 * DEG) / 6.0)):
        estimator = AttitudeEstimator(settings(NORTH, latitude_deg=latitude_deg))
        estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
        errors = follow(estimator, ImuModel(aircraft, "perfect"), 600.0, rate_hz=10.0)
        assert errors[-1][1] == pytest.approx(expected_deg, abs=0.005)


@pytest.mark.parametrize("mounting_deg", [(180.0, 0.0, 90.0), (10.0, -20.0, 135.0)])
def test_the_sensor_may_sit_in_any_way(mounting_deg: tuple[float, float, float]) -> None:
    aircraft = MovingAircraft(BankedCircles(start_s=1.0), Pose(0.0, 0.0, 90.0), NORTH)
    imu = ImuModel(
        aircraft, "perfect", mounting_deg=mounting_deg, gyro_bias_rad_s=(1e-3, -2e-3, 3e-3), accel_bias_m_s2=(0.1, 0, 0)
    )
    gyro, accel = imu.true_bias_in_vehicle(0.0)
    estimator = AttitudeEstimator(
        settings(
            vehicle_from_sensor=mounting_matrix(*mounting_deg),
            gyro_bias_rad_s=tuple(gyro.tolist()),
            accel_bias_m_s2=tuple(accel.tolist()),
        )
    )
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    errors = follow(estimator, imu, 30.0)
    assert max(heading for _, heading in errors) < 0.02
    assert estimator.gyro_bias_rad_s == pytest.approx(gyro, abs=1e-12)
    found = estimator.attitude()
    assert found is not None
    rate = aircraft.truth_at(found.t_s).rate_rad_s - aircraft.body_from_ned(found.t_s) @ earth_rate(NORTH)
    assert found.rate_rad_s == pytest.approx(rate, abs=1e-3)


def earth_rate(site: Site) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    latitude = site.latitude_deg * DEG
    return 7.292115e-5 * np.array([math.cos(latitude), 0.0, -math.sin(latitude)])


@pytest.mark.parametrize(
    ("route", "limit_deg"), [(BankedCircles(start_s=1.0), 0.4), (Shuttle(start_s=1.0), 0.4)], ids=["circles", "shuttle"]
)
def test_tilt_in_flight_stays_below_what_usual_filters_lose(route: BankedCircles | Shuttle, limit_deg: float) -> None:
    aircraft = MovingAircraft(route, Pose(0.0, 0.0, 35.0), NORTH)
    imu = ImuModel(aircraft, seed=3, gyro_bias_rad_s=(5 * DEG_H, -5 * DEG_H, 5 * DEG_H))
    estimator = AttitudeEstimator(settings())
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    errors = follow(estimator, imu, 120.0)
    assert rms([tilt for tilt, _ in errors]) < limit_deg


def test_the_ground_levels_what_was_aligned_wrongly() -> None:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0), NORTH)
    estimator = AttitudeEstimator(settings())
    estimator.align(0.0, body_from_ned(*np.radians([-1.0, 3.0, 40.0])), np.eye(3) * (3.0 * DEG) ** 2)
    errors = follow(estimator, ImuModel(aircraft, seed=1), 30.0, phase="ground")
    assert errors[0][0] > 2.0
    assert errors[-1][0] < 0.05
    found = estimator.attitude()
    assert found is not None
    assert max(found.sigma_rad[:2]) < 0.5 * DEG


def test_rest_finds_what_is_left_of_the_gyro_bias() -> None:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0), SOUTH)
    left = (60 * DEG_H, -40 * DEG_H, 80 * DEG_H)
    imu = ImuModel(aircraft, seed=2, gyro_bias_rad_s=left)
    estimator = AttitudeEstimator(settings(SOUTH, gyro_covariance=np.eye(3) * (60.0 * DEG_H) ** 2))
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    follow(estimator, imu, 60.0, phase="ground", still=True)
    # 30 deg/h is 4 sigma of the ICM-42688-P over a minute, and twice the Earth's rate.
    assert estimator.gyro_bias_rad_s == pytest.approx(left, abs=15 * DEG_H)


# ----------------------------------------------------------------------------------------------------- the compass


@pytest.mark.parametrize("heading_deg", [0.0, 179.9, 180.1, 359.9])
@pytest.mark.parametrize("site", [NORTH, SOUTH], ids=["north", "south"])
def test_a_compass_finds_true_north(site: Site, heading_deg: float) -> None:
    aircraft = VirtualAircraft(Pose(8.0, -12.0, heading_deg), site)
    estimator = AttitudeEstimator(settings(site))
    wrong = body_from_ned(-12.0 * DEG, 8.0 * DEG, (heading_deg + 5.0) * DEG)
    estimator.align(0.0, wrong, np.diag([0.05, 0.05, 5.0]) ** 2 * DEG**2)
    for number, batch in enumerate(samples(ImuModel(aircraft, "perfect"), 60.0, rate_hz=50.0)):
        estimator.update(batch, phase="ground")
        assert estimator.add_heading(number * 0.25, heading_deg * DEG, 1.0 * DEG) == (number > 0)
    found = estimator.attitude()
    assert found is not None
    assert error_deg(found, aircraft)[1] < 0.05
    assert -math.pi <= found.yaw_rad <= math.pi
    # However often a compass is read, its own error stays.
    assert 0.8 * DEG < found.sigma_rad[2] < 1.3 * DEG


def test_a_heading_from_a_wild_compass_is_refused_and_named() -> None:
    aircraft = VirtualAircraft(Pose(0.0, 0.0, 350.0), NORTH)
    estimator = AttitudeEstimator(settings())
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    for number, batch in enumerate(samples(ImuModel(aircraft, "perfect"), 30.0, rate_hz=50.0)):
        estimator.update(batch, phase="ground")
        assert not estimator.add_heading(number * 0.25, 30.0 * DEG, 1.0 * DEG)
    compass = estimator.compass
    assert compass.refused_for_s(30.0) > 25.0
    assert estimator.add_heading(29.9, 352.0 * DEG, 1.0 * DEG)
    assert compass.refused_for_s(30.0) == 0.0


def test_a_compass_that_turns_is_not_followed() -> None:
    """At 3 deg/s, within the gate: in 3 s a correction over 9 s has turned by 3 t - 27 (1 - exp(-t / 9)) = 1.3 deg."""
    aircraft = VirtualAircraft(Pose(0.0, 0.0, 350.0), NORTH)
    estimator = AttitudeEstimator(settings(gyro_covariance=np.eye(3) * (80.0 * DEG_H) ** 2))
    estimator.align(0.0, aircraft.body_from_ned(0.0), np.diag([0.05, 0.05, 2.0]) ** 2 * DEG**2)
    for number, batch in enumerate(samples(ImuModel(aircraft, "perfect"), 33.0)):
        estimator.update(batch, phase="flight")
        lies_deg = 3.0 * max(0.0, number * 0.25 - 30.0)
        assert estimator.add_heading(number * 0.25, (350.0 + lies_deg) * DEG, 2.0 * DEG) == (number > 0)
    found = estimator.attitude()
    assert found is not None
    assert error_deg(found, aircraft)[1] < 2.0
    assert 1.8 * DEG < found.sigma_rad[2] < 2.6 * DEG


def test_an_unknown_heading_is_taken_from_the_first_reading() -> None:
    aircraft = VirtualAircraft(Pose(0.0, 0.0, 200.0), NORTH)
    estimator = AttitudeEstimator(settings())
    estimator.align(0.0, body_from_ned(0.0, 0.0, 0.0), np.diag([1e-6, 1e-6, HEADING_UNKNOWN_RAD**2]))
    follow(estimator, ImuModel(aircraft, "perfect"), 1.0, phase="ground")
    known_before = estimator.heading_known
    assert estimator.add_heading(0.9, 200.0 * DEG, 1.0 * DEG)
    assert (known_before, estimator.heading_known) == (False, True)
    found = estimator.attitude()
    assert found is not None
    assert error_deg(found, aircraft)[1] < 1.0


# ----------------------------------------------------------------------------------------------------- every direction


@pytest.mark.parametrize("site", [NORTH, SOUTH, Site(90.0, 0.0), Site(-90.0, 0.0), Site(0.0, 0.0)])
@pytest.mark.parametrize("pitch_deg", [-90.0, -89.9, 0.0, 89.9, 90.0])
def test_straight_up_at_the_poles_and_anywhere_nothing_jumps(site: Site, pitch_deg: float) -> None:
    aircraft = VirtualAircraft(Pose(pitch_deg, 0.0, 0.0), site)
    estimator = AttitudeEstimator(settings(site))
    estimator.align(0.0, aircraft.body_from_ned(0.0), SURE)
    before: Attitude | None = None
    for batch in samples(ImuModel(aircraft, seed=5), 5.0, rate_hz=100.0):
        estimator.update(batch, phase="flight")
        found = estimator.attitude()
        assert found is not None
        assert all(map(math.isfinite, (*found.quaternion, *found.sigma_rad, found.roll_rad, found.yaw_rad)))
        assert math.hypot(*found.quaternion) == pytest.approx(1.0, abs=1e-12)
        assert error_deg(found, aircraft)[0] < 0.1
        if before is not None:
            assert abs(sum(a * b for a, b in zip(found.quaternion, before.quaternion, strict=True))) > 1.0 - 1e-6
        before = found


# ----------------------------------------------------------------------------------------------------- what goes wrong


def aligned() -> AttitudeEstimator:
    estimator = AttitudeEstimator(settings())
    estimator.align(0.0, np.eye(3), SURE)
    return estimator


def at(t_s: float) -> ImuSample:
    return ImuSample(t_s, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))


def test_without_an_alignment_there_is_no_attitude() -> None:
    estimator = AttitudeEstimator(settings())
    estimator.update([at(0.1), at(0.2)], phase="ground")
    assert estimator.attitude() is None
    assert not estimator.aligned
    assert not estimator.add_heading(0.1, 0.0, 0.1)


def test_a_gap_is_bridged_and_owned_up_to() -> None:
    whole, holed = aligned(), aligned()
    for estimator, skipped in ((whole, range(0)), (holed, range(200, 300))):
        estimator.update([at(0.005 * n) for n in range(1, 401) if n not in skipped], phase="flight")
    a, b = whole.attitude(), holed.attitude()
    assert a is not None
    assert b is not None
    assert b.sigma_rad[2] > a.sigma_rad[2] + 5.0 * DEG


def test_after_a_long_silence_there_is_no_attitude_until_the_next_alignment() -> None:
    estimator = aligned()
    estimator.update([at(0.1), at(5.0), at(5.1)], phase="ground")
    assert estimator.attitude() is None
    assert not estimator.aligned
    estimator.align(5.1, np.eye(3), SURE)
    estimator.update([at(5.2)], phase="ground")
    assert estimator.attitude() is not None


@pytest.mark.parametrize("spoil", [lambda: (1e308,) * 3, lambda: (99.0, -99.0, 99.0)], ids=["huge", "fast"])
def test_nothing_in_a_sample_makes_it_raise(spoil: Callable[[], tuple[float, float, float]]) -> None:
    estimator = aligned()
    for number in range(1, 400):
        estimator.update([ImuSample(number * 0.01, spoil(), spoil())], phase="flight")
        estimator.attitude()
