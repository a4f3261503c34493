"""Readings that no bias explains are named, and never a bias: axes, units, sizes; by the gates, the estimate, a log."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.estimation.stillness.plausible import implausible, misplaced, unit_of_force
from companion.physics.frames import body_from_ned, rotation_matrix
from companion.rotations import ROTATIONS_DEG
from sim.aircraft import Pose, VirtualAircraft
from sim.earth import Array
from sim.imu_model import DEG_H, MG, ImuModel
from sim.scenario import site_at

G = 9.80665
REMEDY, ACCEPTS = "--mounting {}", "--any-bias"
WHERE = ("--pitch-deg", "5", "--roll-deg", "-3", "--heading-deg", "40", "--latitude-deg", "40", "--height-m", "50")
RIGHT_ANGLES = [name for name, angles in ROTATIONS_DEG.items() if all(angle % 90.0 == 0.0 for angle in angles)]


def force(pitch_deg: float, roll_deg: float) -> Array:
    return np.asarray(body_from_ned(math.radians(roll_deg), math.radians(pitch_deg), 0.7) @ [0.0, 0.0, -G])


@pytest.mark.parametrize("mounting", RIGHT_ANGLES)
def test_the_mounting_that_is_named_brings_gravity_where_it_is(mounting: str) -> None:
    """A sensor that is mounted so and taken for one in the vehicle's axes; a pose that tells all mountings apart."""
    expected = force(8.0, -14.0)
    sensed = rotation_matrix(mounting).T @ expected + np.array([60.0, -80.0, 50.0]) * MG
    words = misplaced("imu", sensed, expected, np.eye(3), REMEDY)
    if math.degrees(math.acos(float(sensed @ expected) / np.linalg.norm(sensed) / G)) < 45.0:
        assert words is None or "YAW" in mounting
        return
    assert words is not None
    named = words.rpartition(" ")[2]
    assert np.linalg.norm(rotation_matrix(named) @ sensed - expected) < 0.2 * G


def test_one_that_is_mounted_wrongly_already_is_told_the_whole_mounting() -> None:
    """Mounted ROLL_180 and configured YAW_90: what has to stand there is ROLL_180, not what would have to be added."""
    expected = force(6.0, -9.0)
    configured, real = rotation_matrix("ROTATION_YAW_90"), rotation_matrix("ROTATION_ROLL_180")
    words = misplaced("imu", configured @ real.T @ expected, expected, configured, REMEDY)
    assert words is not None
    assert words.endswith("--mounting ROTATION_ROLL_180")


def test_what_really_lies_so_and_what_parts_really_have_is_believed() -> None:
    for pitch_deg, roll_deg in ((0.0, 180.0), (10.0, 170.0), (0.0, 90.0), (5.0, -90.0), (-60.0, 20.0)):
        expected = force(pitch_deg, roll_deg)
        for sign in (-1.0, 1.0):
            biased = expected + sign * np.array([0.1, -0.1, 0.1]) * G
            assert implausible("imu", np.full(3, 0.05), biased, expected, np.eye(3), REMEDY, ACCEPTS) == {}


@pytest.mark.parametrize("deg", [90, 180, 270])
@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(5.0, 0.0), (0.0, -3.0), (2.0, 2.0), (-8.0, 3.0)])
def test_a_tilt_sensor_turned_about_z_is_named(deg: int, pitch_deg: float, roll_deg: float) -> None:
    """A bias of its own, 20 mg, hides the turn from nobody; the wrong offsets would be twice the slope."""
    real = force(pitch_deg, roll_deg)
    taken = rotation_matrix(f"ROTATION_YAW_{deg}").T @ real
    biased = real + np.array([6.0, -8.0, 10.0]) * MG
    found = implausible("imu", np.zeros(3), biased, taken, np.eye(3), REMEDY, ACCEPTS)
    assert found["accel"] == f"accel imu: reads as if the gradienter were turned by {deg} deg more about z"


def test_a_bias_beyond_any_parts_is_named_by_triad() -> None:
    expected = force(0.0, 0.0)
    biased = expected + np.array([0.0, 0.32, 0.0]) * G
    found = implausible("imu", np.zeros(3), biased, expected, np.eye(3), REMEDY, ACCEPTS)
    assert list(found) == ["accel"]
    assert "0.32 g on y" in found["accel"]
    assert found["accel"].endswith("--any-bias")
    found = implausible("imu", np.radians([0.0, 0.0, -57.0]), expected, expected, np.eye(3), REMEDY, ACCEPTS)
    assert list(found) == ["gyro"]
    assert "57 deg/s on z" in found["gyro"]


def test_the_unit_of_gravity_is_known_by_its_size() -> None:
    assert [unit_of_force(size) for size in (1.0, 999.0, 32.2, 9.8, 4.0, 0.0)] == ["g", "mg", "ft/s^2", "", "", ""]


# ------------------------------------------------------------------------------------------------ through the commands


def log(tmp_path: Path, turn: Array) -> Path:
    """Write 20 s of a still ADIS16470 whose axes are turned."""
    model = ImuModel(
        VirtualAircraft(Pose(5.0, -3.0, 40.0), site_at(40.0, 116.0, 50.0)),
        "adis16470",
        seed=2,
        gyro_bias_rad_s=[100.0 * DEG_H, -60.0 * DEG_H, 30.0 * DEG_H],
        accel_bias_m_s2=[2.0 * MG, -3.0 * MG, 1.0 * MG],
    )
    times = 3.0 + np.arange(2000) / 100.0
    rows = model.read(times, 0.01)
    data = np.column_stack([times, rows[:, :3] @ turn.T, rows[:, 3:] @ turn.T])
    path = tmp_path / "log.csv"
    path.write_text(
        "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2\n"
        + "\n".join(",".join(f"{value:.9g}" for value in row) for row in data)
        + "\n",
        encoding="utf-8",
    )
    return path


def replay(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "replay", str(path), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_a_log_whose_z_points_up_is_refused_with_the_mounting_that_mends_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = log(tmp_path, rotation_matrix("ROTATION_ROLL_180"))
    code, record = replay(capsys, path, *WHERE)
    assert (code, record["state"]) == (1, "failed")
    assert "z points up, by the tilt z points down: --mounting ROTATION_ROLL_180" in record["reason"]
    assert all(imu["accel_bias_m_s2"] is None for imu in record["imus"])
    code, record = replay(capsys, path, *WHERE, "--mounting", "ROTATION_ROLL_180")
    assert (code, record["state"]) == (0, "done")
    assert np.abs(record["imus"][0]["accel_bias_m_s2"]).max() < 10.0 * MG
    code, record = replay(capsys, path, *WHERE, "--any-bias")
    assert (code, record["state"]) == (0, "done")
    assert record["imus"][0]["accel_bias_m_s2"][2] == pytest.approx(2.0 * G, rel=0.02)
