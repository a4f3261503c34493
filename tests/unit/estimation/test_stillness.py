"""The gates: what passes, what does not, and what the pilot reads."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.estimation.collector.measurement import Stretch
from companion.estimation.noise.allan import noise_profile
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.estimation.stillness.gates import GateVerdict, ImuGate, PoseGate
from companion.physics.units import DEG, MG

Floats = NDArray[np.float64]
REST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -9.8])


def batch_of(rows: Floats, slot: int = 100, *, circle: bool = False) -> Batch:
    source = BatchSource((1e9,) * rows.shape[1], 4, circle=circle)
    source.add(slot - 0.1, tuple(rows[0].tolist()))
    for index, row in enumerate(rows):
        source.add(slot + (index + 0.5) / len(rows), tuple(row.tolist()))
    source.close_before(slot + 1.0)
    return source.batches[slot]


class Imu:
    """One gate, and seconds of made readings for it."""

    def __init__(
        self, rate_hz: int = 100, gyro: float = 0.05 * DEG, accel: float = 2.0 * MG, profile: str = ""
    ) -> None:
        self.rng = np.random.default_rng(7)
        self.rate_hz = rate_hz
        self.sigma = np.repeat([gyro, 2.0 * MG], 3)
        self.gate = ImuGate("fc", noise_profile(profile or None))
        self.time = np.arange(rate_hz)[:, None] / rate_hz

    def rows(self, motion: Floats | float = 0.0) -> Floats:
        return np.asarray(REST + motion + self.rng.normal(size=(self.rate_hz, 6)) * self.sigma)

    def second(self, motion: Floats | float = 0.0, *, accept: bool = True) -> GateVerdict:
        batch = batch_of(self.rows(motion))
        verdict = self.gate.judge(batch)
        if verdict.still and accept:
            self.gate.accept(batch)
        return verdict

    def sway(self, gyro: float = 0.0, accel: float = 0.0, hz: float = 2.0) -> Floats:
        """rms amplitudes on all axes of a triad."""
        wave = math.sqrt(2.0) * np.sin(2.0 * math.pi * hz * self.time + 0.4)
        return np.asarray(wave * np.repeat([gyro, accel], 3))


@pytest.mark.parametrize("rate_hz", [4, 10, 50, 400])
@pytest.mark.parametrize("gyro_noise_deg_s", [0.005, 0.05, 0.3])
def test_white_noise_of_any_size_and_rate_is_still(rate_hz: int, gyro_noise_deg_s: float) -> None:
    imu = Imu(rate_hz, gyro_noise_deg_s * DEG)
    verdicts = [imu.second() for _ in range(200)]
    assert sum(verdict.still for verdict in verdicts) >= 196


@pytest.mark.parametrize("rate_hz", [25, 100, 400])
def test_motion_is_seen_from_the_first_second_on_and_said_in_words(rate_hz: int) -> None:
    imu = Imu(rate_hz)
    verdict = imu.second(imu.sway(gyro=0.31 * DEG))
    assert not verdict.still
    what, found, unit, sign, allowed = verdict.words.rsplit(" ", 4)
    assert (what, unit, sign) == ("gyro fc moves", "deg/s,", "max")
    assert float(found) == pytest.approx(0.31, rel=0.1)
    assert 0.10 <= float(allowed) < 0.14
    verdict = imu.second(imu.sway(accel=30.0 * MG))
    assert verdict.words.startswith("accel fc ")
    assert " mg, max 1" in verdict.words


def test_wild_motion_does_not_widen_its_own_gate() -> None:
    imu = Imu()
    words = [imu.second(imu.sway(gyro=100.0 * DEG, hz=5.0)).words]
    for _ in range(5):
        assert imu.second().still
    words.append(imu.second(imu.sway(gyro=100.0 * DEG, hz=5.0)).words)
    allowed = [float(each.rsplit(" ", 1)[1]) for each in words]
    # What looks white in it may count as noise up to the vibration limit; once the noise is known, not even that.
    assert allowed[0] < 0.5
    assert allowed[1] < 0.12


def test_a_running_motor_is_not_rest() -> None:
    imu = Imu()
    rotors = np.where(np.arange(100) % 2, 1.0, -1.0)[:, None]  # aliased to half the rate: all of it looks white
    assert imu.second(rotors * [2.0 * DEG, 0, 0, 0, 0, 0]).words.startswith("gyro fc shakes 1.1")
    shaken = imu.second(rotors * [0, 0, 0, 0, 0, 2.0])
    assert shaken.words.startswith("accel fc shakes 11")
    assert shaken.words.endswith(" mg, max 50.00")


def test_a_warm_up_ramp_is_still_and_a_step_is_not() -> None:
    imu = Imu()
    ramp = 3.0 * DEG / 3600.0
    for second in range(60):
        assert imu.second(np.array([ramp * second, 0, 0, 0, 0, 0])).still
    step = imu.second(np.array([ramp * 60 + 0.12 * DEG, 0, 0, 0, 0, 0]))
    assert step.words.startswith("gyro fc moved by 0.1")


def test_a_slow_tilt_is_seen_against_the_start() -> None:
    imu = Imu()
    words = ""
    for second in range(60):
        # 0.01 deg/s of tilt: invisible to every gate within a second.
        verdict = imu.second(np.array([0, 0, 0, 9.8 * math.radians(0.01 * second), 0, 0]))
        words = words or verdict.words
    assert words.startswith("accel fc tilted by 5.")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda rows: rows * [1, 1, 1, 0.1, 0.1, 0.1], "accel fc reads 1.0 m/s^2, not gravity"),
        (lambda rows: np.round(rows * [0, 0, 0, 1, 1, 1], 9), "gyro fc is stuck: 100 equal readings"),
        (lambda rows: rows * [1, 1, 1, 0, 0, 0] + REST, "accel fc is stuck: 100 equal readings"),
        (lambda rows: rows[:3], "imu fc sends 3 Hz, needs 4"),
        (lambda rows: rows + np.array([30.0 * DEG, 0, 0, 0, 0, 0]), "gyro fc turns or is biased by 30.0"),
        (lambda rows: np.clip(rows * [1, 1, 1, 1, 1, 2.0], -19.6, None), "imu fc hits the end of its range"),
    ],
)
def test_a_broken_sensor_is_named(spoil: object, words: str) -> None:
    imu = Imu()
    verdict = imu.gate.judge(batch_of(spoil(imu.rows())))  # type: ignore[operator]
    assert not verdict.still
    assert words in verdict.words


def test_a_sway_that_turns_back_is_no_end_of_a_range() -> None:
    times = np.arange(200) / 200.0 - 0.5
    sway = np.outer(np.cos(1.2 * times), [0.0504, 0, 0, 0, 0, 0])
    rows = np.round((np.tile(REST, (200, 1)) + sway) / 1e-3) * 1e-3
    batch = batch_of(rows)
    assert batch.clipped
    assert not ImuGate("fc", noise_profile(None), (1e-3, 1e-3)).judge(batch).fault
    # 2 g is an end.
    shaken = np.tile(REST, (50, 1)) + np.random.default_rng(4).normal(0.0, 12.0, (50, 6)) * [0, 0, 0, 1, 1, 1]
    verdict = ImuGate("fc", noise_profile(None)).judge(batch_of(np.clip(shaken, -19.6, 19.6)))
    assert "hits the end of its range" in verdict.words


def test_a_quantised_constant_stream_is_not_stuck() -> None:
    gate = ImuGate("fc", noise_profile(None), (1e-3, 9.80665e-3))
    batch = batch_of(np.tile(REST, (50, 1)))
    for _ in range(10):
        assert gate.judge(batch).still
    toggling = np.tile(REST, (50, 1))
    toggling[::2, 0] += 1e-3
    assert gate.judge(batch_of(toggling)).still


def test_gradienter_gate() -> None:
    rng = np.random.default_rng(9)
    gate = PoseGate("gradienter")
    for _ in range(30):
        batch = batch_of(np.round(np.array([1.0, -2.0]) + rng.normal(0.0, 0.01, (10, 2)), 2))
        assert gate.judge(batch).still
        gate.accept(batch)
    swing = 0.3 * np.sin(np.arange(10) * 0.6)[:, None]
    assert gate.judge(batch_of(np.array([1.0, -2.0]) + swing)).words.startswith("gradienter moves 0.")
    moved = gate.judge(batch_of(np.tile([1.25, -2.0], (10, 1))))
    assert moved.words == "gradienter moved by 0.25 deg, max 0.10"
    gate.new_stretch()
    assert gate.judge(batch_of(np.tile([1.25, -2.0], (10, 1)))).still


def test_compass_gate_works_across_north() -> None:
    gate = PoseGate("compass")
    for heading in (359.8, 0.3, 359.9):
        batch = batch_of(np.mod(np.array([[-0.2], [0.2], [0.0], [0.1]]) + heading, 360.0), circle=True)
        assert gate.judge(batch).still
        gate.accept(batch)
    assert gate.judge(batch_of(np.full((4, 1), 4.0), circle=True)).words == "compass moved by 3.98 deg, max 3.00"
    turning = batch_of(np.array([[350.0], [354.0], [358.0], [2.0], [6.0]]), circle=True)
    assert gate.judge(turning).words.startswith("compass moves 5.")


def test_steady_seconds_are_those_since_the_last_bad_one() -> None:
    rng = np.random.default_rng(5)
    stretch = Stretch(min_good=4, max_slots=12)
    for slot in range(400):
        stretch.add(slot, good=bool(rng.random() < 0.93))
        flags = list(stretch.flags)
        bad = [place for place, good in enumerate(flags) if not good]
        assert stretch.steady == len(flags) - 1 - (bad[-1] if bad else -1)
