"""Free inertial navigation and the split of biases, against a flight whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.lab import inertial
from companion.lab.inertial import Increments, Navigation
from companion.physics.frames import rotations, running_products
from companion.physics.units import DEG, DEG_H, MG
from tests.support.flown import Flown, earth_rate, fly, gravity
from tests.support.made_noise import Floats

AIR = (70.0, 235.0)
NOTHING_KNOWN = [None] * 4
NOTHING = (np.zeros(3), np.zeros(3))
GYRO, ACCEL = np.array([300.0, -200.0, 100.0]) * DEG_H, np.array([3.0, -2.0, 4.0]) * MG


def navigation(flown: Flown, seed: int | None = None) -> Navigation:
    """The truth; or what an EKF makes of it: tilt 0.15 deg, heading 0.7 deg and 0.05 m/s off, for some 8 s each."""
    q, v = flown.quaternions, flown.velocity
    if seed is not None:
        rng = np.random.default_rng(seed)
        keep = np.exp(-0.04 / 8.0)
        white = rng.normal(size=(len(q), 6)) * np.sqrt(1.0 - keep**2)
        wandering = np.zeros((len(q), 6))
        state = rng.normal(size=6)
        for k in range(len(q)):
            state = keep * state + white[k]
            wandering[k] = state
        x, y, z = (0.5 * wandering[:, :3] * np.array([0.15, 0.15, 0.7]) * DEG).T
        w0, x0, y0, z0 = q.T
        q = np.column_stack(
            [w0 - x * x0 - y * y0 - z * z0, x0 + x * w0 + y * z0 - z * y0,
             y0 - x * z0 + y * w0 + z * x0, z0 + x * y0 - y * x0 + z * w0]
        )  # fmt: skip
        v = v + 0.05 * wandering[:, 3:]
    return Navigation(flown.at_s, q, v, flown.position, gravity(), earth_rate())


def of(flown: Flown) -> Increments:
    return inertial.increments(flown.t_s, flown.readings, means=True)


@pytest.fixture(scope="module")
def perfect() -> Flown:
    return fly()


def test_perfect_sensors_on_a_turning_earth_come_back_to_where_they_are(perfect: Flown) -> None:
    rows = inertial.drift(of(perfect), navigation(perfect), AIR, (10.0, 30.0, 60.0), {"flown": NOTHING})["flown"]
    assert [row.seconds for row in rows] == [10.0, 30.0, 60.0]
    assert [row.starts for row in rows] == [156, 136, 106]
    assert all(row.worst_m < limit for row, limit in zip(rows, (0.006, 0.024, 0.05), strict=True)), rows
    # An Earth that is taken to stand still: W g t^3 / 6 or so.
    resting = navigation(perfect)._replace(earth_rate_ned_rad_s=np.zeros(3))
    still = inertial.drift(of(perfect), resting, AIR, (60.0,), {"flown": NOTHING})
    assert 10.0 < still["flown"][0].median_m < 40.0


def test_a_cone_within_a_step_is_kept() -> None:
    """An axis that goes round twelve times a second turns the body, though every rate's mean is as good as zero."""
    t = np.arange(0.0, 10.0, 1.0 / 800.0)
    phase = 2.0 * np.pi * 12.0 * t
    body = Rotation.from_rotvec(1.0 * DEG * np.column_stack([np.cos(phase), np.sin(phase), 0.0 * t]))
    rates = (body[:-1].inv() * body[1:]).as_rotvec() * 800.0
    found = inertial.increments(t[1:], np.hstack([rates, np.zeros((len(rates), 3))]), means=True)
    turned = Rotation.from_matrix(running_products(rotations(found.angle))[-1])
    off_rad = (turned.inv() * body[1].inv() * body[-1]).magnitude()
    # By half a^2 w t it would be 6.6 deg.
    assert off_rad < 0.3 * DEG


