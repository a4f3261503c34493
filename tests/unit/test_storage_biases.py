"""Two years of daily sessions on the disk: bounded, and whole after a power cut in mid-write."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from companion.calibration.records.history import Measured, Point, PowerUp, kept
from companion.errors import StorageError
from companion.storage.learned import BiasStore, KnownImu


def day(number: int) -> list[Point]:
    """A warm-up of eight kelvin and more, colder in winter."""
    axes = (0.000123456789, -0.00098765432, 0.00055555555)
    figures = Measured(bias=axes, sigma_stat=axes[:1] * 3, sigma_use=axes[:1] * 3, sigma_shared=axes[:1] * 3)
    return [
        Point(
            started_at="",
            unix_s=1.7e9 + 86400.0 * number + 30.0 * step,
            power_up=PowerUp(host=f"{number:032x}", since_unix_s=1.7e9 + 86400.0 * number),
            temperature_degc=15.0 + 12.345678 * math.sin(number / 58.1) + 2.0 * step,
            up=(0.087155743, -0.052335956, -0.994822),
            gyro=figures,
            accel=figures,
        )
        for step in range(8)
    ]


def test_two_years_of_three_imus_are_small_and_a_power_cut_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points: tuple[Point, ...] = ()
    for first in range(0, 730, 73):
        points = kept((*points, *(point for number in range(first, first + 73) for point in day(number))))
    store = BiasStore(tmp_path)
    store.write({name: KnownImu(identity={"gyro": name}, points=points) for name in ("one", "two", "three")})
    (file,) = tmp_path.iterdir()
    assert file.stat().st_size < 2**20
    known = store.read()
    assert {name: len(imu.points) for name, imu in known.items()} == dict.fromkeys(("one", "two", "three"), len(points))
    span = [point.temperature_degc or 0.0 for point in known["one"].points]
    assert min(span) < 4.0  # winter is in it
    assert max(span) > 38.0

    def cut(*_: object) -> None:
        raise OSError

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", cut)
        with pytest.raises(StorageError):
            store.write({})
    assert store.read() == known
