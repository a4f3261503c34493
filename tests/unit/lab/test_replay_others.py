"""Logs as apps and loggers write them, made from a simulated IMU whose biases are known."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.errors import StorageError
from companion.lab.still_log import HEADER, read_csv
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.scenario import site_at
from tests.support.made_noise import Floats

G = 9.80665
DEG = 180.0 / np.pi
SECONDS, RATE_HZ, BEGIN_S = 30, 100, 3.0
POSE = Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0)
WHERE = ["--pitch-deg", "5", "--roll-deg", "-3", "--heading-deg", "40", "--latitude-deg", "40", "--height-m", "50"]


@pytest.fixture(scope="module")
def still() -> tuple[Floats, ImuModel]:
    """(n, 7): time and readings in SI units, and the IMU."""
    model = ImuModel(
        VirtualAircraft(POSE, site_at(40.0, 116.0, 50.0)),
        "bmi088",
        seed=5,
        gyro_bias_rad_s=[value * DEG_H for value in (1800.0, -900.0, 400.0)],
        accel_bias_m_s2=[value * MG for value in (12.4, -8.1, 5.9)],
    )
    times = BEGIN_S + np.arange(SECONDS * RATE_HZ) / RATE_HZ
    return np.column_stack([times, model.read(times, 1.0 / RATE_HZ)]), model


def joined(rows: Sequence[Sequence[object]], separator: str = ",") -> str:
    return "".join(separator.join(map(str, row)) + "\n" for row in rows)


def phyphox(data: Floats) -> str:
    """Semicolons, quoted names that are none of ours, and a column of no use."""
    text = '"Time (s)";"Gyroscope x (rad/s)";"Gyroscope y (rad/s)";"Gyroscope z (rad/s)";'
    text += '"Acceleration x (m/s^2)";"Acceleration y (m/s^2)";"Acceleration z (m/s^2)";"Absolute acceleration"\n'
    rows = [[f"{value:.9E}" for value in (*row, float(np.linalg.norm(row[4:])))] for row in data]
    return text + joined(rows, ";")


def xsens(data: Floats) -> str:
    """A preamble with a number in it, tabs, a counter, angles of its own filter, a tab at the end."""
    text = "// Start Time: Unknown\n// Update Rate:\t100.0\n"
    text += "PacketCounter\tTime_ms\tAcc_X\tAcc_Y\tAcc_Z\tGyr_X\tGyr_Y\tGyr_Z\tRoll\tPitch\tYaw\t\n"
    rows = [
        [number % 65536, f"{row[0] * 1e3:.0f}", *(f"{v:.6f}" for v in (*row[4:], *row[1:4])), "-3.1", "5.2", "12", ""]
        for number, row in enumerate(data)
    ]
    return text + joined(rows, "\t")


def serial(data: Floats) -> str:
    """A sketch's boot message, millis(), deg/s and g, blanks between the numbers."""
    text = "MPU ready\n\nmillis gx gy gz ax ay az temp\n"
    rows = [
        [f"{row[0] * 1e3:.0f}", *(f"{v * DEG:.4f}" for v in row[1:4]), *(f"{v / G:.6f}" for v in row[4:]), "31.2"]
        for row in data
    ]
    return text + joined(rows, "  ")


def spreadsheet(data: Floats) -> str:
    """A row of units below the names; micro-seconds since 1970; empty cells and NaN now and then; quotes."""
    text = "timestamp,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z,temperature,remark,\n"
    text += "[us],[dps],[dps],[dps],[mg],[mg],[mg],[degC],,\n"
    rows = []
    for number, row in enumerate(data):
        cells = [
            f"{round(1.7e15 + row[0] * 1e6)}",
            *(f'"{v * DEG:.6f}"' for v in row[1:4]),
            *(f"{v * 1e3 / G:.4f}" for v in row[4:]),
            "" if number % 10 else "24.5",
            "",
            "",
        ]
        if number % 100 == 50:
            cells[2] = "NaN"
        if number % 100 == 70:
            cells[5] = ""
        rows.append(cells)
    return text + joined(rows)


SHEET = "t_us,gx_deg_s,gy_deg_s,gz_deg_s,ax_mg,ay_mg,az_mg,temperature_degc,-"
KINDS: dict[str, tuple[Callable[[Floats], str], str]] = {
    "phyphox": (phyphox, "t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2,-"),
    "xsens": (xsens, "_,t_ms,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s"),
    "serial": (serial, "t_ms,gx_deg_s,gy_deg_s,gz_deg_s,ax_g,ay_g,az_g,temperature_degc"),
    "spreadsheet": (spreadsheet, SHEET),
}


def replay(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "replay", str(path), "--json", *more])
    return code, json.loads(capsys.readouterr().out)


def written(folder: Path, text: str) -> Path:
    path = folder / "log.csv"
    path.write_text(text, encoding="utf-8")
    return path


