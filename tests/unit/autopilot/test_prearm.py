"""Texts against arming that arrive in chunks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.prearm import PrearmWatch
from companion.autopilot.vehicle.vehicle import ArmState


@pytest.mark.parametrize("chunks", [2, 1000])
def test_chunks_are_joined_and_a_text_without_an_end_is_cut(chunks: int) -> None:
    heard: dict[Any, Any] = {}
    vehicle: Any = SimpleNamespace(
        hear=heard.__setitem__,
        arm_state=ArmState.DISARMED,
        kind=SimpleNamespace(checks_in_health_alone=False),
        commands=SimpleNamespace(request_message=lambda _id: None),
    )
    watch = PrearmWatch(vehicle)
    text = "PreArm: " + "x" * (50 * chunks - 20)
    for number in range(chunks):
        part = text[50 * number : 50 * number + 50].encode()
        message = mavlink.MAVLink_statustext_message(
            mavlink.MAV_SEVERITY_CRITICAL, part, id=7, chunk_seq=min(number, 255)
        )
        heard[mavlink.MAVLink_statustext_message](message, 10.0)
    (reason,) = watch.step(10.1)
    assert text.startswith(reason.text)
    assert len(reason.text) == min(len(text), 400)
