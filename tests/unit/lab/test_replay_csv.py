"""A user's own log of an IMU at rest against the truth of a simulated one; one clear line for every mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.lab.still_log import read_csv
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.scenario import site_at

POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
GYRO_DEG_H = (162.0, -98.0, 40.0)
ACCEL_MG = (2.4, -2.1, 0.9)
GOOD = "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2\n"


def rows(seconds: float = 60.0, rate_hz: int = 200) -> tuple[np.ndarray, ImuModel]:
    """(n, 7): time and readings of a simulated IMU in SI units, and the IMU."""
    model = ImuModel(
        VirtualAircraft(POSE, site_at(40.0, 116.0, 50.0)),
        "adis16470",
        seed=2,
        gyro_bias_rad_s=[value * DEG_H for value in GYRO_DEG_H],
        accel_bias_m_s2=[value * MG for value in ACCEL_MG],
    )
    times = 3.0 + np.arange(round(seconds * rate_hz)) / rate_hz
    return np.column_stack([times, model.read(times, 1.0 / rate_hz)]), model


def written(path: Path, data: np.ndarray) -> Path:
    lines = [",".join(f"{value:.9g}" for value in row) for row in data]
    path.write_text(GOOD + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def replay(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "replay", str(path), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def test_what_is_not_said_widens_sigma_and_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, model = rows(30.0)
    path = written(tmp_path / "imu.csv", data)
    code, record = replay(capsys, path)
    (imu,) = record["imus"]
    assert code == 0
    assert imu["accel_bias_m_s2"] is None
    # What a part may do that nobody has named costs more than the heading that nobody has said: that is said then.
    words = " | ".join(record["warnings"])
    for option in ("--pitch-deg", "--profile", "say --latitude-deg"):
        assert option in words
    assert "GPS" not in words
    _, record = replay(capsys, path, "--latitude-deg", "40", "--profile", "icm42688p", "--powered", "3600")
    assert any("no --heading-deg" in warning for warning in record["warnings"])
    assert any("say --height-m" in warning for warning in record["warnings"])
    off = np.subtract(imu["gyro_bias_rad_s"], model.mean_bias(3.0, 33.0).gyro_rad_s)
    assert (np.abs(off) / imu["gyro_sigma_use_rad_s"]).max() < 3.5
    assert max(imu["gyro_sigma_use_rad_s"]) > 6.0 * DEG_H


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "0,0,0,0,0,0,-9.8\n0.01,0,0,x,0,0,-9.8\n", "line 3: found 'x' in column gz_rad_s; allowed: a number"),
        (GOOD + "0,0,0,0,0,0,nan\n", "no line in it has a number for all of gx, gy, gz, ax, ay, az"),
        (GOOD + "\n# remark\n0,0,0\n", "line 4: found 3 fields; allowed: 7, as many as columns"),
        (GOOD + "1,0,0,0,0,0,-9.8\n0.5,0,0,0,0,0,-9.8\n", "line 3: time 0.500000 s after 1.000000 s"),
        ("t_s,gx_rad_s\n0,1\n", "line 1: no column for gy, gz, ax, ay, az in t_s, gx_rad_s; allowed: t_s"),
        (GOOD.replace("gy_rad_s", "gx_deg_s") + "0\n", "line 1: two columns for gx: gx_rad_s and gx_deg_s"),
        ("# only a remark\n", "the file is empty"),
    ],
)
def test_every_mistake_in_the_file_is_one_line_with_its_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    path = tmp_path / "imu.csv"
    path.write_text(text, encoding="utf-8")
    assert companion(["log", "replay", str(path)]) == 1
    said = capsys.readouterr()
    assert words in said.err
    assert str(path) in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def by_hand(text: str, columns: int) -> list[list[float | None]]:
    """The numbers of a log in SI units line by line, its remarks left out; an empty field is None."""
    found: list[list[float | None]] = []
    for line in text.splitlines()[1:]:
        fields = [field.strip().strip('"') for field in line.replace(";", ",").split(",")]
        if line.strip() and not line.startswith("#"):
            assert len(fields) == columns
            found.append([float(field) if field else None for field in fields])
    return found


@pytest.mark.parametrize("separator", [",", ";"])
def test_every_line_is_read_however_it_is_written(tmp_path: Path, separator: str) -> None:
    """The values are those in the file."""
    rng = np.random.default_rng(3)
    lines = [GOOD.strip().replace(",", separator) + separator + "temperature_degc"]
    for number in range(3000):
        values = [number * 0.01, *np.add(rng.normal(size=6), [0, 0, 0, 0, 0, -9.8]).tolist(), 25.0]
        fields = [repr(value) for value in values]
        # Long stretches of plain lines, too.
        match -1 if 1000 < number < 2000 else rng.integers(0, 100):
            case 0:
                fields[3] = f'"{values[3]!r}"'
            case 1:
                fields[7] = ""
            case 2:
                fields = [f"  {field} " for field in fields]
            case 3:
                fields[1] = "+1."
            case 4:
                lines.append("# a remark, with 5 words")
            case 5:
                lines.append("")
            case 6:
                fields[2] = "1e-3"
        lines.append(separator.join(fields))
    for end in ("\n", "\r\n"):
        path, text = tmp_path / "imu.csv", end.join(lines) + end
        path.write_bytes(text.encode())
        log = read_csv(path)
        found = np.column_stack([log.t_s, log.readings, log.temperature_degc])
        np.testing.assert_array_equal(found, np.array(by_hand(text, 8), dtype=np.float64))
