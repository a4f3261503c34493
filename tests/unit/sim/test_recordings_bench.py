"""The bench on recordings: its figures for noise whose truth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from companion.lab.still_log import HEADER
from companion.physics.units import DEG, DEG_H, MG, G
from sim.accuracy import recordings as bench

RATE_HZ, SECONDS, WHITE = 64, 240, (40.0 * DEG_H, 0.2 * MG)


def write(path: Path, seed: int, *, turning_deg_s: float = 0.0) -> None:
    rng = np.random.default_rng(seed)
    t_s = np.arange(SECONDS * RATE_HZ + 1) / RATE_HZ
    noise = rng.normal(0.0, np.repeat(WHITE, 3) * np.sqrt(RATE_HZ), (len(t_s), 6))
    readings = noise + np.array([0.01, -0.02, 0.005, 0.0, 0.0, -G])
    readings[:, 0] += turning_deg_s * DEG * np.sin(4.0 * t_s)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.column_stack([t_s, readings]), delimiter=",", header=HEADER, comments="")


def rows(capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    return [line.split() for line in capsys.readouterr().out.splitlines()]


def test_white_noise_is_covered_and_no_worse_than_its_mean(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "white/one.csv", 1)
    write(tmp_path / "white/moving/hand.csv", 2, turning_deg_s=2.0)
    assert bench.main([str(tmp_path)]) == 0
    head, *found = rows(capsys)
    assert head[:2] == ["part", "profile"]
    gyro = {row[2]: row for row in found if row[:2] == ["white", "default"]}
    assert set(gyro) == {"10", "30", "60"}
    *_, windows, refused, cover, ratio, rms, unit, of_mean, naive = gyro["10"]
    assert (windows, refused, unit) == ("24", "0.0%", "deg/h")
    assert float(cover.rstrip("%")) >= 90.0
    assert float(ratio) < 1.0
    # N / sqrt(T) of the window, and of the truth of 60 to 180 s beside it.
    assert float(rms) == pytest.approx(40.0 * np.sqrt(1 / 10.0 + 1 / 150.0), rel=0.25)
    assert float(of_mean) == pytest.approx(1.0, abs=0.02)
    assert float(naive.rstrip("%")) >= 85.0
    assert "moving: 0 of 239 s judged still" in " ".join(found[-2])


@pytest.mark.parametrize(("told", "words"), [
    ('profile = "bmi099"', "no noise profile 'bmi099'"),
    ("rate = 100", "unknown field `rate`"),
    ("profile =", "Invalid value"),
])  # fmt: skip
def test_what_part_toml_says_wrong_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], told: str, words: str
) -> None:
    write(tmp_path / "white/one.csv", 1)
    (tmp_path / "white/part.toml").write_text(told)
    assert bench.main([str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(str(tmp_path / "white"))
    assert words in line


def test_an_empty_folder_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main([str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"{tmp_path}: found no folder in it; allowed: one folder for each part\n"
