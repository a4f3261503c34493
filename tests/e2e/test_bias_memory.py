"""Earlier biases across power-ups: what the daemon remembers, how good it makes it, and what it names."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.cli.show import status_lines
from companion.daemon.job import Job
from companion.daemon.offsets import firmware_calibration
from companion.estimation.records.history import PowerUp
from companion.estimation.records.record import PlatformTurn, Record
from companion.lab.replay.engine import replay
from companion.storage.learned import BiasStore
from sim.devices import Gradienter
from sim.imu_model import DEG_H, MG
from sim.motions import SlowTurn
from sim.thermal import warming
from tests.e2e.test_calibration import calibrated
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
            rig.service.calibrating.memory.identities.power_up = lambda name, unix_s: since(run)  # type: ignore[method-assign]
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
        assert imu.prior is not None
        assert imu.prior.gyro is not None
        assert imu.prior.accel is not None
        assert imu.prior.gyro.power_ups == imu.prior.accel.power_ups == 5
        assert imu.prior.gyro.used
        mean = np.mean([point.gyro.bias for point in earlier[imu.name].points if point.gyro is not None], axis=0)
        np.testing.assert_allclose(imu.prior.gyro.expected_rad_s, mean, atol=0.1 * DEG_H)
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
        assert imu.prior is not None
        assert imu.prior.accel is not None
        assert not imu.prior.accel.used
        assert imu.prior.gyro is not None
        assert imu.prior.gyro.used
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
    assert memory.curves.of("fc", "gyro") is not None
    assert memory.temperature()[0]["curve"]

    def exchanged(rig: Rig) -> None:
        ids = rig.double.parameters
        ids.values["INS_GYR_ID"] += 256.0

    _, _, rig = power_up(tmp_path, 9, before=exchanged, own_imu=False, times=0)
    (shown,) = rig.service.calibrating.memory.temperature()
    assert (shown["points"], shown["curve"]) == ((), ())
    assert shown["needs"] == "gyro (device id) changed: earlier biases count no more, a calibration begins anew"

    (record,), _, rig = power_up(tmp_path, 9, before=exchanged, own_imu=False)
    assert record.imus[0].prior is None
    assert "imu fc: gyro (device id) changed since then: its earlier biases are forgotten" in record.imus[0].warnings
    assert rig.service.calibrating.memory.curves.of("fc", "gyro") is None
    assert len(store.read()["fc"].points) == 1


def test_switched_off_nothing_is_asked_but_all_is_remembered(known: Path, tmp_path: Path) -> None:
    def off(rig: Rig) -> None:
        quiet = msgspec.structs.replace(rig.config.calibration, prior=False)
        rig.config = msgspec.structs.replace(rig.config, calibration=quiet)
        knocked(rig)

    (record,), _, _ = power_up(copied(known, tmp_path), 9, before=off, own_imu=False)
    (fc,) = record.imus
    assert fc.prior is None
    assert fc.effective is not None
    assert not any("moved" in words for words in (*record.warnings, *fc.warnings))
    assert {name: len(imu.points) for name, imu in BiasStore(tmp_path).read().items()} == {"fc": 6, "own": 5}


def test_a_damaged_file_costs_one_line_and_what_is_undone_is_forgotten(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "biases.json").write_bytes(b'{"format_version": 1, "imus": {"fc"')

    async def main() -> None:
        async with Rig(tmp_path, **FEW).running() as rig:
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done"
            assert len(BiasStore(tmp_path).read()["fc"].points) == 1
            job = rig.service.calibrating.manager.start_undo("test")
            assert isinstance(job, Job)
            assert (await job.finished).outcome == "done"
            assert BiasStore(tmp_path).read()["fc"].points == ()

    run_virtual(main())
    (line,) = [each.message for each in caplog.records if "biases.json" in each.message]
    assert line.startswith(f"{tmp_path}/biases.json: cannot be used: ")
    assert line.endswith("; set aside as biases.json.unusable")


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On ground that turns no EKF settles: nobody waits for it two and a half minutes, twice a test."""
    monkeypatch.setattr(firmware_calibration, "SETTLE_ALONE_S", 2.0)


def blind(rate_deg_s: float) -> Callable[[Rig], None]:
    """No compass, on a platform that turns so fast from before the beginning."""

    def before(rig: Rig) -> None:
        rig.config = msgspec.structs.replace(rig.config, compass=None)
        del rig.devices["compass"]
        if rate_deg_s:
            rig.aircraft.add(SlowTurn(start_s=-10.0, duration_s=1000.0, rate_deg_s=rate_deg_s))

    return before


@pytest.mark.usefixtures("impatient")
def test_who_has_no_compass_and_no_history_is_told_what_was_assumed(tmp_path: Path) -> None:
    records, _, rig = power_up(tmp_path, 0, before=blind(0.15), times=2)
    for record in records:
        # The second has the first before it, which may have turned as well.
        assert sum("whether the ground turns" in words for words in record.warnings) == 1
        assert record.standing == PlatformTurn(platform="ground", turn_deg_s=None, turn_sigma_deg_s=None, told_by=None)
    assert "whether the ground turns" in "".join(rig.ground.texts())


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("rate_deg_s", [0.0, 0.15])
def test_a_turn_that_no_compass_shows_is_bounded_by_earlier_power_ups(
    known: Path, tmp_path: Path, rate_deg_s: float
) -> None:
    records, truths, _ = power_up(copied(known, tmp_path), 5, before=blind(rate_deg_s), times=2)
    for record in records:
        for imu in record.imus:
            assert imu.gyro_bias_rad_s is not None
            assert imu.gyro_sigma_use_rad_s is not None
            sigma = np.array(imu.gyro_sigma_use_rad_s)
            assert (np.abs(np.subtract(imu.gyro_bias_rad_s, truths[imu.name][0])) < 3.0 * sigma).all()
            assert (sigma.max() > abs(rate_deg_s) / 3.0 * 3600.0 * DEG_H) if rate_deg_s else (sigma < 60 * DEG_H).all()
        standing = record.standing
        assert standing is not None
        assert standing.told_by == "earlier calibrations"
        assert standing.turn_deg_s is not None
        assert standing.turn_sigma_deg_s is not None
        assert abs(standing.turn_deg_s - rate_deg_s) < 3.0 * standing.turn_sigma_deg_s < 3.0 * 0.05
        assert not any("assumed" in words for words in record.warnings)
        side = "right" if rate_deg_s > 0.0 else "left"
        said = any(words.endswith("sigma widened") and side in words for words in record.warnings)
        assert said == bool(rate_deg_s), record.warnings


