"""A stranger sends under the autopilot's ids: effect on a calibration, and the message to the pilot."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.estimation.machine import What
from sim.imu_model import MG
from tests.support.rig import ACCEL_BIAS_MG, Rig

Message = mavlink.MAVLink_message
QUICK: dict[str, Any] = {"min_still_s": 5.0, "max_s": 10.0, "imu_rate_hz": 10.0}


@contextlib.asynccontextmanager
async def spoofed(rig: Rig, every_s: float, *messages: Callable[[], Message]) -> AsyncIterator[None]:
    """Messages under the autopilot's ids, in turn, beside its own."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    async def say() -> None:
        while True:
            for message in messages:
                await asyncio.sleep(every_s)
                rig.wire.carry_from_other(message().pack(codec))
                codec.seq = (codec.seq + 1) % 256

    task = asyncio.create_task(say())
    try:
        yield
    finally:
        task.cancel()


def calibrate(rig: Rig) -> Job:
    answer = rig.service.calibrating.manager.start_calibration(What.BOTH, "a pilot")
    assert not isinstance(answer, Refusal), answer.reason
    return answer


def announced() -> Message:
    return mavlink.MAVLink_param_value_message(b"INS_GYROFFS_X", 0.3, 9, 1000, 65535)


def beat(*, armed: bool) -> Callable[[], Message]:
    return lambda: mavlink.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 0, 4, 3)


def restarted() -> Message:
    return mavlink.MAVLink_system_time_message(0, 5)


async def test_an_announced_offset_that_is_not_in_force_disturbs_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Rig(tmp_path).running() as rig:
        await rig.ready()
        async with spoofed(rig, 3.0, announced):
            job = calibrate(rig)
            async with asyncio.timeout(60.0):
                result = await job.finished
        assert result.outcome == "done"
        assert job.record is not None
        found = np.array(job.record.imus[0].accel_bias_m_s2) / MG
        assert np.abs(found - ACCEL_BIAS_MG).max() < 0.3
    assert "INS_GYROFFS_X = 0.3 was announced but is not active" in caplog.text


@pytest.mark.parametrize(
    ("every_s", "what", "words"),
    [
        (0.05, (announced,), "pretend to be the autopilot"),
        (5.0, (restarted,), "the autopilot rebooted, 5 times now"),
        (0.5, (beat(armed=True), beat(armed=False)), "armed; nothing"),
    ],
)
async def test_nothing_that_is_forged_again_and_again_holds_a_calibration_up_for_ever(
    tmp_path: Path, every_s: float, what: tuple[Callable[[], Message], ...], words: str
) -> None:
    async with Rig(tmp_path, **QUICK).running() as rig:
        await rig.ready()
        async with spoofed(rig, every_s, *what):
            job = calibrate(rig)
            async with asyncio.timeout(60.0):
                result = await job.finished
        assert result.outcome == "failed"
        assert words in result.reason
        await asyncio.sleep(2.0)
        assert any("Calibration failed" in text for text in rig.ground.texts())


async def test_an_arming_between_two_looks_ends_the_measurement(tmp_path: Path) -> None:
    async with Rig(tmp_path, **QUICK).running() as rig:
        await rig.ready()
        job = calibrate(rig)
        await asyncio.sleep(3.05)
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for armed in (True, False):
            rig.link.receive(beat(armed=armed)().pack(codec), rig.now_s)
        async with asyncio.timeout(5.0):
            result = await job.finished
        assert result.reason == "armed; nothing written"
