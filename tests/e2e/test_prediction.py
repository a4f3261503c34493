"""Gyro offsets at power-up, before any stillness: learned over power-ups, written, seen, replaced, undone, refused."""

from __future__ import annotations

import asyncio
import re
import shutil
import time
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.calibration.machine import State
from companion.calibration.records.history import PowerUp
from companion.cli.show import history_lines, status_lines
from companion.daemon.biases.memory import AT_POWER_UP_S
from companion.storage.changes import ChangeLog
from sim.ardupilot.double import offset_names
from sim.imu_model import DEG_H, PARTS
from sim.motions import Handling
from sim.thermal import Board
from tests.e2e.test_automatic import calibrated_by_itself
from tests.e2e.test_calibration import FC_PARAMETERS, calibrated
from tests.e2e.test_undo import undone
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

GYROS = offset_names(1, "gyro")
PX4_GYROS = tuple(f"CAL_GYRO0_{axis}OFF" for axis in "XYZ")
PIECE = PARTS["bmi088"].piece(np.random.default_rng(1), np.full(6, 100.0 * DEG_H))
BOARD = Board(rise_k=12.0, time_constant_s=400.0)
LEARNED_DEGC = (10.0, 28.0, 19.0, 13.0, 34.0)
"""The air's, at the power-ups before: the autopilot holds what was right at the last of them."""
NOW_DEGC = 22.0
QUICK: dict[str, Any] = {
    "imus": 1, "part": "bmi088", "min_still_s": 5.0, "max_s": 6.0, "imu_rate_hz": 10.0, "device_rate_hz": 2.0,
    "feed_s": 0.5,
}  # fmt: skip
CARRIED_S = 30.0


@asynccontextmanager
async def powered(
    folder: Path,
    day: int,
    degc: float,
    *,
    carried: bool = True,
    of: PowerUp | None = None,
    before: Callable[[Rig], None] = lambda rig: None,
    **options: Any,
) -> AsyncIterator[Rig]:
    """A power-up of its own in air of this temperature, with a bias of its own; carried about from its beginning on."""
    prior = options.pop("prior", True)
    rig = Rig(folder, seed=day, **{"at_arm": "warn", **QUICK, **options})
    wanted = msgspec.structs.replace(rig.config.calibration, prior=prior)
    rig.config = msgspec.structs.replace(rig.config, calibration=wanted)
    rig.aircraft._temperature = BOARD.switched_on(degc)
    rig.model.curve = PIECE.curve
    rig.model.turn_on(PIECE.turned_on(np.random.default_rng([day, 5]))[:3], np.zeros(3))
    if carried:
        rig.aircraft.add(Handling(start_s=-CARRIED_S, duration_s=2.0 * CARRIED_S, angle_deg=8.0))
    before(rig)
    # Days apart, which virtual time does not show; the latest has just begun.
    days_ago = len(LEARNED_DEGC) - day
    power_up = of or PowerUp(host=f"day {day}", since_unix_s=time.time() - 86400.0 * days_ago)
    async with rig.running():
        rig.service.calibrating.memory.whose.power_up = lambda name, unix_s: power_up  # type: ignore[method-assign]
        yield await rig.ready()


async def learn(folder: Path, names: Iterable[str], **options: Any) -> dict[str, float]:
    """Let it calibrate by itself in power-ups one after the other; the parameters that the autopilot holds then."""
    parameters = dict[str, float]()
    for day, degc in enumerate(LEARNED_DEGC):
        async with powered(folder, day, degc, carried=False, parameters=parameters, **options) as rig:
            await calibrated_by_itself(rig, day + 1)
            parameters = {name: rig.autopilot.parameter(name) for name in names}
    return parameters


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    """What the companion keeps and what the autopilot holds after power-ups in which it has calibrated by itself."""
    folder = tmp_path_factory.mktemp("learned")
    return folder, run_virtual(learn(folder, FC_PARAMETERS))


def copied(learned: tuple[Path, dict[str, float]], to: Path) -> dict[str, Any]:
    """For a seventh power-up."""
    folder, parameters = learned
    shutil.copytree(folder, to, dirs_exist_ok=True)
    return {"folder": to, "day": len(LEARNED_DEGC), "parameters": {"INS_GYR_CAL": 0.0, **parameters}}


def left_deg_h(rig: Rig) -> Any:
    """What is left in the output, the truth."""
    return rig.autopilot.residual(1, rig.now_s).gyro_rad_s / DEG_H


def offsets(rig: Rig, names: tuple[str, ...] = GYROS) -> list[float]:
    return [float(rig.autopilot.parameter(name)) for name in names]


def in_force(rig: Rig) -> str:
    words: str = rig.service.status()["arming"]["in_force"]
    return words


async def predicted(rig: Rig) -> float:
    """Wait for it; the sigma that is said, deg/h."""
    begin = f"predicted from {len(LEARNED_DEGC)} power-ups: "
    await rig.until(lambda: in_force(rig).startswith(begin), 20.0)
    return float(in_force(rig).removeprefix(begin).partition(" deg/h")[0])


