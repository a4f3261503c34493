"""An autopilot alone, on which stands are made by somebody who takes hold of the aircraft."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from companion.component.service import JobResult
from companion.daemon.job import Job
from sim.hands import Hands
from tests.support.rig import Rig

ASKED_AGAIN_S = 8.0
"""A movement takes 6 s, and is seen some seconds after it has begun."""
Meddle = Callable[[int, float], object]
"""Called at the stand of that number with the aircraft time; true: the stand is skipped."""
NOTHING: Meddle = lambda _number, _t_s: None  # noqa: E731


def alone(folder: Path, *, placement_deg: float = 0.0, propped_deg: float = 0.0, **more: Any) -> tuple[Rig, Hands]:
    """An autopilot and nothing else, and hands that are that careful."""
    made = Rig(folder, **more)
    made.config = msgspec.structs.replace(made.config, gradienter=None, compass=None)
    made.devices.clear()
    return made, Hands(made.aircraft, placement_deg=placement_deg, propped_deg=propped_deg, seed=3)


async def follow(rig: Rig, hands: Hands, job: Job, meddle: Meddle = NOTHING) -> JobResult:
    """Hold it or turn it as the words say, each time that they ask for it; or do what `meddle` does instead."""
    next_s = 0.0
    while not job.finished.done():
        if "waiting for it to move" in job.words and rig.now_s >= next_s:
            next_s = rig.now_s + ASKED_AGAIN_S
            now_s = rig.aircraft.time_at(rig.now_s)
            if not meddle(int(job.words.partition(" ")[0]), now_s):
                assert hands.follow(job.words, now_s), job.words
        await asyncio.sleep(0.5)
    return job.finished.result()
