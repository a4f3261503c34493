"""Turns on a spot counted by gyros, against how the simulator's hands have turned the aircraft."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.estimation.seconds.counting import Counted, TurnCounter
from companion.physics.frames import rotation_matrix
from companion.samples import ImuSample
from sim.aircraft import Pose, VirtualAircraft
from sim.hands import Hands
from sim.imu_model import ImuModel
from sim.motions import Handling
from sim.scenario import site_at

BEGIN_S, END_S = 2.0, 10.0
BIAS_DEG_S = (1.0, -2.0, 0.52)
YAW_90 = rotation_matrix("ROTATION_YAW_90")


def counted(
    turn_deg: float = 180.0,
    *,
    rate_hz: float = 100.0,
    tilted_deg: float = 4.0,
    hole_s: float = 0.0,
    hole_at_s: float = 5.5,
    stamps_s: float = 0.0,
    has_clock: bool = True,
    cut_rad_s: float = 0.0,
    waits_s: int = 0,
    seed: int = 0,
) -> Counted | None:
    """Turned on a slope of 5 deg between 3 and 9 s by hands that tilt it; gyros turned by 90 deg in the aircraft."""
    aircraft = VirtualAircraft(Pose(4.0, -3.0, 70.0), site_at(47.0, 11.0, 600.0))
    imu = ImuModel(
        aircraft,
        "icm42688p",
        seed=seed,
        gyro_bias_rad_s=np.radians(BIAS_DEG_S).tolist(),
        mounting_deg=(0.0, 0.0, 90.0),
    )
    hands = Hands(aircraft, seed=seed)
    assert hands.turn(3.0, turn_deg) < END_S
    aircraft.add(
        Handling(start_s=3.0, duration_s=6.0, angle_deg=math.sqrt(max(tilted_deg**2 - 16.0, 0.0)), seed=99 + seed)
    )
    counter = TurnCounter()
    rng = np.random.default_rng(seed)
    for second in range(1, 12 + waits_s):
        times = second + (np.arange(rate_hz) + 0.5) / rate_hz
        rows = imu.read(times, 1.0 / rate_hz)
        rows = np.trunc(rows / cut_rad_s) * cut_rad_s if cut_rad_s else rows
        kept = np.abs(times - hole_at_s) >= hole_s / 2.0
        stamps = 500.0 + times + rng.normal(0.0, stamps_s, len(times))
        for t_s, stamp_s, row in zip(times[kept].tolist(), stamps[kept].tolist(), rows[kept].tolist(), strict=True):
            counter.add(sample(t_s, stamp_s if has_clock else None, row))
    bias = YAW_90 @ np.radians(BIAS_DEG_S)
    return counter.counted(BEGIN_S, END_S + waits_s, bias, YAW_90, cut_rad_s)


def sample(t_s: float, device_s: float | None, row: list[float]) -> ImuSample:
    return ImuSample(t_s, (row[0], row[1], row[2]), (0.0, 0.0, 0.0), None, None, device_s)


def off_deg(found: Counted | None, turn_deg: float = 180.0) -> float:
    assert found is not None
    return math.degrees(found.angle_rad) - turn_deg


@pytest.mark.parametrize("turn_deg", [180.0, -180.0, 90.0, 200.0, 360.0])
def test_any_turn_is_counted_the_way_it_went(turn_deg: float) -> None:
    found = counted(turn_deg)
    # A slope is no axis askew: what is counted is the turn of the base on its spot.
    assert off_deg(found, turn_deg) == pytest.approx(0.0, abs=0.1)
    assert found is not None
    assert math.degrees(found.sigma_rad) == pytest.approx(0.15, abs=0.03)


@pytest.mark.parametrize("seed", range(4))
def test_hands_that_tilt_it_far_on_the_way_cost_little(seed: int) -> None:
    """Rates about down alone would miss it by degrees."""
    assert abs(off_deg(counted(tilted_deg=12.0, seed=seed))) < 0.3


def test_few_samples_and_stamps_that_scatter_are_in_the_sigma() -> None:
    off, sigma = [], []
    for seed in range(24):
        found = counted(rate_hz=10.0, stamps_s=0.005, seed=seed)
        off.append(off_deg(found))
        assert found is not None
        sigma.append(math.degrees(found.sigma_rad))
    assert np.mean(sigma) > 0.2
    assert np.mean(np.abs(off) < 2.0 * np.array(sigma)) > 0.85


@pytest.mark.parametrize(("hole_s", "is_counted"), [(0.03, True), (0.08, False)])
@pytest.mark.parametrize("has_clock", [True, False])
def test_a_turn_with_a_hole_is_not_counted(hole_s: float, *, is_counted: bool, has_clock: bool) -> None:
    assert (counted(hole_s=hole_s, has_clock=has_clock) is not None) == is_counted


@pytest.mark.parametrize(("hole_s", "is_counted"), [(0.4, True), (0.6, False)])
def test_while_it_stands_only_a_hole_that_can_hide_a_turn_matters(hole_s: float, *, is_counted: bool) -> None:
    assert (counted(hole_s=hole_s, hole_at_s=13.5, waits_s=10) is not None) == is_counted


def test_integers_that_are_cut_off_count_as_well_however_long_it_stands() -> None:
    """SCALED_IMU's thousandths: 0.03 deg/s are lost while it turns, and another part of one while it stands."""
    assert off_deg(counted(cut_rad_s=1e-3, waits_s=60)) == pytest.approx(0.0, abs=0.1)


def test_a_second_copy_of_a_sample_does_not_count_and_a_device_that_began_anew_tells_nothing() -> None:
    counter = TurnCounter()
    assert counter.counted(0.0, 1.0, np.zeros(3), np.eye(3)) is None
    for k in range(1000):
        for _ in range(1 + (k % 3 == 0)):
            counter.add(sample(k / 100.0, 700.0 + k / 100.0, [0.0, 0.0, 0.1]))
    once = counter.counted(1.0, 9.0, np.zeros(3), np.eye(3))
    assert once is not None
    assert once.angle_rad == pytest.approx(0.8, abs=0.002)
    for k in range(1000, 2000):
        counter.add(sample(k / 100.0, (k - 1500) % 1000 / 100.0, [0.0, 0.0, 0.1]))
    assert counter.counted(11.0, 14.0, np.zeros(3), np.eye(3)) is not None
    assert counter.counted(11.0, 19.0, np.zeros(3), np.eye(3)) is None
    assert counter.counted(1.0, 9.0, np.zeros(3), np.eye(3)) is None, "let go"


@pytest.mark.parametrize(("pace", "sigma_rad"), [(0.5, None), (0.97, 0.019), (0.0, 0.003)])
def test_clocks_that_disagree_on_the_pace_are_in_the_sigma_or_tell_nothing(
    pace: float, sigma_rad: float | None
) -> None:
    """Clocks of a simulated firmware on a busy computer; a clock that stands still is invalid."""
    counter = TurnCounter()
    for k in range(1000):
        counter.add(sample(k / 100.0, 700.0 + pace * k / 100.0, [0.0, 0.0, 0.1]))
    found = counter.counted(1.0, 9.0, np.zeros(3), np.eye(3))
    assert (found is None) == (sigma_rad is None)
    if found is not None:
        assert found.sigma_rad == pytest.approx(sigma_rad, rel=0.1)
        assert found.angle_rad == pytest.approx(0.8, abs=2.0 * found.sigma_rad)
