"""The IMU model's statistics against theory, and its bias against itself in other words."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sim.aircraft import Pose, VirtualAircraft
from sim.earth import Array
from sim.imu_model import DEG_H, MG, PARTS, AxisNoise, ImuModel, ImuSpec
from sim.scenario import demo
from sim.thermal import Curve, ThermalBoard
from tests.support.extent import extent


def allan_deviation(values: Array, count: int) -> float:
    """Non-overlapping, over groups of `count` readings."""
    groups = values[: len(values) // count * count].reshape(-1, count).mean(axis=1)
    return math.sqrt(0.5 * float(np.mean(np.diff(groups) ** 2)))


def expected_allan(noise: AxisNoise, tau_s: float) -> float:
    """White noise, the flat part of flicker, and random walk (IEEE 952)."""
    return math.sqrt(noise.white**2 / tau_s + (0.664 * noise.flicker) ** 2 + noise.walk**2 * tau_s / 3.0)


@pytest.mark.parametrize(
    "part",
    extent(whole=["icm42688p", "bmi088", "adis16470", "adis16405"], a_slice=["icm42688p", "adis16405"]),
)
def test_allan_deviation_of_named_parts(part: str) -> None:
    # Without rounding: at 4 readings a second it is too coarse to be dithered, which is another matter.
    spec = replace(PARTS[part], gyro=replace(PARTS[part].gyro, step=0.0), accel=replace(PARTS[part].accel, step=0.0))
    interval_s = 0.25
    times = np.arange(0.0, 3600.0, interval_s)
    readings = [ImuModel(VirtualAircraft(), spec, seed=seed).read(times, interval_s) for seed in range(4)]
    for axes, noise in (((0, 1, 2), spec.gyro), ((3, 4, 5), spec.accel)):
        for tau_s, tolerance in ((1.0, 0.03), (10.0, 0.05), (60.0, 0.10), (200.0, 0.20)):
            count = round(tau_s / interval_s)
            variances = [allan_deviation(one[:, axis], count) ** 2 for one in readings for axis in axes]
            found = math.sqrt(float(np.mean(variances)))
            assert found == pytest.approx(expected_allan(noise, tau_s), rel=tolerance), (part, axes, tau_s)


def test_white_noise_has_the_density_at_any_rate() -> None:
    for rate_hz in (10.0, 200.0):
        imu = ImuModel(VirtualAircraft(), "white_only", seed=5)
        readings = imu.read(np.arange(40_000) / rate_hz, 1.0 / rate_hz)
        found = readings.std(axis=0) / math.sqrt(rate_hz)
        assert found == pytest.approx(imu.white, rel=0.02)


def test_the_bias_does_not_depend_on_who_asks_when_and_how() -> None:
    asked_late, read_before = (ImuModel(VirtualAircraft(), "adis16405", seed=9) for _ in range(2))
    far = asked_late.true_bias(400.0)
    read_before.read(np.arange(0.0, 350.0, 0.37), 0.37)
    read_before.true_bias(3.3)
    assert read_before.true_bias(400.0).gyro_rad_s == pytest.approx(far.gyro_rad_s, abs=0.0)
    block = asked_late.expected_block(np.array([51.13, 51.27, 102.44]))
    for row, t_s in zip(block, (51.13, 51.27, 102.44), strict=True):  # around the seams of the stored blocks too
        assert row == pytest.approx(asked_late.expected(t_s), abs=1e-15)


def test_temperature_moves_the_bias_from_its_reference() -> None:
    imu = ImuModel(VirtualAircraft(temperature_degc=lambda t_s: 25.0 + t_s / 100.0), "white_only")
    assert imu.true_bias(500.0).gyro_rad_s == pytest.approx([0.0, 0.0, 0.0])
    spec = ImuSpec(
        name="warm",
        gyro=AxisNoise(white=0.0, per_kelvin=18.0 * DEG_H),
        accel=AxisNoise(white=0.0, per_kelvin=0.15 * MG),
        reference_degc=20.0,
    )
    warm = ImuModel(VirtualAircraft(temperature_degc=lambda t_s: 25.0 + t_s / 100.0), spec)
    assert warm.true_bias(500.0).gyro_rad_s == pytest.approx([180.0 * DEG_H] * 3)
    assert warm.expected_block(np.array([0.0, 500.0]))[1, 3] == pytest.approx(1.5 * MG)


def test_rounding_and_saturation() -> None:
    spec = ImuSpec(
        name="coarse",
        gyro=AxisNoise(white=0.0, step=0.01, limit=0.02),
        accel=AxisNoise(white=0.0, step=0.5, limit=9.0),
    )
    imu = ImuModel(VirtualAircraft(), spec, gyro_bias_rad_s=(0.0149, 0.0151, 5.0), accel_bias_m_s2=(0.26, -0.26, 0.0))
    assert imu.read(np.array([0.0]), 0.01)[0] == pytest.approx([0.01, 0.02, 0.02, 0.5, -0.5, -9.0])


def test_scale_misalignment_and_mounting_in_the_right_frames() -> None:
    aircraft = VirtualAircraft(Pose(0.0, 0.0, 0.0))
    gravity = aircraft.site.gravity_m_s2
    scaled = ImuModel(aircraft, "perfect", accel_scale=(0.0, 0.0, 0.01))
    assert scaled.expected(0.0)[3:] == pytest.approx([0.0, 0.0, -1.01 * gravity])
    turned = ImuModel(aircraft, "perfect", accel_misalignment_rad=(0.0, 0.001, 0.0))
    # A triad turned by +1 mrad about y has its x axis towards -z: it sees part of the upward force as positive.
    assert turned.expected(0.0)[3] == pytest.approx(0.001 * gravity, rel=1e-6)
    mounted = ImuModel(aircraft, "perfect", mounting_deg=(0.0, 0.0, 90.0), accel_bias_m_s2=(0.1, 0.0, 0.0))
    assert mounted.expected(0.0)[3:] == pytest.approx([0.1, 0.0, -gravity])
    assert mounted.true_bias_in_vehicle(0.0).accel_m_s2 == pytest.approx([0.0, 0.1, 0.0], abs=1e-15)


def test_a_piece_follows_its_own_curve_and_the_die_is_as_warm_as_its_thermometer_was_before() -> None:
    board = ThermalBoard(rise_k=20.0, time_constant_s=300.0)
    temperature = board.switched_on(5.0)
    assert [temperature(t_s) for t_s in (0.0, 1e6)] == pytest.approx([5.0, 25.0])
    assert board.switched_on(5.0, cold=0.0)(0.0) == pytest.approx(25.0)
    powers = tuple(np.full(6, value) for value in (2.0, 0.1, -0.003))
    imu = ImuModel(
        VirtualAircraft(temperature_degc=temperature), "perfect", thermometer_off_k=0.5, curve=Curve(powers, lag_s=20.0)
    )
    for t_s in (0.0, 20.0, 320.0):
        kelvin = 25.0 - 20.0 * math.exp(-max(t_s - 20.0, 0.0) / 300.0) - 25.0
        expected = 2.0 * kelvin + 0.1 * kelvin**2 - 0.003 * kelvin**3
        assert imu.true_bias(t_s).gyro_rad_s == pytest.approx([expected] * 3)
        assert imu.mean_bias(t_s, t_s).accel_m_s2 == pytest.approx([expected] * 3)
        assert imu.temperature_degc(t_s) == pytest.approx(temperature(t_s) + 0.5)


def test_power_ups_scatter_about_what_is_usual_for_a_piece_and_its_curve_stays() -> None:
    random = np.random.default_rng(3)
    usual = np.arange(6.0)
    pieces = [PARTS["bmi088"].piece(random, usual) for _ in range(200)]
    slopes = np.array([piece.curve.powers[0] for piece in pieces])
    assert slopes.std(axis=0) == pytest.approx([54.0 * DEG_H] * 3 + [0.2 * MG] * 3, rel=0.2)
    biases = np.array([pieces[0].turned_on(random) for _ in range(400)])
    assert biases.std(axis=0) == pytest.approx([60.0 * DEG_H] * 3 + [1.0 * MG] * 3, rel=0.15)
    assert biases.mean(axis=0) - usual == pytest.approx(np.zeros(6), abs=0.2 * MG)
    one, again = (demo(warms=(5.0, 20.0, 300.0), power_up=day) for day in (1, 2))
    first, second = (world.flight_controller_imus[0] for world in (one, again))
    assert first.temperature_degc(0.0) == 5.0
    assert np.array_equal(first.curve.powers, second.curve.powers)
    assert (first.true_bias(0.0).gyro_rad_s != second.true_bias(0.0).gyro_rad_s).all()
