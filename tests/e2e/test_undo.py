"""`companion undo`, step by step: what was written last, then what was before it, each to the bit."""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from companion.autopilot.parameters.change import Change
from companion.component.service import JobResult
from companion.errors import CalibrationRefusedError
from companion.storage.changes import MOST_STEPS, ChangeLog, ChangeSet, Origin, Undoable
from sim.ardupilot.parameters import offset_names
from tests.e2e.test_calibration import started
from tests.support.component import ACCEPTED, DENIED, UNDO
from tests.support.rig import Rig, inline
from tests.support.virtual_time import run_virtual

Values = dict[str, float]
GYROS, ACCELS, SCALES = (offset_names(1, what) for what in ("gyro", "accel", "scale"))
TRIM = ("AHRS_TRIM_X", "AHRS_TRIM_Y")
FIRST: Values = {**dict.fromkeys((*GYROS, *ACCELS, *TRIM), 0.0), **dict.fromkeys(SCALES, 1.0)}
WRITES: tuple[tuple[str, Values], ...] = (
    ("calibration", {**dict.fromkeys(GYROS, 0.001), **dict.fromkeys(ACCELS, 0.05)}),
    ("faces", {**dict.fromkeys(ACCELS, 0.07), **dict.fromkeys(SCALES, 1.002)}),
    ("auto calibration", dict.fromkeys(GYROS, 0.0015)),
    ("auto calibration", dict.fromkeys(GYROS, 0.0025)),
    ("level", dict.fromkeys(TRIM, 0.02)),
)
"""One after the other; the two that nobody asked for are one step."""
STEPS = ("level", "auto calibration", "faces", "calibration")


def step(now: Values, what: str, values: Values, number: int = 0) -> ChangeSet:
    changes = [Change(name, now[name], value) for name, value in values.items()]
    return ChangeSet.of(1, changes, origin=Origin(what, f"2026-11-23T06:{number:02}:00.000+00:00"))


def written(folder: Path) -> list[Values]:
    """Keep the steps; what is in force after so many of them back, as the autopilot holds it, beginning with none."""
    kept, found = Undoable(1), [dict(FIRST)]
    for number, (what, values) in enumerate(WRITES):
        latest = step(found[-1], what, values, number)
        kept = kept.and_then(latest)
        found.append(found[-1] | {each.parameter: each.after for each in latest.changes if each.after is not None})
    ChangeLog(folder).undo_of(1).write(kept)
    return [found[number] for number in (5, 4, 2, 1, 0)]


def read(rig: Rig) -> Values:
    return {name: float(rig.double.parameter(name) or 0.0) for name in FIRST}


def steps(rig: Rig) -> list[str]:
    return [each["what"] for each in rig.service.status()["undoable"]]


async def undone(rig: Rig, *, force: bool = False) -> JobResult:
    return await started(rig.service.calibrating.manager.start_undo("test", force=force)).finished


async def test_each_undo_takes_one_step_back_to_the_bit_says_which_and_then_there_is_nothing(tmp_path: Path) -> None:
    wanted = written(tmp_path)
    async with Rig(tmp_path, parameters=wanted[0]).running() as rig:
        await rig.ready()
        for left, (what, values) in enumerate(zip(STEPS, wanted[1:], strict=True), 1):
            rig.ground.command(UNDO)
            await rig.until(lambda left=left: len(rig.ground.finals(UNDO)) == left, 30.0)  # type: ignore[misc]
            assert read(rig) == values
            assert any(words.endswith(f"old values restored: {what}") for words in rig.ground.texts())
            assert steps(rig) == list(STEPS[left:])
        rig.ground.command(UNDO)
        await rig.until(lambda: rig.ground.finals(UNDO) == [*[ACCEPTED] * len(STEPS), DENIED], 30.0)
        assert "Undo refused: nothing to undo" in rig.ground.texts()
    assert not any("undo-" in name for name in os.listdir(tmp_path))


