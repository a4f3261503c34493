"""Saved noise profiles: files that survive, names that are taken, and one line for every mistake; and the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.ardupilot import ArduPilot
from companion.cli import main as companion
from companion.config import parse
from companion.config.sections import AllanModel
from companion.configured import models
from companion.configured.models import Profiles
from companion.errors import ConfigError, StorageError
from companion.estimation.noise.allan import noise_profile
from companion.lab.log_files import read_logs
from companion.recording.files import Beginning, RecordingFile
from companion.recording.messages import IMU, MAVLINK, ImuState, Message, encode
from companion.storage.profiles import FORMAT_VERSION, ProfileSource, ProfileStore, SavedProfile, saved_profile
from companion.storage.state import MOST_BYTES, sealed, unsealed
from tests.support.made_noise import DEG_H, adis16405, write_csv
from tests.unit.daemon.test_plan import CALIBRATION

GYRO = AllanModel(7e-5, 2e-5, 1e-6)
ACCEL = AllanModel(5e-4, 2e-4, 1e-5)
SMALLEST = '[mavlink]\nurl = "udpin:127.0.0.1:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\nprofile = "{}"\n'


def saved(name: str = "mine", **changes: Any) -> SavedProfile:
    source = ProfileSource(file="a.csv", began_at=None, still_s=5400.0, temperature_degc=(20.0, 21.5))
    profile = SavedProfile(
        format_version=FORMAT_VERSION, name=name, saved_at="2026-11-21T10:00:00+00:00", imu="fc", gyro=GYRO,
        accel=ACCEL, kept_from="unknown", kept=("gyro K",), sources=(source,),
    )  # fmt: skip
    return msgspec.structs.replace(profile, **changes)


# --- files


def test_a_profile_comes_back_as_it_was(tmp_path: Path) -> None:
    store = ProfileStore(tmp_path)
    assert store.names() == []
    path = store.write(saved())
    assert path == tmp_path / "profiles" / "mine.json"
    assert (store.names(), store.read("mine")) == (["mine"], saved())
    store.write(saved(kept=()))
    assert store.read("mine").kept == ()
    assert [entry.name for entry in path.parent.iterdir()] == ["mine.json"]


def changed(**changes: Any) -> Callable[[bytes], bytes]:
    """Change the file as another version, or a person, would."""
    return lambda data: sealed(json.dumps(json.loads(unsealed(data)) | changes).encode())


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: data[: len(data) // 2], "truncated"),
        (lambda _: b"", "truncated"),
        (lambda _: b"\x00\xff" * 40, "mine.json: cannot be used: "),
        (lambda _: b"[1, 2]", "mine.json: cannot be used: "),
        (lambda data: data.replace(b'"mine"', b'"nine"'), "its checksum does not fit: damaged, or changed by hand"),
        (lambda data: data + b" " * MOST_BYTES, f"more than {MOST_BYTES} bytes"),
        (changed(format_version=2), "found format 2; allowed: up to 1 (a newer companion has saved it)"),
        (changed(name="other"), "it is of 'other'"),
        (changed(gyro={"white": -1.0, "flicker": 0.0, "walk": 0.0}), "allowed: N above 0"),
        (changed(gyro={"white": 0.0, "flicker": 0.0, "walk": 0.0}), "allowed: N above 0"),
        (changed(accel={"white": 1.0}), "missing required field"),
        (changed(gyro="loud"), "Expected `object`"),
    ],
)
def test_a_damaged_or_newer_one_is_refused_in_one_line(
    tmp_path: Path, damage: Callable[[bytes], bytes], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    store = ProfileStore(tmp_path)
    path = store.write(saved())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(StorageError) as caught:
        store.read("mine")
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    # The configuration that names it is refused, in one line that says where.
    with pytest.raises(ConfigError) as refused:
        parse(SMALLEST.format("mine"), "x.toml", lambda _, name: saved_profile(tmp_path, name))
    assert str(refused.value).startswith("x.toml: 'imu[0].profile': found 'mine', a saved profile: ")
    assert words in str(refused.value)
    # All but the daemon's own start, which no file may prevent: then with the figures of the worst parts, and a word.
    config = parse(SMALLEST.format("mine"), "x.toml", lambda _, name: saved_profile(tmp_path, name, forgiving=True))
    assert str(Profiles(config).status()[0]["summary"]).startswith("mine, sigmas (errors) assume the worst")
    instead, worst = noise_profile(config.imu[0].profile), noise_profile(None)
    assert (instead.gyro, instead.accel) == (worst.gyro, worst.accel)
    (said,) = caplog.messages
    assert words in said


@pytest.mark.parametrize(
    "name", ["", "A", "../x", ".hidden", "a b", "a/b", "a" * 41, "bmi088", "icm-42688-p", "ICM42688P", "unknown"]
)
def test_names_that_are_not(tmp_path: Path, name: str) -> None:
    with pytest.raises(StorageError, match="allowed"):
        ProfileStore(tmp_path).write(saved(name))
    assert not (tmp_path / "profiles").exists()


# --- in the configuration


@pytest.mark.parametrize(("name", "near"), [("mime", "mine"), ("bmi08", "bmi088")])
def test_an_unknown_name_is_refused_with_the_nearest_of_both(tmp_path: Path, name: str, near: str) -> None:
    store = ProfileStore(tmp_path)
    store.write(saved())
    with pytest.raises(ConfigError) as caught:
        parse(SMALLEST.format(name), "x.toml", lambda _, name: saved_profile(tmp_path, name))
    text = str(caught.value)
    assert text.startswith(f"x.toml: 'imu[0].profile': found {name!r}; allowed: \"icm42688p\", ")
    assert text.endswith(f"did you mean {near!r}?")
    assert '"mine"' in text


# --- the command


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, Any], str]:
    code = companion(["log", "profile", "--json", *map(str, arguments)])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else {}, said.err


@pytest.fixture(scope="module")
def half_hour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t_s, readings = adis16405(1800, 8, seed=3)
    return write_csv(tmp_path_factory.mktemp("logs") / "half_hour.csv", t_s, readings)


def test_learned_saved_and_in_use(tmp_path: Path, capsys: pytest.CaptureFixture[str], half_hour: Path) -> None:
    code, answer, _ = run(capsys, half_hour, "--save", "mine", "--storage", tmp_path)
    assert (code, answer["state"]) == (0, "done")
    assert answer["file"] == str(tmp_path / "profiles" / "mine.json")
    (imu,) = answer["imus"]
    assert imu["still_s"] == pytest.approx(1798, abs=8)
    (used,) = imu["used"]
    assert used["seconds"] == pytest.approx(1798, abs=1)
    profile = ProfileStore(tmp_path).read("mine")
    assert profile.gyro.white / DEG_H == pytest.approx(150.0, rel=0.08)
    assert (profile.sources[0].file, profile.imu) == ("half_hour.csv", "imu")
    toml = tmp_path / "x.toml"
    toml.write_text(SMALLEST.format("mine") + f'[storage]\ndirectory = "{tmp_path}"\n', encoding="utf-8")
    config = parse(toml.read_text(encoding="utf-8"), "x.toml", saved_profile)
    assert noise_profile(config.imu[0].profile).gyro == profile.gyro
    # Whose figures they are, for `companion status`.
    (shown,) = Profiles(config).status()
    assert (shown["imu"], shown["name"], shown["fitted"]) == (config.imu[0].name, "mine", True)
    assert shown["file"] == str(tmp_path / "profiles" / "mine.json")
    assert str(shown["summary"]).startswith("mine, learned from 0.5 h at rest in 1 recording, saved ")
    # A log is replayed with it, and compared with it, by its name or as a file, wherever that lies.
    elsewhere = tmp_path / "from a laptop.json"
    elsewhere.write_bytes((tmp_path / "profiles" / "mine.json").read_bytes())
    short = tmp_path / "short.csv"
    short.write_text("".join(half_hour.read_text().splitlines(keepends=True)[:600]), encoding="utf-8")
    sigmas = {}
    for wanted in ("mine", str(elsewhere), "adis16405", "ADIS-16405"):
        assert companion(["-c", str(toml), "log", "replay", str(short), "--json", "--profile", wanted]) == 0
        sigmas[wanted] = json.loads(capsys.readouterr().out)["imus"][0]["gyro_sigma_use_rad_s"]
    assert sigmas["mine"] == sigmas[str(elsewhere)] != sigmas["adis16405"] == sigmas["ADIS-16405"]
    code, answer, _ = run(capsys, "-c", toml, half_hour, "--profile", "mine")
    assert (code, answer["imus"][0]["compared"]["name"]) == (0, "mine")


@pytest.mark.parametrize(
    ("text", "more", "code", "words"),
    [
        ("t_s,gx\n1,2\n", [], 1, "line 1: no column for gx, gy, gz, ax, ay, az in t_s, gx"),
        ("", [], 1, "the file is empty"),
        (None, [], 1, "No such file"),
        (None, ["--save", "bmi088"], 1, "found a built-in part's name"),
        (None, ["--profile", "bmi08"], 2, "did you mean 'bmi088'?"),
        ("short", ["--short"], 1, "imu imu: only 28 s at rest; a profile needs 60 s"),
        ("short", ["--short", "--imu", "fc"], 1, "imu fc: only 28 s at rest"),
        ("minutes", [], 1, "imu imu: only 118 s at rest; a profile needs 600 s, better an hour (--short accepts less)"),
    ],
)
def test_every_mistake_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, more: list[str], code: int, words: str
) -> None:
    path = tmp_path / "a.csv"
    if text in {"short", "minutes"}:
        write_csv(path, *adis16405(30 if text == "short" else 120, 20, 1))
    elif text is not None:
        path.write_text(text, encoding="utf-8")
    assert companion(["log", "profile", str(path), *more]) == code
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


# --- recordings of our own


def recording(
    path: Path,
    t_s: list[float],
    imu: str,
    message: str = "HIGHRES_IMU",
    unix_s: float = 1.7e9,
    written_s: float | None = None,
) -> Path:
    """A recording of noise; at `written_s` the daemon wrote offsets, which moved the gyros by 100 deg/h."""
    config = parse(SMALLEST.format("bmi088"), "x.toml")
    (instance, kind) = next(
        (instance, each) for instance, all_ in ArduPilot.imu_messages.items() for each in all_ if each.name == message
    )
    state = ImuState(
        sender=(1, 1),
        firmware="ardupilot",
        instance=instance,
        message=message,
        input=models.imu_input(config.imu[0], kind),
        calibration=CALIBRATION,
    )
    rng, sender = np.random.default_rng(1), mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    entries: list[Message] = []
    for t in t_s:
        gyro, accel = rng.normal(0.0, 1e-3, 3).tolist(), (rng.normal(0.0, 0.02, 3) - [0.0, 0.0, 9.8]).tolist()
        if written_s is not None and t >= written_s:
            gyro[1] += 100.0 * DEG_H
        if t in {t_s[0], written_s}:
            entries.append((IMU + imu, t, encode(state)))
        device_s = t - 90.0
        degc = mavlink.MAVLink_scaled_imu_message(round(device_s * 1e3), 0, 0, -1000, 0, 0, 0, 0, 0, 0, 2500)
        (ax, ay, az), (gx, gy, gz) = accel, gyro
        floats = mavlink.MAVLink_highres_imu_message(
            round(device_s * 1e6), ax, ay, az, gx, gy, gz, 0, 0, 0, 0, 0, 0, 0, fields_updated=63
        )
        second = mavlink.MAVLink_scaled_imu2_message(round(device_s * 1e3), 0, 0, -1000, 0, 0, 0, 0, 0, 0, 2500)
        data = b"".join(bytes(each.pack(sender)) for each in (degc, floats, second))
        entries.append((MAVLINK, t, data))
    file = RecordingFile(path)
    file.write(entries, Beginning(t_s[0] if t_s else 0.0, round(unix_s * 1e9), msgspec.json.encode(config), ()))
    file.close()
    return path


def seconds(start: int, end: int) -> list[float]:
    return [k / 8.0 for k in range(8 * start, 8 * end)]


def test_recordings_that_follow_on_each_other_are_one_session(tmp_path: Path) -> None:
    first = recording(tmp_path / "1.mcap", seconds(100, 150), "fc", "HIGHRES_IMU")
    second = recording(tmp_path / "2.mcap", seconds(150, 200), "fc", "HIGHRES_IMU")
    later = recording(tmp_path / "3.mcap", seconds(150, 200), "fc", "HIGHRES_IMU", unix_s=1.8e9)
    one, two = read_logs([later, second, first])
    assert (one.files, two.files) == (("1.mcap", "2.mcap"), ("3.mcap",))
    assert (one.t_s[0], one.t_s[-1], len(one.t_s)) == (100.0, 199.875, 800)
    assert one.profile == "bmi088"
    assert one.began_at == "2023-11-14T22:15:00+00:00"
    assert (one.temperature_degc == 25.0).all()


def test_written_offsets_are_no_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A step of 100 deg/h would be flicker of that size; where it was is in the recording."""
    path = recording(tmp_path / "1.mcap", seconds(100, 1300), "fc", written_s=700.0)
    (log,) = read_logs([path])
    assert [(log.t_s[part][0], log.t_s[part][-1]) for part in log.pieces()] == [(100.0, 699.875), (700.0, 1299.875)]
    assert [(log.t_s[part][0], log.t_s[part][-1]) for part in log.pieces(650.0)] == [(750.0, 1299.875)]
    code, answer, _ = run(capsys, path)
    assert code == 0
    (imu,) = answer["imus"]
    # White noise of 73 deg/h sqrt(s) in both parts, and nothing else by more than chance.
    still = imu["axes"][1]["fit"]
    assert not still["known"][1]
    assert still["figures"][1] < 10.0 * DEG_H


def test_whole_thousandths_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path / "1.mcap", seconds(100, 180), "fc", "SCALED_IMU2")
    code, answer, err = run(capsys, path)
    assert (code, answer["state"]) == (1, "failed")
    assert "imu fc: it was recorded in whole mrad/s and mg" in err
