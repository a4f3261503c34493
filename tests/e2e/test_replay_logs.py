"""A log of somebody's own through the command line, as typed: what goes to which stream, and how it ends."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.autopilot_files import write_dataflash
from tests.support.made_noise import DEG, adis16405


def companion(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-m", "companion", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120.0)


COLUMNS = "t_ms,gx_deg_s,gy_deg_s,gz_deg_s,ax_g,ay_g,az_g"


@pytest.fixture(scope="module")
def serial_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three minutes of a sketch's lines: millis(), deg/s and g, a cell lost, the last line cut."""
    t_s, readings = adis16405(180, 20, seed=6)
    path = tmp_path_factory.mktemp("logs") / "serial.txt"
    lines = ["Starting up", "millis;gx;gy;gz;ax;ay;az;"]
    for number, (now_s, row) in enumerate(zip(t_s, readings, strict=True)):
        cells = [f"{now_s * 1e3:.0f}", *(f"{v / DEG:.4f}" for v in row[:3]), *(f"{v / 9.80665:.6f}" for v in row[3:])]
        if number == 200:
            cells[2] = ""
        lines.append(";".join(cells) + ";")
    path.write_text("\n".join(lines) + "\n200000;0.1;0.2", encoding="utf-8")
    return path


def test_a_log_is_replayed_and_learned_from(serial_log: Path, tmp_path: Path) -> None:
    said = companion(
        "replay", str(serial_log), "--columns", COLUMNS, "--json", "--profile", "adis16405", "--latitude-deg", "40"
    )
    assert (said.returncode, said.stderr) == (0, "")
    record = json.loads(said.stdout)
    # What was put into it: 0.3, -0.2 and 0.1 deg/s; the Earth's rate is not known in heading.
    bias = np.array(record["imus"][0]["gyro_bias_rad_s"]) / DEG
    np.testing.assert_allclose(bias, [0.3, -0.2, 0.1], atol=0.06)
    assert record["log"]["left_out"] == {"without a number in each of gx, gy, gz, ax, ay, az": 1}
    assert record["log"]["notes"] == []
    said = companion("profile", str(serial_log), "--columns", COLUMNS, "--save", "sketch", "--storage", str(tmp_path))
    assert said.returncode == 0, said.stderr
    assert "used of serial.txt: " in said.stdout
    assert (tmp_path / "profiles" / "sketch.json").is_file()
    said = companion(
        "replay",
        str(serial_log),
        "--columns",
        COLUMNS,
        "--profile",
        str(tmp_path / "profiles" / "sketch.json"),
        "--windows",
        "20",
    )
    assert said.returncode == 0, said.stderr
    assert "windows of 20 s: 8, calibrated: 8" in said.stdout


def test_a_log_of_ardupilot_is_replayed(tmp_path: Path) -> None:
    t_s, readings = adis16405(20, 50, seed=7)
    path = write_dataflash(tmp_path / "00000007.BIN", {0: (t_s, readings), 2: (t_s, readings)})
    said = companion("replay", str(path), "--imu", "imu2", "--json", "--profile", "adis16405")
    assert (said.returncode, said.stderr) == (0, "")
    assert json.loads(said.stdout)["imus"][0]["name"] == "imu2"
    said = companion("replay", str(path), "--json")
    assert (said.returncode, said.stdout) == (2, "")
    assert said.stderr == f"{path}: found IMUs imu0, imu2; allowed: one; say which with --imu\n"
