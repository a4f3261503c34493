"""One cell of the table: a fault in a phase, from a seed."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import random
import re
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.estimation.machine import State
from sim.motions import Handling
from tests.campaign import witness as judge
from tests.campaign.fault import Fault, Phase, Scene
from tests.campaign.loop import run_on_campaign_loop, tasks_of
from tests.campaign.stage import VARIANTS, Census, Stage
from tests.campaign.station import Operator
from tests.campaign.witness import Witness
from tests.support.component import ACCEPTED, CALIBRATE, DENIED, TEMPORARILY_REJECTED, UNDO

SHORTEST_S: dict[str, dict[Phase, float]] = {
    "ArduPilot 4.8": {"waiting": 7.0, "collecting": 1.9, "solving": 0.6, "writing": 3.8, "verifying": 4.8},
    "ArduPilot 4.6": {"waiting": 7.0, "collecting": 1.9, "solving": 0.6, "writing": 3.8, "verifying": 4.8},
    "PX4": {"waiting": 7.0, "collecting": 1.9, "solving": 0.12, "writing": 4.0, "verifying": 4.0},
}
"""Shortest undisturbed duration of each phase: the instant of the fault is drawn from it."""
RECOVERED_WITHIN_S = 240.0
MOST_VIRTUAL_S = 1500.0
DRAWS = 4
SETTLES = 10
REFUSALS = 9
"""Requests, 4 s apart, that may be refused after a fault: contradicting heartbeats are believed again after 30 s of
nothing but "disarmed" (docs/security.md)."""


@dataclasses.dataclass
class Outcome:
    fault: str
    phase: Phase
    seed: int
    problems: list[str] = dataclasses.field(default_factory=list)
    not_applicable: str = ""
    variant: str = ""
    story: list[str] = dataclasses.field(default_factory=list)
    writes: int = 0
    cpu_s: float = 0.0

    @property
    def verdict(self) -> str:
        return "n.a." if self.not_applicable else "FAIL" if self.problems else "ok"


Sabotage = Callable[[Stage], None]
"""For the tests of the judge: breaks the daemon on purpose."""


class MissedError(Exception):
    """The instant drawn was after the end of the phase: nothing has been tried yet."""


def _leaked(calm: Census, now: Census) -> bool:
    return now.tasks > calm.tasks + 1 or now.handlers > calm.handlers or now.descriptors > calm.descriptors + 2


def run_cell(fault: Fault, phase: Phase, seed: int, *, sabotage: Sabotage | None = None) -> Outcome:
    """Play a cell and judge it; where the dice miss the phase they are thrown again, a few times."""
    for draw in range(DRAWS):
        try:
            return _play(fault, phase, seed, draw, sabotage)
        except MissedError as error:
            missed = f"the phase was missed {DRAWS} times: {error}"
    outcome = Outcome(fault.name, phase, seed)
    outcome.problems.append(missed)
    return outcome


def _play(fault: Fault, phase: Phase, seed: int, draw: int, sabotage: Sabotage | None) -> Outcome:
    outcome = Outcome(fault.name, phase, seed)
    if phase in fault.not_in:
        outcome.not_applicable = fault.not_in[phase]
        return outcome
    # A seed gives the same cell whatever else is run.
    chance = random.Random(f"{seed} {fault.name} {phase}" + (f" {draw}" if draw else ""))
    variant = chance.choice([one for one in VARIANTS if one.name in fault.variants])
    outcome.variant = variant.name
    began_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="c") as folder:
        stage: Stage | None = None

        async def play() -> None:
            nonlocal stage
            stage = Stage(
                Path(folder),
                variant,
                seed=chance.randrange(1 << 30),
                at_arm=fault.at_arm,
                recordings_mb=fault.recordings_mb,
            )
            before = len(asyncio.all_tasks())
            async with asyncio.timeout(MOST_VIRTUAL_S):
                await _Course(fault, phase, stage, outcome, sabotage).run()
            left = [task for task in asyncio.all_tasks() if not task.done()]
            if len(left) > before:
                outcome.problems.append(f"tasks left at the end: {[task.get_coro() for task in left]}")

        try:
            run_on_campaign_loop(play())
        except MissedError:
            raise
        except AssertionError as error:
            outcome.problems.append(f"{error}" or traceback.format_exc(limit=-3))
        except Exception:  # noqa: BLE001 - whatever it is, it is what the cell shows
            outcome.problems.append(traceback.format_exc(limit=-6))
    outcome.cpu_s = time.process_time() - began_s
    return outcome


class _Course:
    """The course of a cell: from a healthy daemon into the phase, through the fault, and out again."""

    def __init__(
        self, fault: Fault, phase: Phase, stage: Stage, outcome: Outcome, sabotage: Sabotage | None = None
    ) -> None:
        self._fault, self._phase, self._stage, self._outcome = fault, phase, stage, outcome
        self._sabotage = sabotage
        self._scene = Scene(stage, phase)
        self._operator = Operator(stage)
        self._witness = Witness(stage)
        self._asked: asyncio.Task[int | None] | None = None
        self._heard: set[str] = set()
        self._known: list[judge.Values] = []

    def _wrong(self, words: str) -> None:
        if words not in self._outcome.problems:
            self._outcome.problems.append(words)

    def _tell(self, words: str) -> None:
        self._outcome.story.append(f"{self._stage.now_s - 1000.0:7.2f} {words}")

    async def run(self) -> None:
        stage = self._stage
        if self._sabotage is not None:
            inner, breaks = stage.on_start, self._sabotage

            def broken() -> None:
                inner()
                breaks(stage)

            stage.on_start = broken
        async with stage.running_all():
            await stage.ready()
            await asyncio.sleep(1.0)
            self._known.append(judge.vectors(stage))
            strangers = judge.others(stage)
            whole = stage.census()
            await self._reach()
            calm = Census(*map(max, whole, stage.census()))
            records = judge.kept(stage.store)
            await self._suffer()
            await self._rest()
            self._judge_rest(records)
            await self._recover()
            if judge.others(stage) != strangers:
                self._wrong(f"offsets of another sensor changed: {strangers} {judge.others(stage)}")
            await asyncio.sleep(4.0)
            for _ in range(SETTLES):
                # Sockets are real, and close when the kernel gets round to it; what is leaked is there for good.
                if not _leaked(calm, stage.census()):
                    break
                await asyncio.sleep(1.0)
            self._judge_end(calm)
        left = tasks_of(stage.owner)
        if left:
            self._wrong(f"tasks of the daemon left after its end: {[str(task.get_coro()) for task in left]}")

    # --- into the phase

    async def _reach(self) -> None:
        """Bring the calibration into the phase; at a random instant of it this returns."""
        stage, phase = self._stage, self._phase
        if phase in ("done", "armed"):
            assert await self._operator.ask(CALIBRATE) == ACCEPTED, "the calibration before the fault failed"
            self._known.append(judge.vectors(stage))
            if phase == "armed":
                stage.autopilot.arm()
                await asyncio.sleep(1.5)
            await asyncio.sleep(stage.chance.uniform(0.0, 3.0))
        elif phase == "idle":
            await asyncio.sleep(stage.chance.uniform(0.0, 3.0))
        else:
            state = State(phase)
            entered = stage.entered[state]
            motion_s = 4.0 if phase == "waiting" else 1.5
            stage.aircraft.add(
                Handling(
                    start_s=stage.aircraft.time_at(stage.now_s), duration_s=motion_s, seed=stage.chance.randrange(99)
                )
            )
            await asyncio.sleep(0.5)
            self._asked = asyncio.create_task(self._operator.ask(CALIBRATE))
            async with asyncio.timeout(60.0):
                await entered.wait()
            await asyncio.sleep(stage.chance.uniform(0.0, SHORTEST_S[stage.variant.name][phase]))
            found = stage.service.calibrating.manager.state
            if found is not state:
                raise MissedError(found.value)
        self._tell(f"{phase}: strikes")

    # --- through the fault

    async def _suffer(self) -> None:
        stage, fault = self._stage, self._fault
        watching = asyncio.create_task(self._watch())
        try:
            await fault.strike(self._scene)
            if self._asked is None and self._phase != "armed":
                # A fault that nobody meets while it lasts is none.
                await asyncio.sleep(stage.chance.uniform(0.1, 1.0))
                command = CALIBRATE if self._phase == "idle" else stage.chance.choice((CALIBRATE, UNDO))
                self._tell(f"asked for {command}")
                self._asked = asyncio.create_task(self._operator.ask(command))
            await asyncio.sleep(stage.chance.uniform(*fault.lasts_s))
            self._hear()
            await fault.lift(self._scene)
            self._tell("lifted")
            await asyncio.sleep(1.0)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(0.5)
            self._hear()

    def _hear(self) -> None:
        if self._stage.alive:
            self._heard.update(self._stage.words())

    async def _rest(self) -> None:
        """Everything comes to its end by itself: the request, the mending."""
        stage = self._stage
        stage.autopilot.disarm()
        deadline_s = stage.now_s + RECOVERED_WITHIN_S

        def restless() -> str:
            job = stage.service.calibrating.manager.job
            if job is not None and not job.finished.done():
                return f"the {job.kind} still runs: {job.words}"
            if stage.service.offsets.journal.pending:
                return "old values are still to be put back"
            return ""

        await asyncio.sleep(2.0)
        while why := restless():
            self._hear()
            assert stage.now_s < deadline_s, f"no rest within {RECOVERED_WITHIN_S:.0f} s after the fault: {why}"
            if (error := await stage.daemon_failed()) is not None:
                raise error
            await asyncio.sleep(0.5)
        if self._asked is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(30.0):
                    result = await self._asked
                    self._tell(f"the request ended with {result}")
        self._hear()

    def _judge_rest(self, records: dict[str, bytes]) -> None:
        stage, fault = self._stage, self._fault
        now = judge.vectors(stage)
        last = stage.service.calibrating.manager.last
        done = [self._written(record) for record in stage.service.calibrating.store.history() if record.state == "done"]
        done += judge.undoable(stage)
        for words in judge.half_written(now, *self._known, *[{**now, **each} for each in done if each]):
            if "somebody else" not in self._scene.notes:
                self._wrong(words)
        in_force = last is not None and last.state == "done" and not last.undone_at and self._written(last)
        if in_force and not fault.moves and all(abs(now[k] - v) < 1e-9 for k, v in self._written(last).items()):
            for words in judge.off_truth(stage, last):
                self._wrong(words)
        for words in judge.lost(records, stage.store, self._scene.spoilt):
            self._wrong(words)
        for words in judge.unreadable(stage.store, self._scene.spoilt):
            self._wrong(words)
        self._known.append(now)
        self._judge_words(last)

    @staticmethod
    def _written(record: Any) -> dict[str, float]:
        return {
            name: written.read_back if written.read_back is not None else written.after
            for imu in record.imus
            for name, written in imu.written.items()
        }

    def _judge_words(self, last: Any) -> None:
        stage, fault = self._stage, self._fault
        said = [*self._heard, *stage.said.lines, *stage.ground.texts()]
        named = fault.names is None or any(re.search(fault.names, line) for line in said)
        if not named and self._phase in fault.named_in:
            self._wrong(f"nobody says what is wrong ({fault.names}); last said: {stage.said.lines[-3:]}")
        if last is not None and last.state == "failed":
            patterns = [p for p in (fault.names, fault.excused) if p is not None]
            self._tell(f"failed: {last.reason}")
            if not any(re.search(pattern, last.reason) for pattern in patterns):
                self._wrong(f"the reason does not name the fault: {last.reason}")
        for line in said:
            if "internal error" in line or "fault of the program" in line:
                self._wrong(f"a fault of the program: {line}")

    # --- out again

    async def _recover(self) -> None:
        stage = self._stage
        result = None
        for _ in range(REFUSALS):
            result = await self._operator.ask(CALIBRATE, within_s=RECOVERED_WITHIN_S)
            if result not in (TEMPORARILY_REJECTED, DENIED):
                break
            await asyncio.sleep(4.0)
        if result != ACCEPTED:
            last = stage.service.calibrating.manager.last
            self._wrong(
                f"no calibration afterwards: {result}, {last.reason if last else None}; {stage.ground.texts()[-3:]}"
            )
            return
        last = stage.service.calibrating.manager.last
        assert last is not None
        for words in judge.off_truth(stage, last):
            self._wrong(f"afterwards: {words}")
        after = judge.vectors(stage)
        result = await self._operator.ask(UNDO, within_s=RECOVERED_WITHIN_S)
        now = judge.vectors(stage)
        undo_spoilt = any("undo" in name for name in self._scene.spoilt)
        if result != ACCEPTED and not self._written(last) and undo_spoilt:
            return  # the calibration changed nothing, and the values for an earlier undo were what was damaged
        if result != ACCEPTED:
            self._wrong(f"no undo afterwards: {result}; {stage.ground.texts()[-3:]}")
        elif judge.half_written(now, self._known[-1]) and after != self._known[-1]:
            self._wrong(f"the undo has not brought back {self._known[-1]} but {now}")

    def _judge_end(self, calm: Census) -> None:
        stage, outcome = self._stage, self._outcome
        outcome.writes = self._witness.writes
        for words in self._witness.faults:
            self._wrong(words)
        if self._witness.open_requests:
            self._wrong(f"no final answer to {self._witness.open_requests}")
        if (silence_s := self._witness.silence_s(stage.now_s)) > judge.SILENT_S:
            self._wrong(f"no heartbeat for {silence_s:.1f} s")
        if stage.link.received["handler error"]:
            self._wrong(f"{stage.link.received['handler error']} handlers of MAVLink messages raised")
        now = stage.census()
        if _leaked(calm, now):
            self._wrong(f"not as before the fault: {calm} {now}")
