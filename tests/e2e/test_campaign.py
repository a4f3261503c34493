"""A slice of the fault campaign (`python -m tests.campaign` is the whole), and whether its judge sees what is wrong."""

from __future__ import annotations

import asyncio
import gc
import warnings
from collections.abc import Iterator

import pytest

from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.commands import CommandServer
from tests.campaign.__main__ import SEED, slice_of
from tests.campaign.catalogue import FAULTS
from tests.campaign.cell import run_cell
from tests.campaign.fault import PHASES, Phase
from tests.campaign.hour import run_hour
from tests.campaign.loop import OWNER
from tests.campaign.stage import VARIANTS, Stage

# A daemon that is killed closes no file.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

CELLS: list[tuple[str, Phase, int]] = [
    ("arms-in-write", "writing", SEED),
    ("kill", "writing", SEED),
    ("disk-full", "verifying", SEED),
    ("echoes-only", "writing", SEED),
    *slice_of(SEED, 4),
]
"""The cells that show most of what a write must survive, and a slice of the others."""
CELLS_A_TEST = 4


@pytest.mark.parametrize("first", range(0, len(CELLS), CELLS_A_TEST))
def test_a_slice_of_the_table(first: int) -> None:
    for name, phase, seed in CELLS[first : first + CELLS_A_TEST]:
        outcome = run_cell(FAULTS[name], phase, seed)
        again = f"python -m tests.campaign --only {name} --phase {phase} --seed {seed}"
        assert outcome.problems == [], f"{again}: {outcome.story}"


def test_a_few_minutes_of_the_hour() -> None:
    hour = run_hour(SEED, minutes=3.0)
    assert [words for words in hour.problems if "grew" not in words] == []  # minutes are too few to tell growth
    assert hour.longest_silence_s < 2.0


def test_the_catalogue_is_whole() -> None:
    assert len(FAULTS) >= 40
    for fault in FAULTS.values():
        assert set(fault.not_in) < set(PHASES)
        assert set(fault.variants) <= {variant.name for variant in VARIANTS}
    assert {fault.room for fault in FAULTS.values()} == {
        "device", "link", "autopilot", "disk", "clock", "process", "files", "faces", "intruder",
    }  # fmt: skip


def test_a_slice_is_the_same_every_time_and_of_every_room() -> None:
    assert slice_of(SEED, 12) == slice_of(SEED, 12) != slice_of(SEED + 1, 12)
    assert len({FAULTS[name].room for name, _, _ in CELLS}) >= 6


@pytest.fixture(autouse=True)
def what_dead_daemons_left() -> Iterator[None]:
    """Files and sockets of daemons that were killed: collected here, lest they are blamed on a later test."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


# --- the judge


def test_a_daemon_that_writes_while_armed_is_caught() -> None:
    class Reckless(Vehicle):
        arm_state = ArmState.DISARMED

    async def ensure() -> None:
        pass

    def sabotage(stage: Stage) -> None:
        vehicle = stage.service.core.vehicle
        vehicle.__class__ = Reckless
        vehicle.disarmed.ensure, vehicle.disarmed.proven = ensure, lambda: True  # type: ignore[method-assign]

    def is_caught(seed: int) -> bool:
        problems = run_cell(FAULTS["arms"], "writing", seed, sabotage=sabotage).problems
        return any(words.startswith("PARAM_SET") and "armed True" in words for words in problems)

    # One strike in some thirty comes after the last PARAM_SET.
    assert any(is_caught(SEED + k) for k in range(3))


def test_a_daemon_that_does_not_mend_is_caught() -> None:
    async def never(_open_set: object) -> None:
        await asyncio.Event().wait()

    def sabotage(stage: Stage) -> None:
        stage.service.offsets.recovery._recover = never  # type: ignore[assignment,method-assign]

    # Some strikes come before the first write, when nothing has to be put back.
    def is_caught(seed: int) -> bool:
        problems = run_cell(FAULTS["arms-in-write"], "solving", seed, sabotage=sabotage).problems
        return any("still to be put back" in words for words in problems)

    assert any(is_caught(SEED + k) for k in range(3))


def test_a_daemon_that_answers_twice_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    finally_ = CommandServer._finally

    def twice(self: CommandServer, *what: object) -> None:
        finally_(self, *what)  # type: ignore[arg-type]
        finally_(self, *what)  # type: ignore[arg-type]

    monkeypatch.setattr(CommandServer, "_finally", twice)
    outcome = run_cell(FAULTS["clock-step"], "done", SEED)
    assert any("a second final answer" in words for words in outcome.problems), outcome


def test_a_daemon_that_leaks_tasks_is_caught() -> None:
    def sabotage(stage: Stage) -> None:
        owner = stage.owner

        def leak(_: object) -> None:
            if OWNER.get() == owner:
                asyncio.get_running_loop().create_task(asyncio.sleep(1e6))

        stage.service.core.vehicle.on_event.add(leak)

    outcome = run_cell(FAULTS["link-cut"], "done", SEED, sabotage=sabotage)
    assert any("not as before the fault" in words for words in outcome.problems), outcome


def test_a_daemon_that_stands_still_is_caught() -> None:
    def sabotage(stage: Stage) -> None:
        component = stage.service.faces.component
        step = component._step

        def slow(now_s: float) -> float:
            component._next_heartbeat_s += 2.0
            return step(now_s)

        component._step = slow  # type: ignore[method-assign]

    outcome = run_cell(FAULTS["clock-step"], "armed", SEED, sabotage=sabotage)
    assert any("no heartbeat" in words for words in outcome.problems), outcome