def test_what_is_seen_while_it_warms_up_is_remembered_although_nobody_calibrates(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path, part="icm42688p", at_arm="off", **FEW)
        rig.model.temperature_degc = lambda t_s: 20.0 + 12.0 * min(t_s / 300.0, 1.0)  # type: ignore[method-assign]
        truth: dict[float, Any] = {}
        async with rig.running():
            await rig.ready()
            for _ in range(40):
                await asyncio.sleep(10.0)
                t_s = rig.aircraft.time_at(rig.now_s)
                truth[rig.model.temperature_degc(t_s)] = rig.model.true_bias(t_s).gyro_rad_s
            assert rig.service.calibrating.store.history() == []
        (points,) = (imu.points for imu in BiasStore(tmp_path).read().values())
        degc = [point.temperature_degc or 0.0 for point in points]
        assert max(degc) - min(degc) > 8.0
        assert min(np.diff(degc)) > 0.5
        for point in points:
            assert point.gyro is not None
            true = truth[min(truth, key=lambda at: abs(at - (point.temperature_degc or 0.0)))]
            off = np.subtract(point.gyro.bias, true)
            # A window of some seconds is half a minute of warming old.
            assert np.abs(off).max() < 4.0 * max(point.gyro.sigma_use) + 0.6 * 18.0 * DEG_H
            assert point.k_s == pytest.approx(0.04, rel=0.3) or (point.temperature_degc or 0.0) > 31.0

    run_virtual(main())


def test_a_calibration_in_mid_warm_up_says_what_the_bias_will_be_when_warm(tmp_path: Path) -> None:
    """Eight days before have shown it; 4 K a minute now."""

    async def main() -> None:
        board = warming(20.0, 40.0, 240.0)
        rig = Rig(
            tmp_path,
            part="icm42688p",
            at_arm="off",
            up_s=60.0,
            temperature_degc=board,
            imu_rate_hz=100.0,
            **FEW,
        )
        async with rig.running():
            memory = rig.service.calibrating.memory
            await rig.ready()
            await calibrated(rig)
            kept = BiasStore(tmp_path).read()
            (first,) = kept["fc"].points[-1:]
            assert first.gyro is not None
            assert first.accel is not None
            random, days = np.random.default_rng(3), []
            for run in range(1, 9):
                usual = random.normal(100.0, 30.0, 3)
                for left in (20.0, 12.0, 6.0, 2.0):
                    degc = 38.0 + random.uniform(0.0, 6.0) - left
                    bias = usual + 18.0 * (degc - 25.0)
                    days.append(
                        msgspec.structs.replace(
                            first,
                            started_at="",
                            power_up=since(run),
                            temperature_degc=degc,
                            k_s=left / 240.0,
                            gyro=msgspec.structs.replace(first.gyro, bias=tuple((bias * DEG_H).tolist())),
                            accel=msgspec.structs.replace(first.accel, bias=(0.15 * (degc - 25.0) * MG,) * 3),
                        )
                    )
            BiasStore(tmp_path).write({"fc": msgspec.structs.replace(kept["fc"], points=(*days, first))})
            memory.load()
            result, record = await calibrated(rig)
            assert result.outcome == "done", result
            (imu,) = record.imus
            assert imu.when_warm is not None
            assert imu.when_warm.degc == pytest.approx(40.0, abs=2.0)
            now_s = rig.aircraft.time_at(rig.now_s)
            now, warm = (rig.model.true_bias(t_s).gyro_rad_s for t_s in (now_s, now_s + 1800.0))
            await asyncio.sleep(3.0)
            assert np.abs(warm - now).min() > 100.0 * DEG_H
            off = np.subtract(imu.when_warm.gyro_bias_rad_s, warm)
            assert np.abs(off / imu.when_warm.gyro_sigma_rad_s).max() < 3.5
            assert max(imu.when_warm.gyro_sigma_rad_s) < 0.3 * np.abs(warm - now).min()
            words, accel = [words for words in imu.warnings if "degC" in words]
            assert re.fullmatch(r"accel fc [xyz] now -?[\d.]+ mg, at (39|4\d) degC -?[\d.]+ \+- [\d.]+", accel), accel
            assert re.fullmatch(r"gyro fc [xyz] now -?\d+ deg/h, at (39|4\d) degC -?\d+ \+- \d+", words), words
            assert words[0].upper() + words[1:] in rig.ground.texts()
            async for reply in rig.service.faces.answer({"command": "status"}):
                assert status_lines(reply["status"])[-2:] == [words, accel]
                assert reply["status"]["calibration"]["imus"][0]["when_warm"] == [words, accel]
            assert not any("sensor is another one" in text for text in rig.ground.texts())
            assert not any("warm-up" in words or "temperature" in words for words in imu.warnings)

    run_virtual(main())
