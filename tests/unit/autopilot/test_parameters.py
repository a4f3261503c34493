from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import float32, same_float32
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import (
    AutopilotRebootedError,
    NotDisarmedError,
    ParameterMismatchError,
    ParameterRefusedError,
    ParameterTimeoutError,
)
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, f32, flying_on
from tests.support.wire import Wire

X, Y, Z = ("INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z")


@contextlib.asynccontextmanager
async def aboard(autopilot: ScriptedAutopilot) -> AsyncIterator[tuple[ParameterClient, Vehicle, Wire]]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    async with flying_on(link, autopilot) as wire:
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        yield client, vehicle, wire
    vehicle.close()


def offsets(**more: float) -> dict[str, float]:
    return {X: 0.001, Y: -0.002, Z: 0.003, **more}


async def test_reads_by_name_afresh_every_time() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, _):
        assert await client.read(X) == f32(0.001)
        autopilot.parameters[X] = f32(0.5)
        assert await client.read(X) == 0.5
        asked = [m for m in autopilot.requests if m.get_type() == "PARAM_REQUEST_READ"]
        assert [(m.param_id, m.param_index) for m in asked] == [(X, -1), (X, -1)]


async def test_a_lost_answer_is_asked_for_again() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, wire):
        wire.cut = True
        asyncio.get_running_loop().call_later(1.5, setattr, wire, "cut", False)
        assert await client.read(X) == f32(0.001)


async def test_silence_to_a_read_ends_in_a_timeout_after_all_tries() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    autopilot.on_message = lambda message: message.get_type() != "PARAM_REQUEST_READ"
    async with aboard(autopilot) as (client, _, _):
        start_s = asyncio.get_running_loop().time()
        with pytest.raises(ParameterTimeoutError, match="INS_GYROFFS_X"):
            await client.read(X)
        assert asyncio.get_running_loop().time() - start_s == pytest.approx(8.0, abs=0.01)
        assert sum(m.get_type() == "PARAM_REQUEST_READ" for m in autopilot.requests) == 8


async def test_an_autopilot_whose_heartbeats_stop_too_is_given_up_sooner() -> None:
    async with aboard(ScriptedAutopilot(parameters=offsets())) as (client, _, wire):
        wire.cut = True
        start_s = asyncio.get_running_loop().time()
        with pytest.raises(ParameterTimeoutError, match=r"no heartbeat for \d s: power\? cable\?"):
            await client.read(X)
        assert asyncio.get_running_loop().time() - start_s == pytest.approx(4.0, abs=0.01)


@pytest.mark.parametrize("optional", [False, True])
async def test_with_a_fifth_of_all_packets_lost_every_value_still_comes(*, optional: bool) -> None:
    """With four tries some 17 of a thousand exchanges would fail, or names count as absent."""
    # Old firmware: it is silent on what it does not have, so silence means something.
    autopilot = ScriptedAutopilot(parameters=offsets(), param_errors=False)
    async with aboard(autopilot) as (client, _, wire):
        wire.loss = 0.2
        read = client.read_optional if optional else client.read
        for _ in range(500):
            assert await read(X) == f32(0.001)


async def test_optional_missing_by_param_error_is_quick() -> None:
    async with aboard(ScriptedAutopilot(parameters=offsets())) as (client, _, _):
        start_s = asyncio.get_running_loop().time()
        assert await client.read_optional("INS_ACC1OFFS_X") is None
        assert asyncio.get_running_loop().time() - start_s < 0.1
        with pytest.raises(ParameterRefusedError, match="does not exist"):
            await client.read("INS_ACC1OFFS_X")


