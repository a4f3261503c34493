"""The working loop: the heartbeat, the identity, and what happens when the link is not there or the loop stalls."""

from __future__ import annotations

import asyncio
import struct
from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.commands import encode_version
from companion.component.component import MavlinkComponent
from companion.component.statustext import Severity, StatusText, Tunes
from companion.config.sections import EVERYBODY, Senders
from companion.links.mavlink.link import MavlinkLink
from tests.support.component import CALIBRATE, Ground, ScriptedGate, ScriptedService, bench
from tests.support.wire import Wire


def x25(data: bytes) -> int:
    """CRC-16/MCRF4XX, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def frame(sequence: int, message_id: int, payload: bytes, crc_extra: int) -> bytes:
    """A MAVLink 2 frame from 1/191, trailing zeros of the payload cut, built by hand."""
    payload = payload.rstrip(b"\0") or b"\0"
    body = struct.pack("<BBBBBB", len(payload), 0, 0, sequence, 1, 191) + message_id.to_bytes(3, "little") + payload
    return b"\xfd" + body + struct.pack("<H", x25(body + bytes([crc_extra])))


async def test_the_bytes_on_the_wire() -> None:
    async with bench() as b:
        await asyncio.sleep(0.5)
        b.service.takes_s = 0
        b.ground.command(CALIBRATE, 1)
        await asyncio.sleep(0.4)
        # HEARTBEAT: custom_mode u32, type 18, autopilot 8, base_mode 0, system_status ACTIVE 4, version 3
        assert b.ground.raw[0] == frame(0, 0, struct.pack("<IBBBBB", 0, 18, 8, 0, 4, 3), 50)
        # COMMAND_ACK: command u16, result, progress, result_param2 i32, target 255/190
        assert b.ground.raw[1] == frame(1, 77, struct.pack("<HBBiBB", 31010, 5, 0, 0, 255, 190), 143)
        assert b.ground.raw[2] == frame(2, 77, struct.pack("<HBBiBB", 31010, 0, 0, 0, 255, 190), 143)
        b.texts.say(Severity.NOTICE, "done")
        await asyncio.sleep(0.05)
        assert b.ground.raw[3] == frame(3, 253, struct.pack("<B50sHB", 5, b"done", 0, 0), 83)


async def test_the_heart_beats_at_once_and_every_second() -> None:
    async with bench() as b:
        started_s = asyncio.get_running_loop().time()
        await asyncio.sleep(60.5)
        times = b.ground.times("HEARTBEAT")
        assert times[0] - started_s < 0.01
        assert len(times) == 61
        assert all(abs(later - earlier - 1.0) < 0.01 for earlier, later in pairwise(times))


async def test_the_heart_keeps_its_rhythm_under_work() -> None:
    async with bench() as b:
        for i in range(1000):
            b.ground.command(CALIBRATE, i % 5)
            await asyncio.sleep(0.03)
        times = b.ground.times("HEARTBEAT")
        assert len(times) == 30
        assert all(abs(later - earlier - 1.0) < 0.01 for earlier, later in pairwise(times))


async def test_the_state_is_the_services() -> None:
    async with bench() as b:
        for state in (2, 3, 4, 5):
            b.service.mav_state = state
            await asyncio.sleep(1)
        states = [m.system_status for _, m in b.ground.received if isinstance(m, mavlink.MAVLink_heartbeat_message)]
        assert states == [2, 3, 4, 5]


async def test_no_working_loop_no_heartbeat() -> None:
    async with bench() as b:
        await asyncio.sleep(2.5)
        b.task.cancel()
        await asyncio.sleep(10)
        assert len(b.ground.times("HEARTBEAT")) == 3


async def test_a_stall_is_not_made_up_for() -> None:
    async with bench() as b:
        await asyncio.sleep(0.5)
        b.component._next_heartbeat_s -= 20  # as after a suspend of the computer
        b.component._woken.set()
        await asyncio.sleep(0.5)
        assert len(b.ground.times("HEARTBEAT")) == 2


async def test_we_are_heard_under_the_vehicles_system_id_as_soon_as_it_is_known() -> None:
    async with bench() as b:
        await asyncio.sleep(0.3)
        b.link.join((42, 1))
        autopilot = Ground(42, 1)
        b.ground.send_raw(autopilot.pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)))
        await asyncio.sleep(0.1)
        beats = [m.get_srcSystem() for _, m in b.ground.received]
        assert beats == [1, 42]
        b.ground.command(31011, target=(1, 191))
        b.ground.command(31011, target=(42, 191))
        await asyncio.sleep(0.1)
        assert b.ground.acks() == [0]
        assert b.ground.received[-1][1].get_srcSystem() in (1, 42)
        assert b.ground.ack_messages()[0].get_srcSystem() == 42


async def test_a_vehicle_found_without_a_heartbeat_to_wake_us_is_followed_within_a_second() -> None:
    async with bench() as b:
        await asyncio.sleep(0.3)
        b.link.join((7, 1))
        await asyncio.sleep(1.0)
        assert [m.get_srcSystem() for _, m in b.ground.received] == [1, 7]


async def test_the_first_heartbeat_on_a_late_link_comes_at_once() -> None:
    link, ground = MavlinkLink(), Ground()
    texts = StatusText(link)
    senders = Senders(EVERYBODY)
    tunes = Tunes(link, Vehicle(link), lambda: False, texts.woken)
    component = MavlinkComponent(link, ScriptedService(), ScriptedGate(), texts, tunes, (), senders)
    texts.say(Severity.INFO, "waited for the link")
    async with asyncio.TaskGroup() as group:
        task = group.create_task(component.run())
        await asyncio.sleep(7.37)
        assert link.dropped == 0
        wire = Wire(link, ground)
        attached_s = asyncio.get_running_loop().time()
        await asyncio.sleep(0.5)
        assert ground.times("HEARTBEAT")[0] - attached_s < 0.1
        assert ground.texts() == ["waited for the link"]
        wire.unplug()
        await asyncio.sleep(30)
        Wire(link, ground)
        attached_s = asyncio.get_running_loop().time()
        await asyncio.sleep(0.5)
        assert 0 < ground.times("HEARTBEAT")[-1] - attached_s < 0.1
        task.cancel()


async def test_silence_costs_no_wake_ups_but_the_heartbeats() -> None:
    async with bench() as b:
        steps = 0
        inner = b.component._step

        def counted(now_s: float) -> float:
            nonlocal steps
            steps += 1
            return inner(now_s)

        b.component._step = counted  # type: ignore[method-assign]
        await asyncio.sleep(3600)
        assert steps <= 3602


@pytest.mark.parametrize(
    ("version", "encoded"),
    [("0.1.0", 0x000100FF), ("2.13.4", 0x020D04FF), ("1.2.3rc1", 0x01020300), ("999.0.0", 0xFF0000FF), ("odd", 0)],
)
def test_the_version_is_encoded_a_byte_a_part(version: str, encoded: int) -> None:
    assert encode_version(version) == encoded
