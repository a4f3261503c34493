"""Earlier biases across power-ups: what the daemon remembers, how good it makes it, and what it names."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.estimation.records.history import PowerUp
from companion.estimation.records.record import ImuRecord, Record
from companion.lab.replay import replay
from companion.storage.records import BiasStore
from sim.devices import Gradienter
from sim.imu_model import DEG_H, MG
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

SCATTER_DEG_H, SCATTER_MG = 70.0, 0.5
FEW: dict[str, Any] = {"min_still_s": 5.0, "max_s": 6.0}


def since(run: int) -> PowerUp:
    """Days apart, which virtual time does not show."""
    return PowerUp(host=f"power-up {run}", since_unix_s=86400.0 * run)


def power_up(
    folder: Path, run: int, *, before: Callable[[Rig], None] | None = None, times: int = 1, **options: Any
) -> tuple[list[Record], dict[str, tuple[Any, Any]], Rig]:
    """One power-up of the aircraft with biases drawn for it: its records, its true biases, and what is left of it."""
    truths: dict[str, tuple[Any, Any]] = {}

    async def main() -> tuple[list[Record], Rig]:
        rig = Rig(folder, seed=run, **({"own_imu": True} | FEW | options))
        random = np.random.default_rng(run)
        models = {"fc": rig.model, **({"own": rig.own_model} if hasattr(rig, "own_model") else {})}
        for model in models.values():
            model.turn_on(
                (100.0 + random.normal(0, SCATTER_DEG_H, 3)) * DEG_H, (1.0 + random.normal(0, SCATTER_MG, 3)) * MG
            )
        if before is not None:
            before(rig)
        records = []
        async with rig.running():
            rig.service.calibrating.memory.power_up = lambda name, unix_s: since(run)  # type: ignore[method-assign]
            await rig.ready()
            for _ in range(times):
                result, record = await calibrated(rig)
                assert result.outcome == "done", result
                records.append(record)
            for name, model in models.items():
                truths[name] = model.true_bias(rig.aircraft.time_at(rig.now_s))
            await asyncio.sleep(2.5 if "recordings_mb" in options else 0.1)
        return records, rig

    records, rig = run_virtual(main())
    return records, truths, rig


def priors(imu: ImuRecord) -> tuple[dict[str, Any], dict[str, Any]]:
    assert imu.prior is not None
    gyro, accel = imu.prior.values()
    assert gyro is not None
    assert accel is not None
    return gyro, accel


def knocked(rig: Rig) -> None:
    """The gradienter's plate has slipped by 0.3 degrees."""
    gradienter = rig.devices["gradienter"]
    assert isinstance(gradienter, Gradienter)
    gradienter.offset_deg = (0.3, 0.0)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that remembers one power-up of the rig, and four more that are drawn by the same law."""
    folder = tmp_path_factory.mktemp("known")
    _, truths, _ = power_up(folder, 0)
    store, random = BiasStore(folder), np.random.default_rng(100)
    imus = store.read()
    assert {name: len(imu.points) for name, imu in imus.items()} == {"fc": 1, "own": 1}
    for run in range(1, 5):
        for name, imu in imus.items():
            first = imu.points[0]
            assert first.gyro is not None
            assert first.accel is not None
            gyro = (100.0 + random.normal(0, SCATTER_DEG_H, 3)) * DEG_H
            accel = (1.0 + random.normal(0, SCATTER_MG, 3)) * MG
            # The gradienter's zero is off by the same in all of them.
            accel += np.subtract(first.accel.bias, truths[name][1])
            another = msgspec.structs.replace(
                first,
                started_at=f"power-up {run}",
                power_up=since(run),
                gyro=msgspec.structs.replace(first.gyro, bias=tuple(gyro.tolist())),
                accel=msgspec.structs.replace(first.accel, bias=tuple(accel.tolist())),
            )
            imus[name] = msgspec.structs.replace(imus[name], points=(*imus[name].points, another))
    store.write(imus)
    return folder


def copied(folder: Path, to: Path) -> Path:
    (to / "biases.json").write_bytes((folder / "biases.json").read_bytes())
    return to


def test_the_next_power_up_is_right_and_knows_the_earlier_ones(known: Path, tmp_path: Path) -> None:
    earlier = BiasStore(known).read()
    (record,), truths, _ = power_up(copied(known, tmp_path), 5)
    for imu in record.imus:
        gyro, accel = truths[imu.name]
        assert imu.gyro_bias_rad_s is not None
        assert imu.accel_bias_m_s2 is not None
        assert imu.gyro_sigma_use_rad_s is not None
        assert imu.accel_sigma_use_m_s2 is not None
        assert np.abs(np.subtract(imu.gyro_bias_rad_s, gyro) / imu.gyro_sigma_use_rad_s).max() < 3.5
        assert np.abs(np.subtract(imu.accel_bias_m_s2, accel) / imu.accel_sigma_use_m_s2).max() < 3.5
        assert imu.effective is not None
        assert imu.effective.scale_from == "assumed"
        assert not any("differs by" in words for words in imu.warnings), imu.warnings
        gyro_prior, accel_prior = priors(imu)
        assert gyro_prior["power_ups"] == accel_prior["power_ups"] == 5
        assert gyro_prior["used"]
        mean = np.mean([point.gyro.bias for point in earlier[imu.name].points if point.gyro is not None], axis=0)
        np.testing.assert_allclose(gyro_prior["expected_rad_s"], mean, atol=0.1 * DEG_H)
    kept = BiasStore(tmp_path).read()
    assert {name: len(imu.points) for name, imu in kept.items()} == {"fc": 6, "own": 6}


def test_a_gradienter_that_has_moved_is_named_and_a_replay_says_so_without_the_disk(
    known: Path, tmp_path: Path
) -> None:
    (record,), _, rig = power_up(copied(known, tmp_path), 6, before=knocked, recordings_mb=64)
    (words,) = [words for words in record.warnings if "gradienter" in words]
    assert words.startswith("the gradienter has moved by 0.3")
    assert "(fc, own)" in words
    assert "gradienter has moved" in "".join(rig.ground.texts())
    for imu in record.imus:
        assert [prior["used"] for prior in priors(imu)] == [True, False]
    last = BiasStore(tmp_path).read()["fc"].points[-1]
    assert last.accel is not None
    assert last.accel.suspect
    # What was known is in the recording: what lies on the disk has changed since.
    (tmp_path / "biases.json").unlink()
    (again,) = replay(sorted((tmp_path / "recordings").glob("0*.mcap"))).calibrations
    assert again.not_recomputed is None
    assert [str(difference) for difference in again.differences] == []
    assert [imu.prior for imu in again.record.imus] == [imu.prior for imu in record.imus]


def test_another_imu_in_its_place_has_no_curve_and_the_same_one_keeps_it(known: Path, tmp_path: Path) -> None:
    """The sixth power-up of the one, the first of the other: told by the device id of its gyro."""
    store = BiasStore(copied(known, tmp_path))
    fc = store.read()["fc"]
    spread = [msgspec.structs.replace(point, temperature_degc=5.0 + 8.0 * k) for k, point in enumerate(fc.points)]
    store.write({"fc": msgspec.structs.replace(fc, points=tuple(spread))})

    _, _, rig = power_up(tmp_path, 8, own_imu=False)
    memory = rig.service.calibrating.memory
    assert memory.curve("fc", "gyro") is not None
    assert memory.temperature()[0]["curve"]

    def exchanged(rig: Rig) -> None:
        ids = rig.double.parameters
        ids.values["INS_GYR_ID"] += 256.0

    _, _, rig = power_up(tmp_path, 9, before=exchanged, own_imu=False, times=0)
    (shown,) = rig.service.calibrating.memory.temperature()
    assert (shown["points"], shown["curve"]) == ((), ())
    assert shown["needs"] == "gyro (device id) changed: earlier biases no longer count"

    (record,), _, rig = power_up(tmp_path, 9, before=exchanged, own_imu=False)
    assert record.imus[0].prior is None
    assert "imu fc: gyro (device id) changed: earlier biases no longer count" in record.imus[0].warnings
    assert rig.service.calibrating.memory.curve("fc", "gyro") is None
    assert len(store.read()["fc"].points) == 1


async def test_what_is_undone_is_forgotten(tmp_path: Path) -> None:
    async with Rig(tmp_path, **FEW).running() as rig:
        await rig.ready()
        assert (await calibrated(rig))[0].outcome == "done"
        assert len(BiasStore(tmp_path).read()["fc"].points) == 1
        undone = await started(rig.service.calibrating.manager.start_undo("test")).finished
        assert undone.outcome == "done"
        assert BiasStore(tmp_path).read()["fc"].points == ()
