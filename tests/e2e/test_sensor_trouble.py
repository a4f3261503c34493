"""What is wrong with a sensor reaches the big word, and nothing is measured with readings that lie."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from sim.devices import Frame
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


@contextlib.asynccontextmanager
async def watched(rig: Rig) -> AsyncIterator[Rig]:
    """The rig, with its sensors looked after as if their ports were open."""
    async with rig.running():
        for sensor in rig.service.devices.sensors:
            sensor.link._descriptor = -1
        watch = asyncio.create_task(rig.service.devices.watch.run())
        try:
            yield await rig.ready()
        finally:
            watch.cancel()
            for sensor in rig.service.devices.sensors:
                sensor.link._descriptor = None


def saying(rig: Rig, words: Callable[[int], bytes]) -> None:
    """Let the gradienter say something else."""
    device = rig.devices["gradienter"]
    frames = device.frames_until

    def otherwise(t_s: float) -> list[Frame]:
        return [frame._replace(data=words(round(frame.sampled_s * 10))) for frame in frames(t_s)]

    device.frames_until = otherwise  # type: ignore[method-assign]


def test_a_silent_gradienter_is_the_headline_with_what_to_look_at(tmp_path: Path) -> None:
    async def main() -> None:
        async with watched(Rig(tmp_path, at_arm="warn")) as rig:
            rig.unplugged.add("gradienter")
            faces = rig.service.faces
            await rig.until(lambda: "silent (power? wiring?" in faces.all_status()["headline"]["reason"], 10.0)
            headline = faces.all_status()["headline"]
            assert headline["word"] == "NOT CALIBRATED"
            assert headline["reason"].startswith("gradienter: /nowhere/gradienter at 9600 baud")
            rig.unplugged.clear()
            await rig.until(lambda: "silent" not in faces.all_status()["headline"]["reason"], 3.0)

    run_virtual(main())