class Cut(NamedTuple):
    folder: Path
    parameters: Values


def test_a_power_cut_at_any_moment_of_an_undo_costs_no_step_and_takes_back_no_second_one(tmp_path: Path) -> None:
    store = tmp_path / "store"
    wanted = written(store)
    cuts: list[Cut] = []

    async def cut_everywhere() -> None:
        made = Rig(store, parameters=wanted[0])
        seen: list[Any] = []
        cutting = False

        def cut() -> None:
            state = read(made), {path.name: path.read_bytes() for path in store.glob("*.json")}
            if state not in seen:
                seen.append(state)
                folder = tmp_path / f"cut {len(seen)}"
                shutil.copytree(store, folder)
                cuts.append(Cut(folder, state[0]))

        async def offload(function: Any, *arguments: Any) -> Any:
            if not cutting:
                return await inline(function, *arguments)
            cut()
            try:
                return await inline(function, *arguments)
            finally:
                cut()

        made.offload = offload
        async with made.running():
            await made.ready()
            assert (await undone(made)).outcome == "done"
            cutting = True
            job = started(made.service.calibrating.manager.start_undo("test"))
            while job.is_running:
                cut()
                await asyncio.sleep(0.01)
            cut()

    run_virtual(cut_everywhere())
    assert len(cuts) >= 7, "before, the journal, three values, the step, the journal's end"

    async def go_on(cut: Cut) -> int:
        async with Rig(cut.folder, parameters=cut.parameters).running() as rig:
            await rig.ready()
            await rig.until(lambda: not rig.service.offsets.journal.pending, 30.0)
            left = steps(rig)
            assert left in (list(STEPS[1:]), list(STEPS[2:]))
            assert read(rig) == wanted[4 - len(left)]
            assert (await undone(rig)).outcome == "done"
            assert read(rig) == wanted[5 - len(left)]
            return len(left)

    ends = [run_virtual(go_on(cut)) for cut in cuts]
    assert ends == sorted(ends, reverse=True)
    assert set(ends) == {2, 3}


def arms(rig: Rig) -> None:
    rig.double.arm()


def refuses(rig: Rig) -> None:
    rig.double.faults.refuse = {TRIM[0]}


def falls_silent(rig: Rig) -> None:
    rig.wire.cut = True


def mended(rig: Rig) -> None:
    rig.double.disarm()
    rig.double.faults.refuse = set()
    rig.wire.cut = False


@pytest.mark.parametrize(
    ("fault", "why", "restart"),
    [(arms, "armed", True), (refuses, f"refuses to set {TRIM[0]}", False), (falls_silent, "no answer", False)],
)
async def test_an_undo_that_fails_before_its_first_write_can_be_asked_for_again(
    tmp_path: Path, fault: Callable[[Rig], None], why: str, restart: bool
) -> None:
    wanted = written(tmp_path)
    step_file = tmp_path / "undo-1.json"

    async with Rig(tmp_path, parameters=wanted[0]).running() as rig:
        await rig.ready()
        kept = step_file.read_bytes()
        job = started(rig.service.calibrating.manager.start_undo("test"))
        await rig.until((tmp_path / "journal.json").exists, 5.0)
        assert read(rig) == wanted[0]
        fault(rig)
        failed = await job.finished
        assert failed.outcome == "failed"
        assert why in failed.reason
        assert failed.reason.endswith("level stays active: undo again")
        assert "old values restored" not in failed.reason
        assert read(rig) == wanted[0]
        assert step_file.read_bytes() == kept
        assert not rig.service.offsets.journal.pending
        mended(rig)
        if restart:
            await rig.restart()
            await rig.ready()
        await rig.until(lambda: rig.service.core.vehicle.arm_state.name == "DISARMED", 30.0)
        assert steps(rig) == list(STEPS)
        assert (await undone(rig)).reason == "2 old values restored: level"
        assert read(rig) == wanted[1]


