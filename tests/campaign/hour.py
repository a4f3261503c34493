"""An hour of operation with random faults, all faces on: memory flat, nothing leaked, nothing written wrongly."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import gc
import json
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Final, NamedTuple

from tests.campaign import witness as judge
from tests.campaign.catalogue import FAULTS
from tests.campaign.fault import Fault, Scene
from tests.campaign.loop import run_on_campaign_loop
from tests.campaign.stage import VARIANTS, Census, Stage
from tests.campaign.station import Operator
from tests.campaign.witness import Witness
from tests.support.component import ACCEPTED, CALIBRATE, CANCEL, UNDO

MEMORY_TOLERANCE: Final = 0.02
"""Allowed growth of the mean resident memory from the middle third of the hour to the last."""
OBJECTS_TOLERANCE: Final = 0.02
"""Allowed growth of the number of objects that Python's collector knows."""
NAMES: Final = 60_000
REMEMBERED_S: Final = 300.0
"""Length of the true biases' past that the simulator keeps: a calibration is judged by it right after."""


class Sample(NamedTuple):
    minute: int
    rss_mib: float
    objects: int
    census: Census
    fault: str


@dataclasses.dataclass
class Hour:
    seed: int
    variant: str
    samples: list[Sample] = dataclasses.field(default_factory=list)
    problems: list[str] = dataclasses.field(default_factory=list)
    writes: int = 0
    requests: int = 0
    answered: int = 0
    calibrations: int = 0
    longest_silence_s: float = 0.0
    cpu_s: float = 0.0


def _pool(variant: str) -> list[Fault]:
    """Faults that a daemon survives without a restart or a person's help."""
    return [
        fault
        for fault in FAULTS.values()
        if not fault.restarts and variant in fault.variants and fault.at_arm == "off" and fault.name != "echoes-only"
    ]


def _make_room_for_names() -> None:
    """Let the interpreter's table of interned names grow now.

    Each new path puts its parts there. Their places are free again only when the table is made anew, twice as large if
    need be. In the middle of the hour that is a step of 1.9 MiB, once.
    """
    names = [sys.intern(f"room for a name {k}") for k in range(NAMES)]
    names.clear()


def run_hour(seed: int, minutes: float = 60.0) -> Hour:
    _make_room_for_names()
    variant = VARIANTS[seed % len(VARIANTS)]
    hour = Hour(seed, variant.name)
    began_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="c") as folder:

        async def play() -> None:
            stage = Stage(Path(folder), variant, seed=seed, at_arm="warn", recordings_mb=8)
            witness = Witness(stage)
            async with stage.running_all():
                await stage.ready()
                looker = asyncio.create_task(_looks(stage))
                try:
                    await _operate(stage, hour, minutes)
                finally:
                    looker.cancel()
                    await asyncio.gather(looker, return_exceptions=True)
            hour.problems += witness.faults
            hour.writes, hour.longest_silence_s = witness.writes, witness.longest_silence_s
            if witness.longest_silence_s > judge.SILENT_S:
                hour.problems.append(f"no heartbeat for {witness.longest_silence_s:.1f} s")

        try:
            run_on_campaign_loop(play())
        except AssertionError as error:
            hour.problems.append(str(error))
    hour.cpu_s = time.process_time() - began_s
    hour.problems += _growth(hour.samples)
    return hour


async def _operate(stage: Stage, hour: Hour, minutes: float) -> None:
    chance = random.Random(hour.seed)
    pool = _pool(stage.variant.name)
    operator = Operator(stage)
    began_s = stage.now_s
    for minute in range(1, round(minutes) + 1):
        fault = chance.choice(pool)
        asking = asyncio.create_task(_people(operator, hour, chance))
        await asyncio.sleep(chance.uniform(1.0, 12.0))
        scene = Scene(stage, "idle")
        await fault.strike(scene)
        await asyncio.sleep(chance.uniform(*fault.lasts_s))
        await fault.lift(scene)
        if chance.random() < 0.3:
            stage.autopilot.arm()
            await asyncio.sleep(chance.uniform(1.0, 6.0))
        stage.autopilot.disarm()
        await asyncio.sleep(max(0.0, began_s + 60.0 * minute - stage.now_s))
        if (error := await stage.daemon_failed()) is not None:
            raise AssertionError(f"{fault.name}: the daemon ended: {error!r}")
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        hour.samples.append(_sample(stage, minute, fault.name))
    await _to_rest(stage)
    hour.calibrations = sum(record.state == "done" for record in stage.service.calibrating.store.history())
    if await operator.ask(CALIBRATE) != ACCEPTED:
        last = stage.service.calibrating.manager.last
        hour.problems.append(f"no calibration after the hour: {last.reason if last else None}")
    else:
        assert stage.service.calibrating.manager.last is not None
        hour.problems += [
            f"after the hour: {words}" for words in judge.off_truth(stage, stage.service.calibrating.manager.last)
        ]


