from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator

import pytest

from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import AutopilotError
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, f32, flying_on
from tests.support.wire import Wire

X, Y, Z = ("INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z")
BEFORE = {X: 0.001, Y: -0.002, Z: 0.003}
AFTER = {X: 0.011, Y: -0.012, Z: 0.013}
CHANGES = [Change(name, BEFORE[name], AFTER[name]) for name in (X, Y, Z)]


def rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: f32(value) for name, value in values.items()}


@contextlib.asynccontextmanager
async def aboard(autopilot: ScriptedAutopilot) -> AsyncIterator[tuple[ParameterWriter, Vehicle, Wire]]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    async with flying_on(link, autopilot) as wire:
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        yield ParameterWriter(client, vehicle), vehicle, wire
    vehicle.close()


def on_nth_set(autopilot: ScriptedAutopilot, number: int, what: object) -> None:
    """Do something when the n-th PARAM_SET arrives; the value is taken unless `what` returns something else."""
    count = 0

    def hook(name: str, value: float) -> float | None:
        nonlocal count
        count += 1
        if count == number:
            return what(name, value)  # type: ignore[operator,no-any-return]
        return value

    autopilot.on_set = hook


async def test_all_written_read_back_and_stored() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    async with aboard(autopilot) as (writer, _, _):
        written = await writer.apply(CHANGES)
        assert autopilot.parameters == rounded(AFTER)
        assert [name for name, _, _ in autopilot.sets] == [X, Y, Z]
        for name in (X, Y, Z):
            assert written[name].outcome == "stored"
            assert written[name].read_back == f32(AFTER[name])
            assert written[name].before == f32(BEFORE[name])


async def test_a_value_that_is_already_there_is_not_written_again() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    async with aboard(autopilot) as (writer, _, _):
        written = await writer.apply([Change(X, 0.001, 0.001), Change(Y, -0.002, -0.5)])
        assert [name for name, _, _ in autopilot.sets] == [Y]
        assert written[X].outcome == "stored"


async def test_a_value_changed_by_someone_else_refuses_the_set_and_names_both() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE | {Y: 0.75})
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError, match=r"INS_GYROFFS_Y reads 0\.75, expected -0\.00200000009") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "changed by someone else"
        assert caught.value.left_changed == ()
        assert autopilot.sets == []


async def test_a_refusal_in_the_middle_puts_the_written_ones_back_in_reverse_order() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    def refuse(name: str, value: float) -> None:
        autopilot._refuse(autopilot.requests[-1], 3)

    on_nth_set(autopilot, 3, refuse)
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError, match="old values restored") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "refused"
        assert autopilot.parameters == rounded(BEFORE)
        assert [name for name, _, _ in autopilot.sets] == [X, Y, Z, Z, Y, X]
        assert {w.outcome for w in caught.value.written.values()} == {"rolled_back"}
        assert caught.value.left_changed == ()


async def test_silence_to_one_write_is_no_answer_and_what_it_did_is_found_out() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    def take_silently(name: str, value: float) -> float | None:
        if name == Y and value != f32(BEFORE[Y]):
            autopilot.parameters[Y] = f32(value)
            return None
        return value

    autopilot.on_set = take_silently
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError) as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "no answer"
        assert autopilot.parameters == rounded(BEFORE)
        outcomes = {name: w.outcome for name, w in caught.value.written.items()}
        assert outcomes == {X: "rolled_back", Y: "rolled_back", Z: "failed"}


async def test_another_value_is_named_and_rolled_back() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    autopilot.on_set = lambda name, value: 0.01 if name == Z and value > 0.01 else value
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError, match="INS_GYROFFS_Z") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "answered another value"
        assert autopilot.parameters == rounded(BEFORE)


async def test_a_value_that_another_station_sets_in_the_middle_is_left_to_it_and_only_ours_is_put_back() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    def meddle(name: str, value: float) -> float:
        asyncio.get_running_loop().call_later(0.05, autopilot.parameters.__setitem__, X, 0.5)
        return value

    on_nth_set(autopilot, 3, meddle)
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError, match=r"INS_GYROFFS_X reads 0\.5, expected 0\.0109999999") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "changed by someone else"
        assert caught.value.left_changed == (X,)
        assert autopilot.parameters == {**rounded(BEFORE), X: 0.5}


async def test_arming_in_the_middle_stops_at_once_and_says_what_is_left() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    def arm(name: str, value: float) -> float:
        autopilot.armed = True
        autopilot.beat()
        return value

    on_nth_set(autopilot, 2, arm)
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError, match="old values NOT restored in INS_GYROFFS_X, INS_GYROFFS_Y") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "armed in the middle"
        assert caught.value.left_changed == (X, Y)
        assert [armed for _, _, armed in autopilot.sets] == [False, False]
        written = caught.value.written
        assert [written[n].outcome for n in (X, Y, Z)] == ["failed", "failed", "failed"]
        assert [written[n].read_back for n in (X, Y, Z)] == [f32(AFTER[X]), f32(AFTER[Y]), None]