async def test_what_somebody_else_has_changed_stops_it_is_named_and_passed_over_by_force(tmp_path: Path) -> None:
    wanted = written(tmp_path)

    async with Rig(tmp_path, parameters=wanted[0]).running() as rig:
        await rig.ready()
        await undone(rig)
        for name in GYROS:
            rig.double.write_as_another_station(name, 0.004)
        now = read(rig)
        refused = await undone(rig)
        assert refused.outcome == "failed"
        assert refused.reason.startswith("auto calibration not undone: another writer or a boot changed")
        assert f"{GYROS[0]} is 0.004, we had set 0.0025 (before: 0.001)" in refused.reason
        assert refused.reason.endswith("companion undo --force skips this step")
        assert read(rig) == now
        assert steps(rig) == list(STEPS[1:])
        forced = await undone(rig, force=True)
        assert forced.reason == "0 old values restored: auto calibration"
        # The faces below it are untouched by that.
        assert (await undone(rig)).reason == "6 old values restored: faces"
        assert read(rig) == wanted[3] | {name: now[name] for name in GYROS}


async def test_right_after_the_start_it_waits_until_the_autopilot_is_heard(tmp_path: Path) -> None:
    wanted = written(tmp_path)

    async def asked(rig: Rig) -> dict[str, Any]:
        (reply,) = [each async for each in rig.service.faces.answer({"command": "undo"}, "test")]
        return dict(reply)

    rig = Rig(tmp_path, parameters=wanted[0])
    rig.wire.cut = True
    async with rig.running():
        asked_s = rig.now_s
        with pytest.raises(CalibrationRefusedError, match="no autopilot found yet"):
            await asked(rig)
        assert 4.0 < rig.now_s - asked_s < 7.0
        asking = asyncio.ensure_future(asked(rig))
        await asyncio.sleep(1.0)
        assert not asking.done()
        rig.wire.cut = False
        reply = await asking
        assert (reply["state"], reply["reason"]) == ("done", "2 old values restored: level")
        assert [reply["undone"]["what"], *(each["what"] for each in reply["undoable"])] == list(STEPS)


def test_ten_steps_are_kept_and_the_oldest_makes_room() -> None:
    kept, now = Undoable(1), dict(FIRST)
    for number in range(MOST_STEPS + 3):
        latest = step(now, "calibration", dict.fromkeys(GYROS, number / 1024), number)
        kept = kept.and_then(latest)
        now |= dict.fromkeys(GYROS, number / 1024)
    assert len(kept.steps) == MOST_STEPS
    assert [each.changes[0].before for each in kept.steps] == [number / 1024 for number in range(11, 1, -1)]


@pytest.mark.parametrize("between", [None, 0.004])
def test_the_latest_of_several_that_are_one_step_can_be_taken_out_of_it_again(between: float | None) -> None:
    """A power cut between the step's file and the journal's end: the write is put back, and is no part of the step."""
    first = step(FIRST, "auto calibration", dict.fromkeys((*GYROS, *ACCELS), 0.0015), 1)
    now = FIRST | dict.fromkeys(GYROS, first.changes[0].after or 0.0 if between is None else between)
    second = step(now, "auto calibration", dict.fromkeys(GYROS, 0.0025), 2)
    both = Undoable(1, (first,)).and_then(second)
    (joined,) = both.steps
    back = {each.parameter: each.before for each in joined.changes}
    assert back == {**dict.fromkeys(ACCELS, 0.0), **dict.fromkeys(GYROS, second.changes[0].before if between else 0.0)}
    (left,) = both.without(second).steps
    assert {(each.parameter, each.before, each.after) for each in left.changes} == {
        (each.parameter, each.before, each.after)
        for each in first.changes
        if between is None or each.parameter in ACCELS
    }
    assert both.without(second).without(second) == both.without(second)
    assert both.without(joined).steps == ()
    assert both.without(step(now, "level", dict.fromkeys(TRIM, 0.02), 3)) is both