def assert_near(imu: dict[str, Any], model: ImuModel) -> None:
    true = model.mean_bias(BEGIN_S, BEGIN_S + SECONDS)
    gyro = np.subtract(imu["gyro_bias_rad_s"], true.gyro_rad_s)
    accel = np.subtract(imu["accel_bias_m_s2"], true.accel_m_s2)
    assert (np.abs(gyro) / imu["gyro_sigma_use_rad_s"]).max() < 3.5
    assert (np.abs(accel) / imu["accel_sigma_use_m_s2"]).max() < 3.5


@pytest.mark.parametrize("kind", KINDS)
def test_the_biases_are_found_whoever_wrote_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], still: tuple[Floats, ImuModel], kind: str
) -> None:
    data, model = still
    write, columns = KINDS[kind]
    path = written(tmp_path, write(data))
    code, record = replay(capsys, path, *WHERE, "--profile", "bmi088", f"--columns={columns}")
    assert (code, record["state"]) == (0, "done"), record["reason"]
    assert_near(record["imus"][0], model)
    used = record["log"]
    # All but the seconds in which it begins and ends.
    assert used["from_s"] <= 1.0
    assert used["to_s"] >= SECONDS - 1.5
    assert used["seconds"] == pytest.approx(SECONDS, abs=0.1)


@pytest.mark.parametrize("named", [True, False])
def test_a_log_without_times_has_a_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], still: tuple[Floats, ImuModel], named: bool
) -> None:
    data, model = still
    names = "gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2"
    path = written(tmp_path, (names + "\n" if named else "") + joined(data[:, 1:].tolist()))
    more = [] if named else ["--columns", names]
    assert companion(["log", "replay", str(path), *WHERE, *more]) == 1
    assert "a log without time: --rate HZ" in capsys.readouterr().err
    code, record = replay(capsys, path, *WHERE, *more, "--rate", "100")
    assert code == 0
    assert_near(record["imus"][0], model)


def test_repeated_lines_are_left_out_and_equal_times_refused(tmp_path: Path, still: tuple[Floats, ImuModel]) -> None:
    data = still[0]
    doubled = [row for number, row in enumerate(data.tolist()) for _ in range(2 if number % 10 == 4 else 1)]
    log = read_csv(written(tmp_path, HEADER + "\n" + joined(doubled)))
    np.testing.assert_array_equal(np.column_stack([log.t_s, log.readings]), data)
    assert log.left_out == {"repeated: time and readings of the line before": len(data) // 10}
    coarse = np.column_stack([np.floor(data[:, 0] * 10.0) / 10.0, data[:, 1:]])
    path = written(tmp_path, HEADER + "\n" + joined(coarse.tolist()))
    with pytest.raises(
        StorageError, match=r"line 3: time 3\.000000 s after 3\.000000 s; allowed: growing times, or --rate"
    ):
        read_csv(path)
    assert np.diff(read_csv(path, rate_hz=100.0).t_s) == pytest.approx(0.01)


def test_a_counter_of_32_bits_goes_on_behind_its_end(tmp_path: Path, still: tuple[Floats, ImuModel]) -> None:
    data, _ = still
    stamps = (np.round(data[:, 0] * 1e6).astype(np.int64) + 2**32 - 15_000_000) % 2**32
    rows = [[int(stamp), *row[1:].tolist()] for stamp, row in zip(stamps, data, strict=True)]
    log = read_csv(written(tmp_path, "t_us,gx_rad_s,gy_rad_s,gz_rad_s,ax_m_s2,ay_m_s2,az_m_s2\n" + joined(rows)))
    np.testing.assert_allclose(np.diff(log.t_s), 0.01, atol=2e-6)


@pytest.mark.parametrize(
    ("change", "units", "read_m_s2"),
    [
        (lambda data: data / [1, 1, 1, 1, G, G, G], "m_s2", "0.99"),
        (lambda data: data, "g", "95."),
        (lambda data: data - [0, 0, 0, 0, *data[:, 4:].mean(axis=0)], "m_s2", "0.0"),
    ],
    ids=["g named m_s2", "m_s2 named g", "gravity taken off"],
)
@pytest.mark.parametrize("command", ["replay", "profile"])
def test_a_unit_that_gravity_contradicts_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    still: tuple[Floats, ImuModel],
    command: str,
    change: Callable[[Floats], Floats],
    units: str,
    read_m_s2: str,
) -> None:
    path = written(tmp_path, HEADER.replace("m_s2", units) + "\n" + joined(change(still[0]).tolist()))
    assert companion(["log", command, str(path)]) == 1
    said = capsys.readouterr()
    assert f"{path}: ax_{units}, ay_{units}, az_{units} read {read_m_s2}" in said.err
    assert "m/s^2 in all; allowed: gravity, 7 to 12.6: name their right unit" in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""
