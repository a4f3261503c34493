"""Logs of an aircraft on a boat, made from a simulated sea: solved as a deck, or told what to say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from companion.cli import main as companion
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import SlowTurn
from sim.scenario import site_at
from sim.sea import DAY_S, SWELL, Sea
from tests.support.autopilot_files import write_dataflash

RATE_HZ, SECONDS, TILT_EVERY = 50, 132, 5
GYRO_DEG_H, ACCEL_MG = (600.0, -300.0, 150.0), (6.0, -4.0, 2.0)
SIGMAS = ("--sigma-deg", "0.01", "--heading-sigma-deg", "1")
PLACE = ("--latitude-deg", "45", "--height-m", "100", "--profile", "icm42688p")


@pytest.fixture(scope="module")
def boat(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ImuModel]:
    motions = [
        Sea(start_s=-20.0, waves=SWELL, seed=3),
        SlowTurn(start_s=-20.0, duration_s=DAY_S, rate_deg_s=0.3),
    ]
    aircraft = VirtualAircraft(Pose(2.0, -1.0, 40.0), site_at(45.0, 10.0, 100.0), motions=motions)
    imu = ImuModel(
        aircraft,
        "icm42688p",
        seed=3,
        gyro_bias_rad_s=[value * DEG_H for value in GYRO_DEG_H],
        accel_bias_m_s2=[value * MG for value in ACCEL_MG],
    )
    random = np.random.default_rng(4)
    times = np.arange(SECONDS * RATE_HZ) / RATE_HZ
    readings = imu.read(times, 1.0 / RATE_HZ)
    shown = times[::TILT_EVERY]
    tilts = Gradienter(aircraft).tilt_deg(shown) + random.normal(size=(len(shown), 2)) * 0.001
    headings = np.degrees([aircraft.angles_rad(t_s)[2] for t_s in shown.tolist()])
    headings = (headings + random.normal(size=len(shown)) * 0.3) % 360.0
    lines = ["t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2,tilt_x_deg,tilt_y_deg,heading_deg"]
    for at, (t_s, row) in enumerate(zip(times.tolist(), readings.tolist(), strict=True)):
        beside = ["", "", ""]
        if at % TILT_EVERY == 0:
            x, y = tilts[at // TILT_EVERY].tolist()
            beside = [f"{x:.3f}", f"{y:.3f}", f"{headings[at // TILT_EVERY]:.1f}"]
        lines.append(",".join([f"{t_s:.3f}", *(f"{value:.8f}" for value in row), *beside]))
    path = tmp_path_factory.mktemp("logs") / "boat.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path, imu


@pytest.fixture(scope="module")
def log(boat: tuple[Path, ImuModel]) -> Path:
    return boat[0]


def test_a_log_of_a_boat_is_solved_as_a_deck(boat: tuple[Path, ImuModel], capsys: pytest.CaptureFixture[str]) -> None:
    log, model = boat
    assert companion(["replay", str(log), "--platform", "deck", *SIGMAS, *PLACE, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    imu, truth = record["imus"][0], model.mean_bias(SECONDS, SECONDS + 120.0)
    for bias, sigma, true, least in (
        ("gyro_bias_rad_s", "gyro_sigma_use_rad_s", truth.gyro_rad_s, 40.0 * DEG_H),
        ("accel_bias_m_s2", "accel_sigma_use_m_s2", truth.accel_m_s2, 1.0 * MG),
    ):
        found, sigmas = np.array(imu[bias]), np.array(imu[sigma])
        assert (np.abs(found - true) < 3.5 * sigmas).all(), (found, true, sigmas)
        assert (sigmas < least).all()
    assert record["log"]["to_s"] - record["log"]["from_s"] >= 120.0


def test_the_same_log_as_ground_names_the_option(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert companion(["replay", str(log), *PLACE]) == 1
    said = capsys.readouterr().out
    assert "; on a boat? --platform deck" in said
    assert "vehicle.platform" not in said


def test_less_than_a_minute_is_too_little(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / "short.csv"
    short.write_text("".join(log.read_text().splitlines(keepends=True)[: 60 * RATE_HZ + 1]), encoding="utf-8")
    assert companion(["replay", str(short), *PLACE, "--platform", "deck"]) == 1
    # The second in which a stream begins does not count.
    assert "no 60 s without a gap in it: the longest is 59 s, without its first" in capsys.readouterr().out


def test_a_heading_that_stands_still_is_no_decks(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert companion(["replay", str(log), "--platform", "deck", "--heading-deg", "40"]) == 2
    assert capsys.readouterr().err.strip() == (
        "--heading-deg: found --platform deck; allowed: tilt and heading in the log, no windows"
    )


def test_an_autopilots_log_has_nothing_that_tells_a_turn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = np.arange(500) / 50.0
    path = write_dataflash(tmp_path / "00000007.BIN", {0: (times, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.8], (500, 1)))})
    assert companion(["replay", str(path), "--platform", "deck"]) == 1
    assert "neither tilt nor heading in it" in capsys.readouterr().err
