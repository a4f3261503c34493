"""`companion log flight` on logs of ArduPilot and PX4, whole ones and others."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from companion.estimation.records.record import ImuRecord, Record, WrittenParameter
from companion.physics.units import DEG_H, MG
from companion.storage.records import BiasStore, FlightStore, KnownImu, RecordStore
from tests.support.autopilot_files import write_ulog
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
    path = folder / "companion.toml"
    imu = '[[imu]]\nname = "fc"\nsource = "autopilot"\n'
    path.write_text(f'[mavlink]\nurl = "udpin:127.0.0.1:14550"\n[storage]\ndirectory = "{folder}"\n{imu}')
    return ["-c", str(path)]


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "flight", "--json", *map(str, arguments)])
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


def test_a_log_without_an_arming_says_so(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [each for each in messages(flown, parameters()) if each[0] not in {"ARM", "EV"}]
    assert companion(["log", "flight", str(dataflash(tmp_path / "1.BIN", rows)), *storage(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "armed" not in said.splitlines()[0]
    assert "no arming in the log, which begins 0 s after start 1 of the autopilot" in said


def test_a_log_of_before_2016_counts_in_milliseconds(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [(name, (us // 1000, *rest)) for name, (us, *rest) in messages(flown, parameters())]
    path = dataflash(tmp_path / "1.BIN", rows)
    path.write_bytes(path.read_bytes().replace(b"TimeUS", b"TimeMS"))
    code, answer = said(capsys, path, *storage(tmp_path))
    assert code == 0
    (flight,) = answer["flights"]
    assert (flight["stages"]["armed_s"], flight["stages"]["disarmed_s"]) == (64.0, 242.0)


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
        "disarmed_s": 242.0, "is_arming_logged": True,
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


@pytest.mark.parametrize(("learn", "words"), [(3.0, "subtracted in flight"), (1.0, "not in use")])
def test_what_ardupilot_learned_in_hover_is_shown_beside_what_is_found(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str], learn: float, words: str
) -> None:
    learned = {"INS_ACC_VRFB_Z": 8.5 * MG, "ACC_ZBIAS_LEARN": learn}
    _, answer = said(capsys, dataflash(tmp_path / "1.bin", messages(flown, parameters(**learned))), *storage(tmp_path))
    (imu,) = answer["flights"][0]["imus"]
    (note,) = imu["notes"]
    told = re.fullmatch(rf"accel z: INS_ACC_VRFB_Z, learned in hover, {words}, is \+8\.5 mg; "
                        r"here in the air (.*) ± (.*) mg", note)  # fmt: skip
    assert told is not None, note
    found_mg, sigma_mg = map(float, told.groups())
    assert abs(found_mg - (ACCEL_MG[2] + STEP_MG)) < 2.0 * sigma_mg < 3.0


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


def of_px4(flown: Flown, path: Path, began_s: float = 0.0) -> Path:
    at, slow = flown.at_s, flown.at_s[::25]
    place = np.tile([LATITUDE_DEG, HEIGHT_M], (len(at), 1))
    spun = ((slow >= flown.motors_s) & (slow < flown.disarmed_s))[:, None]
    bias = [*(each * DEG_H for each in GYRO_DEG_H), *[1e-10] * 3, *(each * MG for each in ACCEL_MG), *[1e-6] * 3]
    topics = {
        ("sensor_combined", 0): (flown.t_s, flown.readings),
        ("vehicle_attitude", 0): (at, flown.quaternions),
        ("vehicle_local_position", 0): (at, np.hstack([flown.velocity, flown.position, place])),
        ("actuator_armed", 0): (slow, column((slow >= 64.0) & (slow < 242.0))),
        ("vehicle_land_detected", 0): (slow, column((slow < 67.0) | (slow >= 240.0))),
        ("actuator_motors", 0): (slow, 0.5 * np.hstack([np.tile(spun, (1, 4)), np.full((len(slow), 8), np.nan)])),
        ("estimator_sensor_bias", 0): (slow, np.tile([0.0, *bias], (len(slow), 1))),
    }
    return write_ulog(path, {name: (at_s + began_s, rows) for name, (at_s, rows) in topics.items()})


def test_a_simulated_px4_counts_from_1970(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert companion(["log", "flight", str(of_px4(flown, tmp_path / "log.ulg", 1.7e9)), *storage(tmp_path)]) == 0
    assert ": armed in start 1 of the autopilot\n" in capsys.readouterr().out


def test_a_flight_of_px4_is_told_alike(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = of_px4(flown, tmp_path / "log.ulg")
    code, answer = said(capsys, path, *storage(tmp_path))
    assert code == 0
    (flight,) = answer["flights"]
    assert flight["stages"]["motors_s"] == pytest.approx(65.0, abs=1.0)
    assert flight["stages"]["take_off_s"] == pytest.approx(67.0, abs=1.0)
    (imu,) = flight["imus"]
    # No parameters are in this log.
    assert imu["notes"][0].startswith("the autopilot has no IMU 1: only 0 of CAL_ACC0_ID")
    for axis, bias_now, unit in zip(
        imu["axes"], (*GYRO_DEG_H, ACCEL_MG[2] + STEP_MG), (DEG_H, DEG_H, DEG_H, MG), strict=True
    ):
        assert abs(axis["in_flight"]["value"] / unit - bias_now) < 2.0 * axis["in_flight"]["sigma"] / unit
    assert imu["axes"][0]["ekf"]["value"] / DEG_H == pytest.approx(GYRO_DEG_H[0])
    assert 60.0 < imu["drift"]["flown"][1]["median_m"] < 200.0


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
    assert companion(["log", "flight", str(path), *storage(tmp_path)]) == 1
    assert capsys.readouterr().err == f"companion: {path}: {words}\n"


def test_what_a_failed_imu_reads_is_left_aside(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Real ArduPilots log a gyro that hangs like this: the same rates repeated, and GH 0."""
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
