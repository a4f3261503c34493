"""`companion flight` on logs of ArduPilot and PX4, whole ones and others."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.estimation.records.record import ImuRecord, Record, WrittenParameter
from companion.physics.units import DEG_H, MG
from companion.storage.flights import FlightStore
from companion.storage.learned import BiasStore, KnownImu
from companion.storage.records import RecordStore
from tests.support.autopilot_files import ulog_message, write_ulog
from tests.support.flown import HEIGHT_M, LATITUDE_DEG, Flown, dataflash, fly, messages, parameters
from tests.support.histories import SLOPES_DEG_H_K, windows_of_days
from tests.support.made_noise import Floats

GYRO_DEG_H, ACCEL_MG, STEP_MG = (300.0, -200.0, 100.0), (3.0, -2.0, 4.0), 5.0
BEGAN = "2026-10-11T08:00:00+00:00"


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(
        gyro_rad_s=[each * DEG_H for each in GYRO_DEG_H],
        accel_m_s2=[each * MG for each in ACCEL_MG],
        step_m_s2=STEP_MG * MG,
        rate_hz=100.0,
        white=(20.0 * DEG_H, 0.1 * MG),
    )


@pytest.fixture(scope="module")
def log(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataflash(tmp_path_factory.mktemp("log") / "00000007.BIN", messages(flown, parameters()))


def storage(folder: Path) -> list[str]:
    """A configuration with a history of its own."""
    path = folder / "companion.toml"
    imu = '[[imu]]\nname = "fc"\nsource = "autopilot"\n'
    path.write_text(f'[mavlink]\nurl = "udpin:127.0.0.1:14550"\n[storage]\ndirectory = "{folder}"\n{imu}')
    return ["-c", str(path)]


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    code = companion(["flight", "--json", *map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


def record(values: dict[str, float], before: dict[str, float]) -> Record:
    written = {
        name: WrittenParameter(before=before[name], after=value, read_back=value, outcome="verified")
        for name, value in values.items()
    }
    nothing = dict.fromkeys(
        ("temperature_degc", "gyro_bias_rad_s", "gyro_sigma_stat_rad_s", "gyro_sigma_use_rad_s", "accel_bias_m_s2",
         "accel_sigma_stat_m_s2", "accel_sigma_use_m_s2", "covariance", "residual_gyro_rad_s", "residual_accel_m_s2")
    )  # fmt: skip
    imu = ImuRecord(name="fc", samples=6000, written=written, **nothing)  # type: ignore[arg-type]
    return Record(
        state="done", reason="", warnings=(), started_at=BEGAN, duration_s=60.0, pose=None, site=None, imus=(imu,),
        system_id=1,
    )  # fmt: skip


def test_a_flight_is_told_with_what_its_calibration_was_worth(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    offsets = {f"INS_GYROFFS_{axis}": 0.001 for axis in "XYZ"} | {f"INS_ACCOFFS_{axis}": 0.02 for axis in "XYZ"}
    # Before, 1000 deg/h more and 20 mg less were taken off.
    before = {
        name: value + (1000.0 * DEG_H if "GYR" in name else -20.0 * MG if name.endswith("X") else 0.0)
        for name, value in offsets.items()
    }
    RecordStore(tmp_path).save(record(offsets, before))
    # A later one of other offsets is not the one.
    RecordStore(tmp_path).save(record({"INS_GYROFFS_X": 0.5}, before))
    code, answer = said(capsys, log, *storage(tmp_path))
    assert code == 0
    (flight,) = answer["flights"]
    assert flight["stages"] == {
        "armed_s": 64.0, "motors_s": pytest.approx(65.0, abs=0.3), "take_off_s": 67.0, "landing_s": 240.0,
        "disarmed_s": 242.0,
    }  # fmt: skip
    assert flight["began_at"] == "2026-10-11T00:00:46+00:00"
    assert flight["reference"] == "ekf"
    (imu,) = flight["imus"]
    assert imu["calibration"] == BEGAN
    assert imu["notes"] == ["clocks differ: by them its calibration began 7:59:14 h after this arming"]
    found = {axis["axis"]: axis for axis in imu["axes"]}
    for axis, bias in zip("xyz", GYRO_DEG_H, strict=True):
        term = found[f"gyro {axis}"]["turn_on"]
        assert abs(term["value"] / DEG_H - bias) < 2.0 * term["sigma"] / DEG_H < 30.0
    motors = found["accel z"]["motors"]
    assert abs(motors["value"] / MG - STEP_MG) < 2.0 * motors["sigma"] / MG < 2.0
    assert set(imu["drift"]) == {"flown", "before"}
    at_30 = {name: next(row for row in rows if row["seconds"] == 30.0) for name, rows in imu["drift"].items()}
    # 300 deg/h alone: g w t^3 / 6.
    assert 60.0 < at_30["flown"]["median_m"] < 200.0
    assert at_30["before"]["median_m"] > 2.0 * at_30["flown"]["median_m"]


def test_people_read_the_figure_that_counts(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert companion(["flight", str(log), *storage(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "IMU 1, 100 Hz: offsets of no calibration known here\n" in out
    assert "30 s without GNSS: " in out
    _, _, below = out.partition("left over: bias that the offsets did not take off, ± one sigma (docs/flight.md)\n")
    assert below.startswith("  accel x, y: not counted, in the air nothing tells them from tilt\n")
    assert "-0 ±" not in out
    assert max(map(len, out.splitlines())) <= 100
    assert out.splitlines()[-2].startswith("next flight: IMU 1 gyro x: ")
    assert out.splitlines()[-1].startswith("kept as flight 1")


def test_a_flight_is_kept_once_however_often_and_in_whatever_file_it_is_read(
    log: Path, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = storage(tmp_path)
    _, answer = said(capsys, log, *folder)
    assert answer["numbers"] == [1]
    # Cut off in the air, under another name.
    (tmp_path / "cut.bin").write_bytes(log.read_bytes()[: log.stat().st_size * 4 // 5])
    assert said(capsys, tmp_path / "cut.bin", *folder)[1]["numbers"] == [1]
    # Another start, as both firmwares count them in a parameter.
    other = dataflash(tmp_path / "other.bin", messages(flown, parameters(STAT_BOOTCNT=8.0)))
    assert said(capsys, other, *folder)[1]["numbers"] == [2]
    kept = list(FlightStore(tmp_path).newest().values())
    assert [each.log for each in kept] == ["other.bin", "cut.bin"]
    assert (kept[0].flight.imus[0].gyro_id, kept[0].flight.imus[0].accel_id) == (2752772, 2753028)
    # What never flew is told and not kept.
    stood = dataflash(tmp_path / "stood.bin", messages(cut_off(flown, 66.0), parameters(STAT_BOOTCNT=9.0)))
    code, answer = said(capsys, stood, *folder)
    assert (code, len(answer["flights"]), answer["numbers"]) == (0, 1, [])


def test_a_flight_that_cannot_be_kept_is_told_all_the_same(
    log: Path, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = storage(tmp_path)
    (tmp_path / "flights").write_bytes(b"in the way")
    code = companion(["flight", "--json", str(log), *folder])
    out, err = capsys.readouterr()
    assert (code, json.loads(out)["numbers"], len(json.loads(out)["flights"])) == (0, [], 1)
    assert err == f"note: not kept: {tmp_path}/flights: cannot be listed: Not a directory\n"
    # Where there is no companion, none is begun.
    elsewhere = tmp_path / "elsewhere"
    config = Path(folder[1])
    config.write_text(config.read_text().replace(f'directory = "{tmp_path}"', f'directory = "{elsewhere}"'))
    assert companion(["flight", "--json", str(log), *folder]) == 0
    assert capsys.readouterr().err == (
        f"note: not kept: this computer has no companion's storage ({elsewhere}); on the companion flights are kept"
        " for the history\n"
    )
    # Of a log without a flight there is nothing to keep.
    stood = dataflash(tmp_path / "stood.bin", messages(cut_off(flown, 66.0), parameters()))
    assert companion(["flight", "--json", str(stood), *folder]) == 0
    assert capsys.readouterr().err == ""
    assert not elsewhere.exists()


def cut_off(flown: Flown, at_s: float) -> Flown:
    readings, states = flown.t_s < at_s, flown.at_s < at_s
    return dataclasses.replace(
        flown, t_s=flown.t_s[readings], readings=flown.readings[readings], at_s=flown.at_s[states],
        quaternions=flown.quaternions[states], velocity=flown.velocity[states], position=flown.position[states],
        airborne_s=at_s, landed_s=at_s, disarmed_s=at_s,
    )  # fmt: skip


def test_what_the_curve_knows_of_temperature_is_not_put_down_to_the_motors(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slopes = np.array(SLOPES_DEG_H_K)
    warmer_k = np.clip((flown.t_s - 66.0) / 20.0, 0.0, 1.0) * 8.0
    readings = flown.readings + np.hstack([np.outer(warmer_k, slopes * DEG_H), np.zeros((len(warmer_k), 3))])
    warmed = dataclasses.replace(flown, readings=readings)
    path = dataflash(tmp_path / "warm.bin", messages(warmed, parameters(), degc=14.0 + warmer_k))
    identity = {"source": "autopilot", "instance": "1", "gyro": "2752772"}
    BiasStore(tmp_path).write({"fc": KnownImu(identity=identity, points=tuple(windows_of_days(8)))})
    _, answer = said(capsys, path, *storage(tmp_path))
    step_k = warmer_k[(flown.t_s > 70.0) & (flown.t_s < 237.0)].mean()
    for k, axis in enumerate(answer["flights"][0]["imus"][0]["axes"][:3]):
        temperature, motors = axis["temperature"], axis["motors"]
        assert abs(temperature["value"] / DEG_H - slopes[k] * step_k) < 2.0 * temperature["sigma"] / DEG_H < 40.0
        assert abs(motors["value"]) < 2.0 * motors["sigma"]
    # Of another sensor's curve nothing is known here.
    BiasStore(tmp_path).write({"fc": KnownImu(identity=identity | {"gyro": "1"}, points=tuple(windows_of_days(8)))})
    _, answer = said(capsys, path, *storage(tmp_path))
    axes = answer["flights"][0]["imus"][0]["axes"]
    assert all(axis["temperature"] is None for axis in axes)
    worst = int(np.argmax(np.abs(slopes)))
    assert axes[worst]["motors"]["value"] / DEG_H == pytest.approx(slopes[worst] * step_k, rel=0.3)


def column(states: Any) -> Floats:
    return np.asarray(states, dtype=np.float64)[:, None]


def of_px4(flown: Flown, path: Path, more: Mapping[tuple[str, int], tuple[Floats, Floats]] | None = None) -> Path:
    at, slow = flown.at_s, flown.at_s[::25]
    place = np.tile([LATITUDE_DEG, HEIGHT_M], (len(at), 1))
    spun = ((slow >= flown.motors_s) & (slow < flown.disarmed_s))[:, None]
    bias = [*(each * DEG_H for each in GYRO_DEG_H), *[1e-10] * 3, *(each * MG for each in ACCEL_MG), *[1e-6] * 3]
    return write_ulog(
        path,
        {
            ("sensor_combined", 0): (flown.t_s, flown.readings),
            ("vehicle_attitude", 0): (at, flown.quaternions),
            ("vehicle_local_position", 0): (at, np.hstack([flown.velocity, flown.position, place])),
            ("actuator_armed", 0): (slow, column((slow >= 64.0) & (slow < 242.0))),
            ("vehicle_land_detected", 0): (slow, column((slow < 67.0) | (slow >= 240.0))),
            ("actuator_motors", 0): (slow, 0.5 * np.hstack([np.tile(spun, (1, 4)), np.full((len(slow), 8), np.nan)])),
            ("estimator_sensor_bias", 0): (slow, np.tile([0.0, *bias], (len(slow), 1))),
        }
        | dict(more or {}),
    )


def test_a_flight_of_px4_is_told_alike(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = of_px4(flown, tmp_path / "log.ulg")
    code, answer = said(capsys, path, *storage(tmp_path))
    assert code == 0
    (flight,) = answer["flights"]
    assert flight["stages"]["motors_s"] == pytest.approx(65.0, abs=1.0)
    assert flight["stages"]["take_off_s"] == pytest.approx(67.0, abs=1.0)
    (imu,) = flight["imus"]
    # No parameters are in this log.
    assert imu["notes"][0].startswith("PX4 has no accelerometer in CAL_ACC0_ID")
    for axis, bias_now, unit in zip(
        imu["axes"], (*GYRO_DEG_H, ACCEL_MG[2] + STEP_MG), (DEG_H, DEG_H, DEG_H, MG), strict=True
    ):
        assert abs(axis["in_flight"]["value"] / unit - bias_now) < 2.0 * axis["in_flight"]["sigma"] / unit
    assert imu["axes"][0]["ekf"]["value"] / DEG_H == pytest.approx(GYRO_DEG_H[0])
    assert 60.0 < imu["drift"]["flown"][1]["median_m"] < 200.0


def test_an_imu_that_px4_leaves_in_the_air_is_not_taken_for_the_other(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """sensor_combined is of the one in use: from 150 s on of another, whose gyro x reads 500 deg/h more."""
    readings = flown.readings.copy()
    readings[flown.t_s > 150.0, 0] += 500.0 * DEG_H
    status = {
        ("vehicle_imu_status", k): (
            flown.at_s[::25],
            np.tile([gyro_id, gyro_id, 40.0, 0.1], (len(flown.at_s[::25]), 1)),
        )
        for k, gyro_id in enumerate((11.0, 22.0))
    }
    selection = np.array([1.0, 150.0]), np.array([[11.0], [22.0]])
    path = of_px4(
        dataclasses.replace(flown, readings=readings),
        tmp_path / "x.ulg",
        {("sensor_selection", 0): selection, **status},
    )
    _, answer = said(capsys, path, *storage(tmp_path))
    (flight,) = answer["flights"]
    assert flight["notes"] == ["PX4 has changed the IMU that it flies by"]
    assert [imu["imu"] for imu in flight["imus"]] == [1, 2]
    for imu, more_deg_h in zip(flight["imus"], (0.0, 500.0), strict=True):
        term = imu["axes"][0]["in_flight"]
        assert abs(term["value"] / DEG_H - GYRO_DEG_H[0] - more_deg_h) < 2.0 * term["sigma"] / DEG_H < 150.0


def test_what_px4_could_not_write_is_said_and_not_flown_over(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = (flown.t_s < 150.0) | (flown.t_s > 152.0)
    path = of_px4(dataclasses.replace(flown, t_s=flown.t_s[there], readings=flown.readings[there]), tmp_path / "x.ulg")
    with path.open("ab") as file:
        file.write(ulog_message(b"O", struct.pack("<H", 1000)) * 2)
    _, answer = said(capsys, path, *storage(tmp_path))
    _, whole = said(capsys, of_px4(flown, tmp_path / "whole.ulg"), *storage(tmp_path))
    (flight,), (expected,) = answer["flights"], whole["flights"]
    assert flight["notes"] == ["gaps in it, in which PX4 could not write: 2"]
    for rows, others in zip(*(each["imus"][0]["drift"]["flown"] for each in (flight, expected)), strict=True):
        # None begins before the gap and ends after it.
        assert rows["starts"] == pytest.approx(others["starts"] - rows["seconds"] - 2.0, abs=2.0)
        assert rows["median_m"] == pytest.approx(others["median_m"], rel=0.2)
    for axis, other in zip(flight["imus"][0]["axes"], expected["imus"][0]["axes"], strict=True):
        assert axis["in_flight"]["value"] == pytest.approx(other["in_flight"]["value"], abs=other["in_flight"]["sigma"])


def test_several_starts_in_one_file_are_each_by_their_own_clock(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, path = dataflash(tmp_path / "one.bin", messages(flown, parameters())).read_bytes(), tmp_path / "two.bin"
    # Cut off in the middle of a message, as by pulling the plug.
    path.write_bytes(one[:-5] + one)
    code, answer = said(capsys, path, *storage(tmp_path))
    assert code == 0
    assert len(answer["flights"]) == 2
    assert answer["flights"][0]["imus"] == answer["flights"][1]["imus"]
    assert companion(["flight", str(path), *storage(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith("2 starts of the autopilot in it, each by its own clock\n")


@pytest.mark.parametrize(
    ("left_out", "words"),
    [
        ({"XKQ"}, "no attitude and position of an EKF3 (ArduPilot) or EKF2 (PX4) in it"),
        ({"IMU"}, "no samples of an IMU in it"),
    ],
)
def test_a_log_without_what_it_takes_is_one_line(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], left_out: set[str], words: str
) -> None:
    kept = [each for each in messages(flown, parameters()) if each[0] not in left_out]
    path = dataflash(tmp_path / "x.bin", kept)
    assert companion(["flight", str(path), *storage(tmp_path)]) == 1
    assert capsys.readouterr().err == f"companion: {path}: {words}\n"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "no log of ArduPilot (.bin) or PX4 (.ulg)"),
        (b"%PDF-1.4 and more", "no log of ArduPilot (.bin) or PX4 (.ulg)"),
        (b"\xa3\x95\x80" + bytes(7), "no samples of an IMU in it"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "no samples of an IMU in it"),
        (b"ULogEnc\x01" + bytes(100), "encrypted by PX4: decrypt it first (Tools/log_encryption of PX4)"),
        (b"\x00\x06\x1d" + bytes(5) + b"\xfd\x09\x00\x00", "no log of ArduPilot (.bin) or PX4 (.ulg)"),
        (b"PK\x03\x04" + bytes(100), "no log of ArduPilot (.bin) or PX4 (.ulg)"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name\n", "no log of ArduPilot (.bin) or PX4 (.ulg)"),
        (None, "cannot be read: Is a directory"),
    ],
    ids=["empty", "foreign", "beginning", "beginning of PX4's", "encrypted", "tlog", "zip", "text", "folder"],
)
def test_another_file_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: bytes | None, words: str
) -> None:
    path = tmp_path / "log"
    if data is None:
        path.mkdir()
    else:
        path.write_bytes(data)
    assert companion(["flight", str(path), *storage(tmp_path)]) == 1
    assert capsys.readouterr().err == f"companion: {path}: {words}\n"


def test_the_lane_in_use_is_the_reference(
    log: Path, flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Until 200 s lane 0, then lane 1; of the other nothing is to be believed."""
    told: list[tuple[str, tuple[Any, ...]]] = []
    for name, values in messages(flown, parameters()):
        if name in {"XKF1", "XKQ"}:
            t_us, _, *rest = values
            changed = t_us > 200e6
            lost = (
                [1.0, 0.0, 0.0, 0.0] if name == "XKQ" else [0, 0, 0, 30.0, 30.0, 5.0, 0, 900.0, 900.0, 90.0, *[0] * 4]
            )
            told += [(name, (t_us, int(changed), *rest)), (name, (t_us, int(not changed), *lost))]
            if name == "XKF1":
                told += [("XKF4", (t_us, core, *[0] * 12, int(changed))) for core in (0, 1)]
        else:
            told.append((name, values))
    _, answer = said(capsys, dataflash(tmp_path / "lanes.bin", told), *storage(tmp_path))
    _, whole = said(capsys, log, *storage(tmp_path))
    (flight,), (expected,) = answer["flights"], whole["flights"]
    assert flight["notes"] == ["the EKF has changed its lane: measured from the one in use"]
    assert flight["imus"][0]["drift"] == expected["imus"][0]["drift"]
    assert flight["imus"][0]["axes"] == expected["imus"][0]["axes"]