async def test_a_name_that_is_absent_is_asked_for_once_a_boot() -> None:
    """On 4.8 as well as on old firmware: its PARAM_ERROR to a read may leave by another of its links."""
    autopilot = ScriptedAutopilot(parameters={X: 0.5}, param_errors=False)
    async with aboard(autopilot) as (client, vehicle, _):
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        assert await client.read_many([X, "INS4_GYROFFS_X", "INS5_GYROFFS_X"], optional=True) == {X: 0.5}
        first_s, begun_s = loop.time() - begun_s, loop.time()
        assert 3.0 < first_s < 8.0  # all at once, not one after the other
        assert await client.read_optional("INS4_GYROFFS_X") is None
        assert loop.time() == begun_s
        # A boot may bring another firmware, and an announcement tells that it is there after all.
        autopilot.parameters["INS4_GYROFFS_X"] = 0.25
        await autopilot.reboot()
        await vehicle.hear_boot_time()
        assert await client.read_optional("INS4_GYROFFS_X") == 0.25


@pytest.mark.parametrize("read_before", [False, True])
async def test_optional_missing_by_silence_of_old_firmware(read_before: bool) -> None:
    autopilot = ScriptedAutopilot(parameters=offsets(), param_errors=False)
    async with aboard(autopilot) as (client, _, _):
        if read_before:
            await client.read(Y)
        assert await client.read_optional("INS_ACC1OFFS_X") is None


@pytest.mark.parametrize("read_before", [False, True])
async def test_a_silence_that_ends_in_the_moment_of_the_decision_is_no_absence(read_before: bool) -> None:
    """Silent to everything while it is asked for X, and there again for the question whether it answers at all."""
    autopilot = ScriptedAutopilot(parameters=offsets(), param_errors=False)
    async with aboard(autopilot) as (client, _, _):
        if read_before:
            await client.read(X)
        await client.read(Y)

        def on_message(message: Any) -> bool:
            asked = getattr(message, "param_id", "")
            if asked == Y:
                autopilot.on_message = lambda message: True
            return asked != X

        autopilot.on_message = on_message
        assert await client.read_optional(X) == pytest.approx(offsets()[X])
        assert await client.read_optional(X) == pytest.approx(offsets()[X])


async def test_what_was_there_a_moment_ago_is_not_called_absent_for_a_silence() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets(), param_errors=False)
    async with aboard(autopilot) as (client, _, _):
        await client.read(X)
        await client.read(Y)
        autopilot.on_message = lambda message: getattr(message, "param_id", "") != X
        with pytest.raises(ParameterTimeoutError, match="any more"):
            await client.read_optional(X)
        autopilot.on_message = lambda message: True
        assert await client.read_optional(X) is not None


async def test_what_signs_and_is_silent_is_said_to_sign() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    autopilot._codec.signing.secret_key = b"k" * 32
    autopilot._codec.signing.sign_outgoing = True
    async with aboard(autopilot) as (client, vehicle, _):
        assert vehicle.signs
        autopilot.on_message = lambda message: False
        with pytest.raises(ParameterTimeoutError, match="the autopilot signs its messages"):
            await client.read(X)


async def test_optional_on_a_dead_link_is_a_timeout() -> None:
    async with aboard(ScriptedAutopilot(parameters=offsets())) as (client, _, wire):
        wire.cut = True
        with pytest.raises(ParameterTimeoutError):
            await client.read_optional(X)


async def test_optional_when_heartbeats_come_but_our_requests_do_not_arrive_is_a_timeout() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets(), param_errors=False)
    async with aboard(autopilot) as (client, vehicle, _):
        autopilot.on_message = lambda message: False
        with pytest.raises(ParameterTimeoutError, match="and other parameters"):
            await client.read_optional(X)
        assert vehicle.alive


async def test_before_any_autopilot_is_heard_there_is_a_clean_error() -> None:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    with pytest.raises(ParameterTimeoutError, match="no heartbeat from the autopilot"):
        await client.read(X)
    with pytest.raises(NotDisarmedError, match="unknown"):
        await client.write(X, 0.0)


async def test_writes_real32_and_takes_the_echo() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, _):
        assert await client.write(X, 0.1) == f32(0.1)
        assert autopilot.parameters[X] == f32(0.1)
        (sent,) = [m for m in autopilot.requests if m.get_type() == "PARAM_SET"]
        assert sent.param_type == mavlink.MAV_PARAM_TYPE_REAL32
        assert client.writes == 1