def test_a_bias_drifts_as_by_hand_and_another_offset_takes_it_away(perfect: Flown) -> None:
    biased = fly(gyro_rad_s=GYRO, accel_m_s2=ACCEL)
    ground = (5.0, 62.0)
    offsets = {"flown": NOTHING, "right": (-GYRO, -ACCEL)}
    found = inertial.drift(of(biased), navigation(biased), ground, (30.0,), offsets)
    # Standing: half b t^2, and g w t^3 / 6 of what tilts, in the axes of the body, which lies within a degree.
    t = 30.0
    x = 0.5 * ACCEL[0] * t**2 - gravity() * GYRO[1] * t**3 / 6.0
    y = 0.5 * ACCEL[1] * t**2 + gravity() * GYRO[0] * t**3 / 6.0
    z = 0.5 * ACCEL[2] * t**2
    assert found["flown"][0].median_m == pytest.approx(float(np.linalg.norm([x, y, z])), rel=0.02)
    assert found["right"][0].median_m < 0.02
    in_air = inertial.drift(of(biased), navigation(biased), AIR, (30.0,), offsets)
    own = inertial.drift(of(perfect), navigation(perfect), AIR, (30.0,), {"flown": NOTHING})
    assert in_air["right"][0].median_m == pytest.approx(own["flown"][0].median_m, abs=0.02)
    assert in_air["flown"][0].median_m > 40.0


def test_the_delay_of_filters_is_found(perfect: Flown) -> None:
    late = of(perfect)._replace(t_s=of(perfect).t_s + 0.012)
    assert inertial.lag_s(late, navigation(perfect)) == pytest.approx(0.012, abs=0.0002)
    # A heading that is found anew, by 30 degrees, is no delay.
    anew = navigation(perfect)
    turned = Rotation.from_euler("z", np.where(anew.t_s > 150.0, 30.0, 0.0)[:, None], degrees=True)
    q = (turned * Rotation.from_quat(anew.attitude[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    assert inertial.lag_s(late, anew._replace(attitude=q)) == pytest.approx(0.012, abs=0.0002)


def levels(count: int) -> Floats:
    return np.full(count, 3.0)


def test_what_motors_add_is_found_with_an_honest_sigma() -> None:
    """Twelve flights with an EKF that wanders: within two sigma in 19 of 20 cases, and not for being wide."""
    step = 4.0 * MG
    misses: list[float] = []
    sigmas: list[float] = []
    flown = fly(gyro_rad_s=GYRO, accel_m_s2=ACCEL, step_m_s2=step, rate_hz=50.0, white=(20.0 * DEG_H, 0.1 * MG))
    found = of(flown)
    zeros = np.zeros((len(flown.at_s), 3))
    still = navigation(flown)._replace(
        attitude=np.tile(flown.quaternions[0], (len(flown.at_s), 1)), velocity=zeros, position=zeros
    )
    before = inertial.windows(found, still, (35.0, 64.0), inertial.SHORT_S)
    for seed in range(12):
        air = inertial.windows(found, navigation(flown, seed), AIR, inertial.LENGTH_S)
        for k, axis in enumerate(inertial.split(before, air, levels(len(air)), NOTHING_KNOWN, NOTHING_KNOWN)):
            assert axis.in_flight is not None
            assert axis.turn_on is not None
            assert axis.motors is not None
            assert axis.trend is not None
            # Vibration that does not vary shows no slope, and without a curve nothing is known of temperature.
            assert axis.vibration is None
            assert axis.temperature is None
            bias = GYRO[k] if k < 3 else ACCEL[2]
            added = 0.0 if k < 3 else step
            for term, truth in ((axis.in_flight, bias + added), (axis.motors, added), (axis.trend, 0.0)):
                misses.append(abs(term.value - truth) / term.sigma)
            sigmas.append(axis.motors.sigma / (DEG_H if k < 3 else MG))
    assert np.mean(np.array(misses) < 2.0) >= 0.95
    assert np.mean(sigmas[3::4]) < 0.5
    assert np.mean(sigmas[0::4]) < 40.0


def test_what_the_data_do_not_carry_is_not_known(perfect: Flown) -> None:
    assert all(
        axis.in_flight is None and axis.motors is None
        for axis in inertial.split(inertial.NO_WINDOWS, inertial.NO_WINDOWS, None, NOTHING_KNOWN, NOTHING_KNOWN)
    )
    air = inertial.windows(of(perfect), navigation(perfect), (70.0, 115.0), inertial.LENGTH_S)
    for axis in inertial.split(inertial.NO_WINDOWS, air, None, NOTHING_KNOWN, NOTHING_KNOWN):
        assert axis.in_flight is not None
        assert axis.turn_on is None
        assert axis.motors is None
        assert axis.trend is None
