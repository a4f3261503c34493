"""Logs that PX4 and ArduPilot wrote: a real one against another reader, made ones against a simulated IMU."""

from __future__ import annotations

import json
import resource
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog import ULog

from companion.cli import main as companion
from companion.lab.log_files import read_logs
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.scenario import site_at
from tests.support.autopilot_files import ulog_message, write_dataflash, write_ulog
from tests.support.made_noise import Floats
from tests.support.recordings import shared

SECONDS, RATE_HZ = 30, 100
WHERE = ["--pitch-deg", "0", "--roll-deg", "0", "--heading-deg", "0", "--latitude-deg", "40", "--height-m", "50"]


def model(seed: int) -> ImuModel:
    return ImuModel(
        VirtualAircraft(Pose(pitch_deg=0.0, roll_deg=0.0, heading_deg=0.0), site_at(40.0, 116.0, 50.0)),
        "icm42688p",
        seed=seed,
        gyro_bias_rad_s=[(100.0 + 50.0 * seed) * DEG_H] * 3,
        accel_bias_m_s2=[2.0 * seed * MG] * 3,
    )


TIMES = np.arange(SECONDS * RATE_HZ) / RATE_HZ + 5.0


def readings(seed: int) -> Floats:
    return np.asarray(model(seed).read(TIMES, 1.0 / RATE_HZ))


def replay(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "replay", str(path), "--json", *WHERE, *more])
    return code, json.loads(capsys.readouterr().out)


def assert_near(record: dict[str, Any], seed: int) -> None:
    (imu,) = record["imus"]
    true = model(seed).mean_bias(5.0, 5.0 + SECONDS)
    for key, truth in (("gyro_{}_rad_s", true.gyro_rad_s), ("accel_{}_m_s2", true.accel_m_s2)):
        off = np.subtract(imu[key.format("bias")], truth)
        assert (np.abs(off) / imu[key.format("sigma_use")]).max() < 3.5


def test_a_real_log_of_px4_is_read_to_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    path = shared("px4_pyulog/sample.ulg")
    (log,) = read_logs([path])
    table = ULog(str(path), ["sensor_combined"]).get_dataset("sensor_combined").data
    np.testing.assert_allclose(log.t_s, table["timestamp"] * 1e-6, rtol=0.0, atol=1e-9)
    for k in range(3):
        np.testing.assert_array_equal(log.readings[:, k], table[f"gyro_rad[{k}]"])
        np.testing.assert_array_equal(log.readings[:, 3 + k], table[f"accelerometer_m_s2[{k}]"])
    code, record = replay(capsys, path)
    assert code == 0
    used = record["log"]
    # It was handled for 8 s.
    assert 6.0 <= used["from_s"] <= 10.0
    assert used["to_s"] > 67.0
    assert any("drifts" in warning for warning in record["imus"][0]["warnings"])
    assert "gaps in it, in which PX4 could not write: 4" in used["notes"]


def test_what_px4_flies_by_and_its_sensors_are_imus_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    degc = np.full((len(TIMES), 1), 41.0)
    raw = readings(2)
    path = write_ulog(
        tmp_path / "log.ulg",
        {
            ("sensor_combined", 0): (TIMES, readings(1)),
            ("sensor_gyro", 1): (TIMES, np.column_stack([raw[:, :3], degc])),
            # Its own clockwork, a little later.
            ("sensor_accel", 1): (TIMES + 0.002, raw[:, 3:]),
        },
    )
    assert companion(["log", "replay", str(path)]) == 2
    said = capsys.readouterr().err
    assert said == f"{path}: found IMUs sensor1, sensor_combined; allowed: one; say which with --imu\n"
    code, record = replay(capsys, path, "--imu", "sensor_combined")
    assert code == 0
    assert_near(record, 1)
    code, record = replay(capsys, path, "--imu", "sensor1")
    assert code == 0
    assert_near(record, 2)
    assert record["imus"][0]["temperature_degc"] == pytest.approx(41.0)
    assert companion(["log", "replay", str(path), "--imu", "sensor7"]) == 1
    assert "no IMU 'sensor7' in these files; there are: sensor1, sensor_combined" in capsys.readouterr().err


def test_every_imu_of_ardupilot_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_dataflash(tmp_path / "00000001.BIN", {0: (TIMES, readings(1)), 1: (TIMES + 1e-4, readings(3))})
    for instance, seed in ((0, 1), (1, 3)):
        code, record = replay(capsys, path, "--imu", f"imu{instance}")
        assert code == 0
        assert_near(record, seed)
        assert record["imus"][0]["temperature_degc"] == pytest.approx(31.5)
        assert record["log"]["notes"][0].startswith("the autopilot's offsets are taken off in it")


@pytest.mark.parametrize("kind", ["ulg", "bin"])
@pytest.mark.parametrize("command", ["replay", "profile"])
def test_a_damaged_log_is_one_line_or_what_is_left_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, kind: str
) -> None:
    whole = tmp_path / f"whole.{kind}"
    if kind == "ulg":
        write_ulog(whole, {("sensor_combined", 0): (TIMES, readings(1))})
    else:
        write_dataflash(whole, {0: (TIMES, readings(1))})
    data = whole.read_bytes()
    rng = np.random.default_rng(4)
    path = tmp_path / f"damaged.{kind}"
    for number in range(40):
        damaged = bytearray(data[: int(rng.integers(7, 2000))] if number % 2 else data)
        for at in rng.integers(7, len(damaged), size=int(rng.integers(0, 40))) if len(damaged) > 7 else ():
            damaged[int(at)] = int(rng.integers(0, 256))
        path.write_bytes(bytes(damaged))
        code = companion(["log", command, str(path)])
        said = capsys.readouterr()
        # 2: a byte of it makes another instance of a message.
        assert code in {0, 1, 2}
        assert "Traceback" not in said.err
        if not said.out:
            assert code
            assert 1 <= said.err.count("\n") <= 2, said.err


@pytest.fixture
def little_memory() -> Iterator[None]:
    """A gigabyte more than there is now: what takes memory without end fails, before the machine does."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + (1 << 30), limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, limits)


def circling() -> bytes:
    """A message that says that it is longer than the file: its reader goes back by that, and comes by again."""
    said = ulog_message(b"M", b"\x00\x0cchar[9000] a" + bytes(9000))
    head = b"ULog\x01\x12\x35\x01" + bytes(8) + ulog_message(b"B", bytes(40))
    end = len(said) + 3 + 5000
    return head + said + struct.pack("<Hc", end - 2, b"?") + bytes(5000)


def without_length() -> bytes:
    def named(number: int, length: int, name: bytes) -> bytes:
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, name, b"BBnNZ", b"Type,Length,Name")

    return named(0x80, 89, b"FMT") + named(0x81, 0, b"IMU") + b"\xa3\x95\x81" + bytes(2000)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (circling(), "not a readable log of PX4: its messages lead back to where they began"),
        (without_length(), "no samples of an IMU in it"),
    ],
    ids=["circling", "no length"],
)
@pytest.mark.usefixtures("little_memory")
def test_a_log_without_end_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: bytes, words: str
) -> None:
    path = tmp_path / "log"
    path.write_bytes(data)
    assert companion(["log", "replay", str(path)]) == 1
    said = capsys.readouterr()
    assert said.err == f"companion: {path}: {words}\n"
