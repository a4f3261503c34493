"""Sigma held against what a long still log shows afterwards: on noise that is known, with changes that are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main as companion
from tests.support.made_noise import DEG_H, MG, Floats, adis16405, write_csv

SECONDS, RATE_HZ = 3600, 10


@pytest.fixture(scope="module")
def hour() -> tuple[Floats, Floats]:
    return adis16405(SECONDS, RATE_HZ, seed=11)


def run(capsys: pytest.CaptureFixture[str], path: Path, *more: str) -> tuple[int, dict[str, Any]]:
    code = companion(["log", "replay", str(path), "--json", "--windows", "60", *more])
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
    assert companion(["log", "replay", str(short), "--windows", "60", "--profile", "adis16405"]) == 0
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
    changed = readings + odd * [108.0 * DEG_H, 0, 0, 0, 3.3 * MG, 0]
    _, answer = run(capsys, write_csv(tmp_path / "jumps.csv", t_s, changed), "--profile", "adis16405")
    axes = by_axis(answer, 60.0)
    assert axes["gyro x"]["share"] < 0.75
    assert axes["gyro x"]["ratio"] > 1.6
    assert axes["accel y"]["share"] < 0.1
    assert axes["accel y"]["rms"] == pytest.approx(3.3 * MG, rel=0.1)
    assert axes["gyro y"]["share"] > 0.85