async def _people(operator: Operator, hour: Hour, chance: random.Random) -> None:
    while True:
        await asyncio.sleep(chance.uniform(2.0, 25.0))
        hour.requests += 1
        result = await operator.ask(chance.choices((CALIBRATE, CANCEL, UNDO), weights=(6, 1, 2))[0])
        hour.answered += result is not None


async def _to_rest(stage: Stage) -> None:
    manager = stage.service.calibrating.manager
    await asyncio.sleep(5.0)
    await stage.until(
        lambda: (manager.job is None or manager.job.finished.done()) and not stage.service.offsets.journal.pending,
        240.0,
    )


def _sample(stage: Stage, minute: int, fault: str) -> Sample:
    # What the stage itself remembers is not the daemon's.
    stage.ground.received.clear()
    stage.ground.raw.clear()
    stage.autopilot.writes.clear()
    stage.said.lines.clear()
    for model in (*stage.models, stage.own_model):
        model.forget_before(stage.aircraft.time_at(stage.now_s) - REMEMBERED_S)
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return Sample(minute, pages * 4096 / 2**20, len(gc.get_objects()), stage.census(), fault)


async def _looks(stage: Stage) -> None:
    """Watch the page all the time, and reconnect."""
    while True:
        with contextlib.suppress(OSError, TimeoutError):
            reader, writer = await _control(stage)
            try:
                while await reader.read(65536):
                    pass
            finally:
                writer.transport.abort()
        await asyncio.sleep(1.0)


async def _control(stage: Stage) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await asyncio.open_unix_connection(str(stage.config.control.path))
    writer.write(b'{"command": "monitor"}\n')
    return reader, writer


def _growth(samples: list[Sample]) -> list[str]:
    """Growth from the middle third to the last."""
    third = len(samples) // 3
    if not third:
        return ["too short to judge"]
    middle, last = samples[third : 2 * third], samples[2 * third :]
    found = []
    for name, tolerance, of in (
        ("resident memory (MiB)", MEMORY_TOLERANCE, lambda s: s.rss_mib),
        ("objects", OBJECTS_TOLERANCE, lambda s: float(s.objects)),
    ):
        before, after = (statistics.fmean(of(sample) for sample in part) for part in (middle, last))
        if after > before * (1.0 + tolerance):
            found.append(f"{name} grew from {before:.1f} to {after:.1f} in the mean of the last third")
    for field in Census._fields:
        before, after = (min(getattr(sample.census, field) for sample in part) for part in (middle, last))
        if after > before:
            found.append(f"{field} grew from {before} to {after}, the least of the last third")
    return found


def main(seed: int, minutes: float, path: str | None) -> int:
    """Run it and print what was seen; 1 when something grew or was wrong."""
    hour = run_hour(seed, minutes)
    print(f"{minutes:.0f} simulated minutes on {hour.variant}, seed {seed}: {hour.cpu_s:.0f} s of processor time")
    print(f"{'minute':>6} {'RSS MiB':>8} {'objects':>8} {'tasks':>6} {'handlers':>9} {'files':>6}  last fault")
    for sample in hour.samples:
        if sample.minute % max(1, len(hour.samples) // 12) == 0:
            print(
                f"{sample.minute:6} {sample.rss_mib:8.1f} {sample.objects:8} {sample.census.tasks:6}"
                f" {sample.census.handlers:9} {sample.census.descriptors:6}  {sample.fault}"
            )
    print(
        f"{hour.requests} requests, {hour.answered} answered; {hour.calibrations} calibrations done; {hour.writes}"
        f" parameters set; longest silence {hour.longest_silence_s:.2f} s"
    )
    for words in hour.problems:
        print(f"FAIL {words}")
    print("nothing grew, nothing leaked" if not hour.problems else "NOT in order")
    if path:
        Path(path).write_text(json.dumps(dataclasses.asdict(hour), indent=1) + "\n", encoding="utf-8")
    return 1 if hour.problems else 0