def test_it_is_written_while_the_aircraft_is_carried_then_seen_replaced_and_undone(
    learned: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    async def main() -> None:
        async with powered(degc=NOW_DEGC, **copied(learned, tmp_path)) as rig:
            before, was_off, started_s = offsets(rig), left_deg_h(rig), rig.now_s
            sigma = await predicted(rig)
            assert rig.now_s - started_s < 10.0
            assert np.abs(was_off).max() > 3.0 * sigma
            assert np.abs(left_deg_h(rig)).max() < 2.0 * sigma
            assert {write.name for write in rig.double.writes} == set(GYROS)
            after = offsets(rig)
            (said,) = [text for text in rig.ground.texts() if "rediction" in text]
            words = re.fullmatch(r"Gyro prediction done: was (\d+) deg/h off, now (\d+)", said)
            assert words is not None
            assert abs(int(words[1]) - np.abs(was_off).max()) < 2.0 * sigma == 2.0 * int(words[2])
            assert len(said) <= 50
            # It is no calibration: who arms now is told so.
            assert rig.service.arming.readiness.state(rig.now_s)[0] == "uncalibrated"
            assert rig.service.arming.in_force.calibration is None
            (line,) = [line for line in status_lines(rig.service.status()) if line.startswith("by itself, ")]
            assert line.endswith("3 parameters written, in force")
            shown = rig.service.calibrating.by_hand.history()
            assert (shown[0]["what"], shown[0]["state"]) == ("gyro prediction", "predicted")
            assert any("gyro prediction: was" in line for line in history_lines([], [], [], shown))
            # At the first stillness it is looked at, and a calibration replaces it.
            await rig.until(lambda: "; seen: " in in_force(rig) or in_force(rig).startswith("calibrated"), 60.0)
            await calibrated_by_itself(rig, len(LEARNED_DEGC) + 1)
            await rig.until(lambda: in_force(rig).startswith("calibrated"), 10.0)
            assert not any("wrong" in text for text in rig.ground.texts())
            assert offsets(rig) not in (before, after)
            # What nobody has asked for is one step: back to what was there before the first of the power-ups.
            assert [step["what"] for step in rig.service.status()["undoable"]] == ["auto calibration"]
            assert (await undone(rig)).outcome == "done"
            assert offsets(rig) == [0.0, 0.0, 0.0]

    run_virtual(main())


def test_undone_the_old_values_are_back_and_nothing_more_is_written_by_itself(
    learned: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    async def main() -> None:
        async with powered(degc=NOW_DEGC, **copied(learned, tmp_path)) as rig:
            before = offsets(rig)
            await predicted(rig)
            assert rig.service.status()["undoable"][0]["what"] == "gyro prediction"
            result = await undone(rig)
            assert result.reason == "3 old values back: gyro prediction"
            assert offsets(rig) == before
            writes = len(rig.double.writes)
            await asyncio.sleep(60.0)
            assert len(rig.double.writes) == writes
            assert in_force(rig) != "calibration was undone"
            assert rig.service.status()["automatic"]["stopped"] == "undone"
            assert rig.service.calibrating.by_hand.history()[0]["undone_at"]

    run_virtual(main())


def says(degc: Callable[[float], float]) -> Callable[[Rig], None]:
    """Of the thermometer; MAVLink has 0 for none."""

    def before(rig: Rig) -> None:
        rig.model.temperature_degc = degc  # type: ignore[assignment, method-assign]

    return before


async def nothing(rig: Rig) -> None:
    await asyncio.sleep(12.0)
    assert [write for write in rig.autopilot.writes if write.name in GYROS] == []
    assert not any("rediction" in text for text in rig.ground.texts())
    assert not in_force(rig).startswith("predicted")


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"degc": LEARNED_DEGC[-1]}, id="within two sigma"),
        pytest.param({"parameters": {"INS_GYR_ID": 2883586.0}}, id="exchanged"),
        pytest.param({"degc": 60.0}, id="warmer than ever"),
        pytest.param({"at_arm": "off"}, id="not by itself"),
        pytest.param({"more": "[push]\nparameters = false\n"}, id="nothing is written"),
        pytest.param({"before": says(lambda t_s: 0.0)}, id="no thermometer"),
        pytest.param({"before": says(lambda t_s: 10.0 + t_s)}, id="a thermometer that climbs"),
        pytest.param({"prior": False}, id="switched off"),
        pytest.param({"of": PowerUp(host="day 4", since_unix_s=time.time())}, id="the companion ran on"),
        pytest.param({"of": PowerUp(host="now", since_unix_s=time.time() - AT_POWER_UP_S)}, id="on for long"),
        pytest.param({"parameters": {"INS_TCAL1_ENABLE": 1.0}}, id="its own curve"),
    ],
)
def test_nothing_is_predicted(learned: tuple[Path, dict[str, float]], tmp_path: Path, options: dict[str, Any]) -> None:
    kept = copied(learned, tmp_path)
    kept["parameters"] |= options.get("parameters", {})

    async def main() -> None:
        async with powered(**{"degc": NOW_DEGC, **kept, **options, "parameters": kept["parameters"]}) as rig:
            await nothing(rig)

    run_virtual(main())


