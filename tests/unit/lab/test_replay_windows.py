"""Sigma held against what a long still log shows afterwards: on noise that is known, with changes that are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.cli import main as companion
from companion.lab.logs.log import StillLog
from companion.lab.replay.estimate import Given, estimate
from tests.support.made_noise import DEG_H, MG, Floats, adis16405, write_csv

SECONDS, RATE_HZ = 3600, 10


@pytest.fixture(scope="module")
def hour() -> tuple[Floats, Floats]:
    return adis16405(SECONDS, RATE_HZ, seed=11)


def run(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["replay", str(path), "--json", "--windows", "60", *more])
    return code, json.loads(capsys.readouterr().out)


def by_axis(answer: dict[str, Any], next_s: float) -> dict[str, dict[str, Any]]:
    return {each["axis"]: each for each in answer["windows"]["axes"] if each["next_s"] == next_s}


def test_sigma_keeps_its_word_on_the_part_that_it_is_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    path = write_csv(tmp_path / "hour.csv", *hour)
    code, answer = run(capsys, path, "--profile", "adis16405")
    assert (code, answer["state"]) == (0, "done")
    # The last sample comes a tenth before the hour is over.
    assert (answer["windows"]["count"], answer["windows"]["done"], answer["windows"]["refused"]) == (59, 59, {})
    for next_s, pairs in ((60.0, 58), (180.0, 56)):
        axes = by_axis(answer, next_s)
        assert list(axes) == ["gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z"]
        for each in axes.values():
            assert each["pairs"] == pairs
            # 58 pairs tell a share to 3 %, the ratio to 10 %; those of three minutes overlap.
            assert each["share"] >= 0.87
            assert 0.6 < each["ratio"] < 1.4
    # The plain means of the minutes, without any estimator.
    minutes = hour[1][: 59 * 600].reshape(59, 600, 6).mean(axis=1)
    rms = np.sqrt(np.square(np.diff(minutes, axis=0)).mean(axis=0))
    for each, plain in zip(by_axis(answer, 60.0).values(), rms, strict=True):
        # A window that looks like a ramp foretells its end.
        assert 0.85 * plain < each["rms"] < 1.4 * plain
    short = write_csv(tmp_path / "short.csv", hour[0][:6000], hour[1][:6000])
    assert companion(["replay", str(short), "--windows", "60", "--profile", "adis16405"]) == 0
    said = capsys.readouterr().out
    # The last sample comes a tenth before the tenth minute is over.
    assert "windows of 60 s: 9, calibrated: 9" in said
    assert "against the next 180 s, 6 pairs:" in said


def test_a_sigma_that_is_too_small_shows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    """A bias that jumps by 0.03 deg/s and 4 mg every other minute: within no sensor's noise, below every gate."""
    t_s, readings = hour
    odd = np.floor(t_s / 60.0)[:, None] % 2.0
    changed = readings + odd * [108.0 * DEG_H, 0, 0, 0, 2.5 * MG, 0]
    _, answer = run(capsys, write_csv(tmp_path / "jumps.csv", t_s, changed), "--profile", "adis16405")
    axes = by_axis(answer, 60.0)
    assert axes["gyro x"]["share"] < 0.75
    assert axes["gyro x"]["ratio"] > 1.6
    assert axes["accel y"]["share"] < 0.1
    assert axes["accel y"]["rms"] == pytest.approx(2.5 * MG, rel=0.1)
    assert axes["gyro y"]["share"] > 0.85


