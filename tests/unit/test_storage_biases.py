"""The file of earlier biases: there as it was written, bounded, and no loss when it is damaged."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.calibration.records.history import Measured, Point, PowerUp
from companion.errors import StorageError
from companion.storage.learned import KEEP_IMUS, KEEP_POINTS, BiasStore, KnownImu

ONE = Measured(bias=(0.1, 1e-17, -3.0), sigma_stat=(1.0, 2.0, 3.0), sigma_use=(4.0, 5.0, 6.0), sigma_shared=(0, 0, 0))


def point(k: int) -> Point:
    return Point(
        started_at=str(k),
        unix_s=float(k),
        power_up=PowerUp(host="here", since_unix_s=0.1 * k),
        temperature_degc=None,
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
    kept = store.read()
    assert sorted(kept) == [f"imu{n}" for n in range(10 - KEEP_IMUS, 10)]
    for name, known in kept.items():
        assert known == msgspec.structs.replace(imus[name], points=imus[name].points[-KEEP_POINTS:])
    assert [path.name for path in tmp_path.iterdir()] == ["biases.json"]


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