def test_armed_nothing_is_written_and_disarmed_it_is(learned: tuple[Path, dict[str, float]], tmp_path: Path) -> None:
    async def main() -> None:
        async with powered(degc=NOW_DEGC, before=lambda rig: rig.double.arm(), **copied(learned, tmp_path)) as rig:
            await nothing(rig)
            rig.double.disarm()
            await predicted(rig)
            rig.double.arm()
            said = "Armed UNCALIBRATED: predicted from 5 power-ups"
            await rig.until(lambda: any(text.startswith(said) for text in rig.ground.texts()), 5.0)

    run_virtual(main())


def test_a_gate_still_asks_for_a_calibration(learned: tuple[Path, dict[str, float]], tmp_path: Path) -> None:
    async def main() -> None:
        async with powered(degc=NOW_DEGC, at_arm="gate", **copied(learned, tmp_path)) as rig:
            await predicted(rig)
            readiness, verdicts = rig.service.arming.readiness, set()
            while not in_force(rig).startswith("calibrated"):
                verdicts.add(readiness.answer().verdict)
                await asyncio.sleep(0.2)
            assert verdicts == {"wait"}
            await rig.until(lambda: readiness.answer().verdict == "accept", 5.0)

    run_virtual(main())


@pytest.mark.parametrize("turned_deg_h", [0.0, 3600.0])
def test_what_the_firmware_has_measured_at_its_start_stays_unless_it_cannot_be(
    learned: tuple[Path, dict[str, float]], tmp_path: Path, turned_deg_h: float
) -> None:
    """It takes a steady turn of the ground for a bias."""

    def turning(rig: Rig) -> None:
        for name in GYROS:
            rig.double.parameters.set(name, float(rig.double.parameter(name)) + turned_deg_h * DEG_H)

    async def main() -> None:
        kept = copied(learned, tmp_path)
        kept["parameters"] |= {"INS_GYR_CAL": 1.0}
        async with powered(degc=NOW_DEGC, before=turning, **kept) as rig:
            if turned_deg_h == 0.0:
                await nothing(rig)
                return
            await predicted(rig)
            assert np.abs(left_deg_h(rig)).max() < 0.1 * turned_deg_h
            # The firmware's own calibration at the next start replaces it.
            rig.double.reboot()
            await rig.until(lambda: in_force(rig) == "boot reset gyro offsets", 20.0)

    run_virtual(main())


def test_a_power_cut_in_the_middle_of_it_is_mended_by_the_next_start(
    learned: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    async def main() -> None:
        kept = copied(learned, tmp_path)
        async with powered(degc=NOW_DEGC, **kept) as rig:
            before = offsets(rig)
            await rig.until(lambda: len(rig.double.writes) == 2, 20.0)
            # The daemon is gone, and what it has left on the disk and in the autopilot is all there is.
            shutil.copytree(tmp_path, tmp_path / "cut")
            half = {name: rig.autopilot.parameter(name) for name in FC_PARAMETERS}
        assert ChangeLog(tmp_path / "cut").journal.read() is not None
        assert before != [half[name] for name in GYROS]
        async with Rig(tmp_path / "cut", parameters=half).running() as rig:
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert offsets(rig) == before
            assert rig.service.status()["undoable"][0]["what"] == "auto calibration"

    run_virtual(main())


def test_a_wrong_prediction_is_named_at_the_first_stillness_and_is_never_ready(
    learned: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    async def main() -> None:
        async with powered(degc=NOW_DEGC, **copied(learned, tmp_path)) as rig:
            rig.model.turn_on(np.full(3, 2000.0 * DEG_H), np.zeros(3))
            await predicted(rig)
            await rig.until(
                lambda: any(text == "Predicted bias of fc is wrong: hold still" for text in rig.ground.texts()), 60.0
            )
            # A calibration by itself does not believe it; nothing that was ever right is in force.
            await rig.until(lambda: "held back: gyros of fc" in in_force(rig), 60.0)
            assert in_force(rig).startswith("predicted from 5 power-ups: ")
            assert rig.service.arming.readiness.state(rig.now_s)[0] == "uncalibrated"
            result, _ = await calibrated(rig)
            assert result.outcome == "done"
            await rig.until(lambda: in_force(rig).startswith("calibrated"), 10.0)
            assert np.abs(left_deg_h(rig)).max() < 400.0

    run_virtual(main())


def test_px4_takes_it_too(tmp_path: Path) -> None:
    """The same by way of far values, which PX4 takes small changes from."""
    options: dict[str, Any] = {"firmware": "px4", **QUICK, "imu_rate_hz": 25.0}

    async def main() -> None:
        parameters = await learn(tmp_path, PX4_GYROS, **options)
        async with powered(tmp_path, len(LEARNED_DEGC), NOW_DEGC, parameters=parameters, **options) as rig:
            was = left_deg_h(rig)
            sigma = await predicted(rig)
            assert np.abs(was).max() > 3.0 * sigma
            assert np.abs(left_deg_h(rig)).max() < 2.0 * sigma
            assert rig.service.calibrating.conductor.state is State.DONE

    run_virtual(main())