def test_windows_that_are_refused_are_counted_by_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    """Three minutes in the hand, and two that were not logged."""
    t_s, readings = hour[0][:12000], hour[1][:12000].copy()
    rng = np.random.default_rng(2)
    readings[3000:4800, :3] += rng.normal(0.0, 0.3, (1800, 3))
    kept = (t_s < 780.0) | (t_s >= 900.0)
    path = write_csv(tmp_path / "hand.csv", t_s[kept], readings[kept])
    code, answer = run(capsys, path, "--profile", "adis16405")
    assert code == 0
    found = answer["windows"]
    assert (found["count"], found["done"]) == (19, 14)
    counts = found["refused"]
    assert counts.pop("no samples") == 2
    # It shakes, or it turns.
    assert sum(counts.values()) == 3
    assert all(why.startswith("no 5 s at rest in it: hold still: gyro imu") for why in counts)
    # Only windows that follow on one another are held against each other.
    assert by_axis(answer, 60.0)["gyro x"]["pairs"] == 4 + 4 + 3


def test_windows_in_another_pose_are_not_held_against_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    """Turned over after seven minutes: calibrated in both poses, compared within each."""
    t_s, readings = hour[0][:9000], hour[1][:9000]
    turned = np.where(t_s[:, None] < 420.0, readings, readings * [1, -1, -1, 1, -1, -1])
    _, answer = run(capsys, write_csv(tmp_path / "a.csv", t_s, turned), "--profile", "adis16405")
    assert (answer["windows"]["count"], answer["windows"]["done"]) == (14, 14)
    for each in by_axis(answer, 60.0).values():
        assert each["pairs"] == 6 + 6
        assert each["ratio"] < 1.5


def test_what_was_switched_on_long_before_warms_up_no_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    """Five minutes: so young a sensor may still warm up; a pause in the log may have been a switch."""
    path = write_csv(tmp_path / "a.csv", hour[0][:3000], hour[1][:3000])
    young = by_axis(run(capsys, path, "--profile", "adis16405")[1], 60.0)
    old = by_axis(run(capsys, path, "--profile", "adis16405", "--powered", "7200")[1], 60.0)
    # The windows after the pause are two of the three that foretell one.
    kept = (hour[0][:3000] < 55.0) | (hour[0][:3000] > 65.0)
    paused = write_csv(tmp_path / "b.csv", hour[0][:3000][kept], hour[1][:3000][kept])
    _, answer = run(capsys, paused, "--profile", "adis16405", "--powered", "7200")
    for axis in ("gyro x", "gyro y", "gyro z"):
        assert old[axis]["sigma_use"] < 0.9 * young[axis]["sigma_use"]
        assert old[axis]["sigma_use"] < by_axis(answer, 60.0)[axis]["sigma_use"]


def test_a_log_that_is_too_short_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], hour: tuple[Floats, Floats]
) -> None:
    path = write_csv(tmp_path / "short.csv", hour[0][:1000], hour[1][:1000])
    code, answer = run(capsys, path)
    assert (code, answer["state"], answer["reason"]) == (1, "failed", "no two windows in a row that can be calibrated")
    assert answer["windows"]["axes"] == []


def test_an_autopilots_log_says_how_long_its_imu_has_been_on() -> None:
    t_s, readings = adis16405(30, RATE_HZ, seed=3)
    young = StillLog(
        imu="fc", files=("a.bin",), began_unix_s=None, t_s=t_s, readings=readings,
        temperature_degc=np.full(len(t_s), np.nan), clock_from_start=True,
    )  # fmt: skip

    def warm_up(log: StillLog, powered_s: float = 0.0) -> float:
        sigma = estimate(log, Given(heading_deg=0.0, powered=powered_s)).record.imus[0].gyro_sigma_warm_up_rad_s
        assert sigma is not None
        return max(sigma) / DEG_H

    old = msgspec.structs.replace(young, t_s=t_s + 3600.0)
    assert warm_up(young) > 50.0
    assert warm_up(old) < 10.0
    # The same told by hand, of a log whose clock says nothing.
    plain = msgspec.structs.replace(old, clock_from_start=False)
    assert warm_up(plain) == pytest.approx(warm_up(young), rel=0.05)
    assert warm_up(plain, 3600.0) == pytest.approx(warm_up(old), rel=0.05)
