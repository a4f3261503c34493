"""The file of earlier biases: there as it was written, bounded, and no loss when it is damaged."""

from __future__ import annotations

import itertools
import json
import logging
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.calibration.records.history import KEEP_POINTS, KEEP_POWER_UPS, Measured, Point, PowerUp, kept
from companion.errors import StorageError
from companion.storage.learned import KEEP_IMUS, BiasStore, KnownImu

ONE = Measured(bias=(0.1, 1e-17, -3.0), sigma_stat=(1.0, 2.0, 3.0), sigma_use=(4.0, 5.0, 6.0), sigma_shared=(0, 0, 0))


def point(k: int, run: int = 0, degc: float | None = None, *, by_hand: bool = True) -> Point:
    return Point(
        started_at=str(k) if by_hand else "",
        unix_s=float(k),
        power_up=PowerUp(host=f"boot {run}", since_unix_s=86400.0 * run + 0.1 * k),
        temperature_degc=degc,
        up=(0.0, 0.6, -0.8),
        zero="zero",
        zero_sigma_rad=1e-4,
        gyro=ONE,
        accel=msgspec.structs.replace(ONE, suspect=True),
    )


def test_it_is_read_as_it_was_written_and_keeps_the_latest(tmp_path: Path) -> None:
    store = BiasStore(tmp_path)
    assert store.read() == {}
    imus = {
        f"imu{n}": KnownImu(identity={"profile": "unknown"}, points=tuple(point(100 * n + k) for k in range(50)))
        for n in range(10)
    }
    store.write(imus)
    read = store.read()
    assert sorted(read) == [f"imu{n}" for n in range(10 - KEEP_IMUS, 10)]
    for name, known in read.items():
        assert known == msgspec.structs.replace(imus[name], points=imus[name].points[-KEEP_POINTS:])
    assert [path.name for path in tmp_path.iterdir()] == ["biases.json"]


def test_of_a_power_up_the_ends_of_its_temperatures_stay_and_what_was_calibrated_before_what_was_seen() -> None:
    warming = [point(k, degc=20.0 + 0.5 * k, by_hand=k % 10 == 0) for k in range(40)]
    left = kept(warming)
    assert len(left) == KEEP_POINTS
    assert {str(k) for k in range(0, 40, 10)} < {each.started_at for each in left}
    degc = [each.temperature_degc or 0.0 for each in left]
    assert degc == sorted(degc)
    assert (degc[0], degc[-1]) == (20.0, 39.5)
    assert max(b - a for a, b in itertools.pairwise(degc)) < 6.0
    decided = [msgspec.structs.replace(warming[1], gyro=msgspec.structs.replace(ONE, chosen=True)), *warming]
    assert decided[0] in kept(decided)


def test_winter_is_not_forgotten_in_summer() -> None:
    winter = [point(k, run=k, degc=2.0 + 0.3 * k) for k in range(5)]
    summer = [point(k, run=k, degc=25.0 + k % 7) for k in range(5, 200)]
    left = kept([*winter, *summer])
    assert len(left) == KEEP_POWER_UPS
    assert sum(each in winter for each in left) >= 3
    assert left[-10:] == tuple(summer[-10:])


def test_two_years_of_days_are_small_and_read_at_once(tmp_path: Path) -> None:
    points = [point(k, run=k // 12, degc=5.0 + (k // 12) % 30 + k % 12, by_hand=False) for k in range(12 * 730)]
    months: tuple[Point, ...] = ()
    for k in range(0, len(points), 12 * 10):
        months = kept((*months, *points[k : k + 12 * 10]))
    BiasStore(tmp_path).write({name: KnownImu(identity={}, points=months) for name in ("fc", "fc2", "fc3")})
    assert (tmp_path / "biases.json").stat().st_size < 2**20
    assert BiasStore(tmp_path).read()["fc3"].points == months


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff\x00", b"[]", b'{"format_version": 2, "imus": {}}', b'{"imus": {"fc": {"points": [1]}}}', b"{" * 10000],
)
def test_what_cannot_be_read_is_one_line(tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "biases.json"
    path.write_bytes(content)
    assert BiasStore(tmp_path).read() == {}
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage().startswith(f"{path}: cannot be used: ")
    assert record.getMessage().endswith("; set aside as biases.json.unusable")
    assert "\n" not in record.getMessage()


@pytest.mark.parametrize(
    "changes", [{"bias": (11.0, 0.0, 0.0)}, {"sigma_use": (-1.0, 0.0, 0.0)}, {"sigma_stat": (1e30, 0.0, 0.0)}]
)
def test_figures_that_no_gyro_has_are_neither_kept_nor_believed(tmp_path: Path, changes: dict[str, Any]) -> None:
    wrong = msgspec.structs.replace(point(1), gyro=msgspec.structs.replace(ONE, **changes))
    with pytest.raises(StorageError, match="not written: found a bias of"):
        BiasStore(tmp_path).write({"fc": KnownImu(identity={}, points=(point(0), wrong))})
    whole = {"format_version": 1, "imus": {"fc": {"identity": {}, "points": [msgspec.to_builtins(wrong)]}}}
    (tmp_path / "biases.json").write_text(json.dumps(whole))
    assert BiasStore(tmp_path).read() == {}


def test_any_cut_of_it_is_no_loss(tmp_path: Path) -> None:
    store = BiasStore(tmp_path)
    store.write({"fc": KnownImu(identity={}, points=(point(1), point(2)))})
    whole = (tmp_path / "biases.json").read_bytes()
    assert json.loads(whole)["format_version"] == 1
    for end in range(0, len(whole) - 2, 7):
        (tmp_path / "biases.json").write_bytes(whole[:end])
        assert store.read() == {}


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"biases\.json: cannot be written"):
        BiasStore(tmp_path / "file").write({})