async def test_arming_after_the_last_write_is_found_at_the_end() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    def arm(name: str, value: float) -> float:
        autopilot.armed = True
        return value

    on_nth_set(autopilot, 3, arm)
    async with aboard(autopilot) as (writer, _, _):
        with pytest.raises(WriteFailedError) as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "armed in the middle"
        assert caught.value.left_changed == (X, Y, Z)
        assert autopilot.parameters == rounded(AFTER)


async def test_a_restart_in_the_middle_is_named_and_what_persisted_is_put_back() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    tasks: list[asyncio.Task[None]] = []

    def restart(name: str, value: float) -> None:
        tasks.append(asyncio.ensure_future(autopilot.reboot(4.0)))

    on_nth_set(autopilot, 2, restart)
    async with aboard(autopilot) as (writer, vehicle, _):
        await asyncio.sleep(2.0)
        with pytest.raises(WriteFailedError) as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "rebooted in the middle"
        assert vehicle.boots == 1
        assert autopilot.parameters == rounded(BEFORE)
        assert caught.value.left_changed == ()
        assert tasks


async def test_a_restart_so_short_that_no_answer_is_missed_is_found_before_the_write_counts_as_stored() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    tasks: list[asyncio.Task[None]] = []

    def restart(name: str, value: float) -> float:
        tasks.append(asyncio.ensure_future(autopilot.reboot(0.1)))
        return value

    on_nth_set(autopilot, 3, restart)
    async with aboard(autopilot) as (writer, vehicle, _):
        with pytest.raises(WriteFailedError, match="restarted while its parameters were read back") as caught:
            await writer.apply(CHANGES)
        assert caught.value.kind == "rebooted in the middle"
        assert vehicle.boots == 1
        assert autopilot.parameters == rounded(BEFORE)


async def test_what_the_autopilot_calibrated_itself_at_a_restart_is_left_and_named() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    tasks: list[asyncio.Task[None]] = []

    def restart(name: str, value: float) -> None:
        autopilot.parameters[X] = f32(0.0444)
        tasks.append(asyncio.ensure_future(autopilot.reboot(4.0)))

    on_nth_set(autopilot, 2, restart)
    async with aboard(autopilot) as (writer, _, _):
        await asyncio.sleep(2.0)
        with pytest.raises(WriteFailedError, match=r"rebooted in the middle.*old values NOT restored in INS_GYROFFS_X"):
            await writer.apply(CHANGES)
        assert writer.left_changed == (X,)
        assert writer.written[X].read_back == f32(0.0444)
        assert autopilot.parameters[X] == f32(0.0444)


async def test_a_link_that_dies_in_the_middle_leaves_names_and_ends() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    async with aboard(autopilot) as (writer, _, wire):

        def cut(name: str, value: float) -> float:
            wire.cut = True
            return value

        on_nth_set(autopilot, 2, cut)
        start_s = asyncio.get_running_loop().time()
        with pytest.raises(WriteFailedError) as caught:
            await writer.apply(CHANGES)
        assert asyncio.get_running_loop().time() - start_s < 90
        assert caught.value.kind == "arm state unknown"
        assert caught.value.left_changed == (X, Y)
        assert caught.value.written[X].read_back is None


async def test_restore_puts_back_and_leaves_what_is_somebody_elses() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    async with aboard(autopilot) as (writer, _, _):
        await writer.apply(CHANGES)
        back = await writer.restore(CHANGES)
        assert autopilot.parameters == rounded(BEFORE)
        assert {w.outcome for w in back.values()} == {"rolled_back"}
        await writer.apply(CHANGES)
        autopilot.parameters[Y] = 0.5
        with pytest.raises(WriteFailedError, match=r"INS_GYROFFS_Y is 0\.5") as caught:
            await writer.restore(CHANGES)
        assert caught.value.kind == "changed by someone else"
        assert caught.value.left_changed == (Y,)
        assert autopilot.parameters == rounded(BEFORE) | {Y: 0.5}


async def test_undo_is_all_or_nothing() -> None:
    autopilot = ScriptedAutopilot(parameters=BEFORE)
    async with aboard(autopilot) as (writer, _, _):
        await writer.apply(CHANGES)
        undone = await writer.undo(CHANGES)
        assert autopilot.parameters == rounded(BEFORE)
        assert undone[X].outcome == "rolled_back"
        assert (undone[X].before, undone[X].after, undone[X].read_back) == (
            f32(BEFORE[X]),
            f32(AFTER[X]),
            f32(BEFORE[X]),
        )
        await writer.apply(CHANGES)
        autopilot.parameters[Y] = 0.5
        with pytest.raises(WriteFailedError, match="INS_GYROFFS_Y"):
            await writer.undo(CHANGES)
        assert autopilot.parameters == rounded(AFTER) | {Y: 0.5}


async def test_an_autopilot_that_fails_while_a_far_value_is_checked_has_its_old_values_again() -> None:
    """A far value that stays would crash the aircraft."""
    autopilot = ScriptedAutopilot(parameters=BEFORE)

    async def check() -> str | None:
        raise AutopilotError("no answer")

    async with aboard(autopilot) as (writer, _, _):
        far = [dataclasses.replace(CHANGES[2], via=0.1)]
        with pytest.raises(WriteFailedError, match="no answer"):
            await writer.apply([*CHANGES[:2], *far], lambda _: check)
        assert autopilot.parameters == rounded(BEFORE)
