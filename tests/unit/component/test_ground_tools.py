"""Progress and readiness as numbers for ground stations."""

from __future__ import annotations

import asyncio

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmAnswer
from tests.support.component import Ground, bench


def shown(ground: Ground) -> list[tuple[str, float]]:
    return [
        (message.name, message.value)
        for _, message in ground.received
        if isinstance(message, mavlink.MAVLink_named_value_float_message)
    ]


async def test_progress_and_readiness_come_as_numbers() -> None:
    async with bench() as stage:
        await asyncio.sleep(10.5)
        assert shown(stage.ground) == [("CMP_PROG", 100.0), ("CMP_READY", 1.0)] * 2, "seldom while nothing runs"
        stage.ground.received.clear()
        stage.service.mav_state = int(mavlink.MAV_STATE_CALIBRATING)
        stage.service.progress_percent = 42
        stage.gate.says = ArmAnswer("wait", "hold still 6 s")
        await asyncio.sleep(3.0)
        assert shown(stage.ground) == [("CMP_PROG", 42.0), ("CMP_READY", 0.0)] * 3
