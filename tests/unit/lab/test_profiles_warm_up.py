"""A warm-up that a profile learns: from logs that begin at the switch-on, into the sigma of the next ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.estimation.noise.allan import WARM_UP, WARM_UP_K, noise_profile
from companion.storage.profiles import ProfileStore
from sim.aircraft import VirtualAircraft
from sim.earth import Array
from sim.imu_model import DEG_H, MG, ImuModel
from sim.thermal import warming

TAU_S = 300.0


def log(path: Path, seconds: float, warms_by_k: float, seed: int, *, thermometer: bool) -> Path:
    """An ICM-42688-P (18 deg/h and 0.15 mg a kelvin) read 10 times a second."""
    aircraft = VirtualAircraft(temperature_degc=warming(25.0 - warms_by_k, 25.0, TAU_S))
    model = ImuModel(aircraft, "icm42688p", seed=seed)
    times = np.arange(0.05, seconds, 0.1)
    rows: Array = model.read(times, 0.1)
    degc = [[aircraft.temperature_degc(float(t_s))] if thermometer else [] for t_s in times]
    names = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2" + (",temperature_degc" if thermometer else "")
    table = np.column_stack([times, rows, np.array(degc).reshape(len(times), -1)])
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.9g")
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, Any]]:
    code = companion([*map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("thermometer", [False, True])
def test_a_warm_up_is_learned_saved_and_in_sigma(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], *, thermometer: bool
) -> None:
    warm = log(tmp_path / "warm.csv", 900.0, 0.0, 1, thermometer=thermometer)
    cold = log(tmp_path / "cold.csv", 1500.0, 10.0, 2, thermometer=thermometer)
    code, answer = run(capsys, "profile", warm, "--warm-up", cold, "--save", "mine", "--storage", tmp_path)
    assert code == 0, answer
    saved = ProfileStore(tmp_path).read("mine")
    assert saved.warm_up is not None
    # 10 K move it by 180 deg/h and 1.5 mg; where the thermometer says that it was 10, 20 K by twice that.
    times = WARM_UP_K / 10.0 if thermometer else 1.0
    assert saved.warm_up[0] == pytest.approx(180.0 * DEG_H * times, rel=0.2)
    assert saved.warm_up[1] == pytest.approx(1.5 * MG * times, rel=0.2)
    assert any(note.startswith("warming up moves gyros by") for note in answer["imus"][0]["notes"])
    short = log(tmp_path / "short.csv", 20.0, 0.0, 3, thermometer=False)
    assert run(capsys, "profile", warm, "--save", "plain", "--storage", tmp_path)[0] == 0
    plain, mine = (str(ProfileStore(tmp_path).path(name)) for name in ("plain", "mine"))
    sigmas = []
    for profile in (plain, mine):
        code, record = run(capsys, "replay", short, "--latitude-deg", "45", "--heading-deg", "0", "--profile", profile)
        assert code == 0
        sigmas.append(max(record["imus"][0]["gyro_sigma_warm_up_rad_s"]))
    assert noise_profile(saved.noise).warm_up == saved.warm_up
    assert saved.warm_up[0] < WARM_UP[0]
    assert sigmas[1] < sigmas[0]


def test_what_is_too_short_is_refused_and_nothing_learned_is_the_cautious_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    warm = log(tmp_path / "warm.csv", 400.0, 0.0, 1, thermometer=True)
    short = log(tmp_path / "short.csv", 300.0, 10.0, 2, thermometer=True)
    code, answer = run(capsys, "profile", warm, "--warm-up", short)
    assert code == 1
    assert "to see a warm-up takes 900 s from the switch-on" in answer["reason"]
    code, answer = run(capsys, "profile", warm)
    assert tuple(answer["imus"][0]["profile"]["warm_up"]) == pytest.approx(WARM_UP)