async def test_one_ulp_off_is_accepted_two_are_not() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    bits = struct.unpack("<i", struct.pack("<f", 0.1))[0]
    near, far = (struct.unpack("<f", struct.pack("<i", bits + n))[0] for n in (1, 2))
    async with aboard(autopilot) as (client, _, _):
        autopilot.on_set = lambda name, value: near
        assert await client.write(X, 0.1) == near
        autopilot.on_set = lambda name, value: far
        with pytest.raises(ParameterMismatchError):
            await client.write(X, 0.1)


async def test_another_value_is_waited_over_since_it_may_answer_somebody_else() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())

    def late(name: str, value: float) -> None:
        autopilot.value(name)
        asyncio.get_running_loop().call_later(0.5, take, name, value)

    def take(name: str, value: float) -> None:
        autopilot.parameters[name] = f32(value)
        autopilot.value(name)

    autopilot.on_set = late
    async with aboard(autopilot) as (client, _, _):
        assert await client.write(X, 0.2) == f32(0.2)
        assert client.writes == 1


async def test_another_value_for_good_is_a_mismatch_that_names_both() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    autopilot.on_set = lambda name, value: 0.25
    async with aboard(autopilot) as (client, _, _):
        with pytest.raises(ParameterMismatchError, match=r"INS_GYROFFS_X reads 0\.25, expected 0\.5"):
            await client.write(X, 0.5)


async def test_param_error_ends_a_write_at_once() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, _):
        with pytest.raises(ParameterRefusedError, match="does not exist"):
            await client.write("INS_ACC1OFFS_X", 0.5)
        assert client.writes == 1


async def test_param_error_for_somebody_else_is_not_ours() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())

    def refuse_another(message: object) -> bool:
        autopilot.send(mavlink.MAVLink_param_error_message(255, 190, X.encode(), -1, 3))
        return True

    async with aboard(autopilot) as (client, _, _):
        autopilot.on_message = refuse_another
        assert await client.read(X) == f32(0.001)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e39])
async def test_what_is_no_finite_float32_never_leaves(value: float) -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, _):
        with pytest.raises(ParameterRefusedError):
            await client.write(X, value)
        assert client.writes == 0


async def test_a_restart_in_the_middle_is_named() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    async with aboard(autopilot) as (client, _, _):
        autopilot.on_set = lambda name, value: None
        writing = asyncio.create_task(client.write(X, 0.5))
        await asyncio.sleep(0.1)
        await autopilot.reboot(0.3)
        with pytest.raises(AutopilotRebootedError, match="restarted while INS_GYROFFS_X"):
            await writing


async def test_watch_hears_what_anybody_writes_and_others_do_not_count() -> None:
    autopilot = ScriptedAutopilot(parameters=offsets())
    stranger = ScriptedAutopilot(system=9, parameters={X: 7.0})
    heard: list[tuple[str, float]] = []
    async with aboard(autopilot) as (client, vehicle, _):
        stop = client.on_value.add(lambda name, value: heard.append((name, value)))
        stranger.attach(lambda data: client._link.receive(data, asyncio.get_running_loop().time()))
        stranger.value(X)
        autopilot.value(Z)
        await asyncio.sleep(0.1)
        assert heard == [(Z, f32(0.003))]
        reading = asyncio.create_task(client.read(X))
        await asyncio.sleep(0)
        stranger.value(X)
        assert await reading == f32(0.001)
        stop()
        autopilot.value(Z)
        await asyncio.sleep(0.1)
        assert len(heard) == 2
        assert vehicle.system_id == 1


def test_float32_comparison() -> None:
    assert float32(0.1) != 0.1
    assert same_float32(0.1, float32(0.1))
    assert same_float32(0.0, -0.0)
    smallest = 2.0**-149
    assert same_float32(-0.0, smallest)
    assert not same_float32(-smallest, smallest)
    assert not same_float32(math.nan, math.nan)
    assert not same_float32(1.0, 1.0 + 2.5 * 2**-23)
    assert math.isinf(float32(-1e39))
