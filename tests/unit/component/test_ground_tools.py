"""What ground stations do beside commands and parameters: ask for files, and show numbers."""

from __future__ import annotations

import asyncio
import struct

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmAnswer
from tests.support.component import Ground, bench

OPEN_TO_READ, LIST, NAK = 4, 3, 129
"""MAVFTP's opcodes (MAVLink developer guide)."""


def asked(opcode: int, sequence: int, *, target: tuple[int, int] = (1, 191)) -> mavlink.MAVLink_message:
    name = b"@PARAM/param.pck"
    payload = struct.pack("<HBBBBBBI", sequence, 5, opcode, len(name), 0, 0, 0, 0) + name
    return mavlink.MAVLink_file_transfer_protocol_message(0, *target, list(payload.ljust(251, b"\0")))


def answers(ground: Ground) -> list[tuple[int, int, tuple[int, ...]]]:
    """To whom, and sequence, session, opcode, size, opcode answered to, error."""
    found = []
    for _, message in ground.received:
        if isinstance(message, mavlink.MAVLink_file_transfer_protocol_message):
            header = struct.unpack_from("<HBBBBBBIB", bytes(message.payload))
            found.append((message.target_system, message.target_component, (*header[:5], header[8])))
    return found


async def test_whoever_asks_for_files_is_told_at_once_that_there_are_none() -> None:
    async with bench() as stage:
        await asyncio.sleep(0.5)
        stage.ground.send(asked(OPEN_TO_READ, 7))
        stage.ground.send(asked(LIST, 0xFFFF))
        stage.ground.send(asked(OPEN_TO_READ, 9, target=(1, 1)))
        stage.ground.send(asked(OPEN_TO_READ, 9, target=(0, 0)))
        stage.ground.send(asked(NAK, 9))  # an answer is not answered
        await asyncio.sleep(0.2)
        not_found, unknown = 10, 7
        assert answers(stage.ground) == [
            (255, 190, (8, 5, NAK, 1, OPEN_TO_READ, not_found)),
            (255, 190, (0, 5, NAK, 1, LIST, unknown)),
        ]


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
