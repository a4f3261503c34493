"""Two years of daily sessions on the disk: bounded, always readable, and whole after a power cut in mid-write."""

from __future__ import annotations

import math
import os
from pathlib import Path

import msgspec
import pytest

from companion.errors import StorageError
from companion.estimation.records.history import KEEP_POINTS, KEEP_POWER_UPS, Point
from companion.storage.records import KEEP_IMUS, BiasStore, KnownImu
from tests.support.histories import two_years


@pytest.fixture(scope="module", name="two_years")
def fixture_two_years() -> tuple[Point, ...]:
    return two_years()


def test_two_years_of_three_imus_are_small_and_a_power_cut_leaves_what_was_there(
    two_years: tuple[Point, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = two_years
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


def test_the_most_that_is_kept_can_be_read_again(two_years: tuple[Point, ...], tmp_path: Path) -> None:
    assert len(two_years) == KEEP_POWER_UPS * KEEP_POINTS
    imus = {str(number): KnownImu(identity={}, points=two_years) for number in range(KEEP_IMUS)}
    BiasStore(tmp_path).write(imus)
    assert BiasStore(tmp_path).all() == imus


@pytest.mark.parametrize("figure", [math.nan, math.inf, 200.0, -200.0])
def test_what_could_not_be_read_again_is_not_written(
    two_years: tuple[Point, ...], tmp_path: Path, figure: float
) -> None:
    store, point = BiasStore(tmp_path), two_years[0]
    store.write(sound := {"fc": KnownImu(identity={}, points=(point,))})
    assert point.gyro is not None
    spoilt = msgspec.structs.replace(point, gyro=msgspec.structs.replace(point.gyro, bias=(0.0, figure, 0.0)))
    with pytest.raises(StorageError, match=r"\(biases\.json\)"):
        store.write({"fc": KnownImu(identity={}, points=(spoilt,))})
    assert store.all() == sound