def test_what_lies_far_off_is_left_aside_and_said(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An accelerometer that breaks in the air: 300 mg more from 200 s to the landing."""
    readings = flown.readings.copy()
    readings[flown.t_s > 200.0, 5] += 300.0 * MG
    path = dataflash(tmp_path / "x.bin", messages(dataclasses.replace(flown, readings=readings), parameters()))
    _, answer = said(capsys, path, *storage(tmp_path))
    (imu,) = answer["flights"][0]["imus"]
    # Of 70 s to 237 s.
    assert imu["notes"] == ["3 of 16 stretches of 10 s left aside, far off the others: the EKF has jumped, or the IMU"]
    vertical = imu["axes"][3]["in_flight"]
    assert abs(vertical["value"] / MG - ACCEL_MG[2] - STEP_MG) < 2.0 * vertical["sigma"] / MG


def test_what_a_failed_imu_reads_is_left_aside(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As real ArduPilots log a gyro that hangs: the same rates again and again, and GH 0."""
    told: list[tuple[str, tuple[Any, ...]]] = []
    hangs: tuple[Any, ...] = ()
    for name, values in messages(flown, parameters()):
        if name == "IMU":
            t_us, instance, *row = values
            if t_us > 164e6:
                hangs = hangs or tuple(row[:3])
                row = [*hangs, *row[3:9], 0, *row[10:]]
            told.append((name, (t_us, instance, *row)))
        else:
            told.append((name, values))
    _, answer = said(capsys, dataflash(tmp_path / "failed.bin", told), *storage(tmp_path))
    (imu,) = answer["flights"][0]["imus"]
    assert imu["notes"] == ["the autopilot found it failed 100 s after arming: what it read then is left aside"]
    for axis, bias, unit in zip(imu["axes"], (*GYRO_DEG_H, ACCEL_MG[2] + STEP_MG), (*[DEG_H] * 3, MG), strict=True):
        assert abs(axis["in_flight"]["value"] / unit - bias) < 2.0 * axis["in_flight"]["sigma"] / unit
    # From 70 s to 164 s.
    assert imu["drift"]["flown"][0]["starts"] == pytest.approx(164 - 70 - 10, abs=2)


def test_a_truncated_and_damaged_log_is_read_as_far_as_it_goes(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(log.read_bytes()[: log.stat().st_size * 2 // 3])
    data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
    path = tmp_path / "cut.bin"
    path.write_bytes(bytes(data))
    code, answer = said(capsys, path, *storage(tmp_path))
    assert code == 0
    (flight,) = answer["flights"]
    assert flight["stages"]["landing_s"] is None
    assert flight["stages"]["disarmed_s"] is None
    assert flight["imus"][0]["drift"]["flown"]


def test_a_history_that_cannot_be_read_is_said_and_the_flight_told(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "records").write_text("in the place of a folder")
    assert companion(["flight", "--json", str(log), *storage(tmp_path)]) == 0
    heard = capsys.readouterr()
    assert heard.err == (
        f"note: {tmp_path}/records: cannot be listed: Not a directory: looked at without the companion's history,"
        " and not kept; sudo may help\n"
    )
    assert json.loads(heard.out)["flights"][0]["imus"][0]["drift"]["flown"]
