"""Our own parameters, as a ground station sees them."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.own_parameters import Parameter
from companion.errors import CalibrationRefusedError
from tests.support.component import Ground, bench

taken: list[float] = []


def served() -> list[Parameter]:
    taken.clear()
    return [
        Parameter("CMP_TGT_GYRO", 5.0, 0.1, 100.0, taken.append),
        Parameter("CMP_AT_ARM", 1, 0, 2, taken.append),
        Parameter("CMP_RESULT", 0.0, -1e6, 1e6),
        Parameter("CMP_SIXTEEN_LONG", 0.1, 0.1, 0.1, taken.append),
    ]


NAMES = ["CMP_TGT_GYRO", "CMP_AT_ARM", "CMP_RESULT", "CMP_SIXTEEN_LONG"]


def values(ground: Ground) -> list[tuple[str, float, int, int, int]]:
    return [
        (m.param_id, m.param_value, m.param_type, m.param_count, m.param_index)
        for _, m in ground.received
        if isinstance(m, mavlink.MAVLink_param_value_message)
    ]


def errors(ground: Ground) -> list[tuple[int, int, str, int, int]]:
    return [
        (m.target_system, m.target_component, m.param_id, m.param_index, m.error)
        for _, m in ground.received
        if isinstance(m, mavlink.MAVLink_param_error_message)
    ]


def set_message(
    name: str, value: float, *, target: tuple[int, int] = (1, 191), kind: int = 9
) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_param_set_message(*target, name.encode(), value, kind)


def read_message(name: str, index: int = -1, *, target: tuple[int, int] = (1, 191)) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_param_request_read_message(*target, name.encode(), index)


def float32(value: float) -> float:
    found: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return found


@pytest.mark.parametrize("target", [(1, 191), (1, 0), (0, 0)])
async def test_the_list_is_complete_and_paced(target: tuple[int, int]) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(mavlink.MAVLink_param_request_list_message(*target))
        await asyncio.sleep(2)
        found = values(b.ground)
        assert [value[0] for value in found] == NAMES
        assert [value[2:] for value in found] == [(9, 4, i) for i in range(4)]
        assert [value[1] for value in found] == [5.0, 1.0, 0.0, float32(0.1)]
        times = b.ground.times("PARAM_VALUE")
        assert 0.07 < times[-1] - times[0] < 0.2


@pytest.mark.parametrize("target", [(1, 1), (2, 191), (1, 190), (2, 0)])
async def test_what_is_addressed_to_others_is_ignored(target: tuple[int, int]) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(mavlink.MAVLink_param_request_list_message(*target))
        b.ground.send(read_message("CMP_AT_ARM", target=target))
        b.ground.send(read_message("", 0, target=target))
        b.ground.send(set_message("CMP_AT_ARM", 2, target=target))
        await asyncio.sleep(2)
        assert (values(b.ground), errors(b.ground), taken) == ([], [], [])


@pytest.mark.parametrize("target", [(1, 191), (1, 0)])
@pytest.mark.parametrize(("name", "index"), [("CMP_AT_ARM", -1), ("", 1), ("CMP_RESULT", 1)])
async def test_one_is_read_by_name_or_by_index(name: str, index: int, target: tuple[int, int]) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(read_message(name, index, target=target))
        await asyncio.sleep(1)
        assert values(b.ground) == [("CMP_AT_ARM", 1.0, 9, 4, 1)]


async def test_a_name_of_full_length_survives_the_wire() -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(read_message("CMP_SIXTEEN_LONG"))
        await asyncio.sleep(1)
        assert values(b.ground)[0][0] == "CMP_SIXTEEN_LONG"


@pytest.mark.parametrize(
    "message",
    [
        read_message("CMP_NONE"),
        read_message("INS_GYROFFS_X"),
        read_message("", 4),
        read_message("", 32767),
        set_message("CMP_NONE", 1),
        set_message("INS_GYROFFS_X", 1),
        set_message("INS_GYROFFS_X", math.nan),
    ],
)
async def test_what_does_not_exist_is_said_not_to_exist(message: mavlink.MAVLink_message) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(message)
        await asyncio.sleep(1)
        (error,) = errors(b.ground)
        assert error[:2] == (255, 190)
        assert error[4] == 1  # MAV_PARAM_ERROR_DOES_NOT_EXIST
        assert values(b.ground) == []


@pytest.mark.parametrize(
    "message",
    [
        read_message("INS_GYROFFS_X", target=(1, 0)),
        read_message("", 700, target=(1, 0)),
        set_message("INS_GYROFFS_X", 1, target=(1, 0)),
    ],
)
async def test_what_everyone_is_asked_for_may_be_another_components(message: mavlink.MAVLink_message) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(message)
        await asyncio.sleep(1)
        assert (values(b.ground), errors(b.ground)) == ([], [])


async def test_set_is_answered_at_once_with_the_new_value() -> None:
    async with bench(parameters=served()) as b:
        asked_s = asyncio.get_running_loop().time()
        b.ground.send(set_message("CMP_TGT_GYRO", 7.3))
        await asyncio.sleep(1)
        assert values(b.ground) == [("CMP_TGT_GYRO", float32(7.3), 9, 4, 0)]
        assert b.ground.times("PARAM_VALUE")[0] - asked_s < 0.01
        assert taken == [float32(7.3)]
        assert b.component.parameters.get("CMP_TGT_GYRO") == float32(7.3)
        b.ground.send(set_message("CMP_TGT_GYRO", 7.3))
        await asyncio.sleep(1)
        assert len(values(b.ground)) == 2
        assert len(taken) == 1, "the same value again is no change"


@pytest.mark.parametrize(
    ("name", "value", "kind", "unchanged"),
    [
        ("CMP_AT_ARM", 3, 9, 1.0),
        ("CMP_AT_ARM", -0.001, 9, 1.0),
        ("CMP_AT_ARM", math.nan, 9, 1.0),
        ("CMP_AT_ARM", math.inf, 9, 1.0),
        ("CMP_AT_ARM", -math.inf, 9, 1.0),
        ("CMP_TGT_GYRO", 100.001, 9, 5.0),
        ("CMP_RESULT", 1.0, 9, 0.0),
        ("CMP_AT_ARM", 2.0, 6, 1.0),
        ("CMP_AT_ARM", struct.unpack("<f", struct.pack("<i", 2))[0], 6, 1.0),
    ],
)
async def test_a_value_that_is_not_allowed_is_answered_with_the_old_one(
    name: str, value: float, kind: int, unchanged: float
) -> None:
    async with bench(parameters=served()) as b:
        b.ground.send(set_message(name, value, kind=kind))
        await asyncio.sleep(1)
        assert [found[:2] for found in values(b.ground)] == [(name, unchanged)]
        assert taken == []
        (text,) = "".join(b.ground.texts()).split("\n")
        assert text.startswith(f"{name} not set: ")


@pytest.mark.parametrize("limit", ["minimum", "maximum"])
async def test_limits_are_allowed_values_in_float32(limit: str) -> None:
    """0.1 is not a float32: a limit must not refuse its own nearest float32."""
    async with bench(parameters=[Parameter("CMP_X", 0.5, 0.1, 0.7, taken.append)]) as b:
        value = 0.1 if limit == "minimum" else 0.7
        b.ground.send(set_message("CMP_X", value))
        await asyncio.sleep(1)
        assert values(b.ground)[0][1] == float32(value)


def refuse(_value: float) -> None:
    raise CalibrationRefusedError("not while calibrating")


def breaks(_value: float) -> None:
    raise ZeroDivisionError


@pytest.mark.parametrize(("on_set", "reason"), [(refuse, "not while calibrating"), (breaks, "an internal error")])
async def test_who_takes_the_value_may_refuse_it(on_set: Callable[[float], None], reason: str) -> None:
    async with bench(parameters=[Parameter("CMP_X", 1, 0, 2, on_set)]) as b:
        b.ground.send(set_message("CMP_X", 2))
        await asyncio.sleep(1)
        assert values(b.ground) == [("CMP_X", 1.0, 9, 1, 0)]
        assert reason in b.ground.texts()[0]


async def test_a_change_from_inside_is_told_once() -> None:
    async with bench(parameters=served()) as b:
        b.component.parameters.set("CMP_RESULT", 12.5)
        b.component.parameters.set("CMP_RESULT", 13.5)
        b.component.parameters.set("CMP_RESULT", 13.5)
        await asyncio.sleep(1)
        assert values(b.ground) == [("CMP_RESULT", 13.5, 9, 4, 2)]
        b.component.parameters.set("CMP_RESULT", 13.5)
        await asyncio.sleep(1)
        assert len(values(b.ground)) == 1
        for value in (math.nan, math.inf, 2e6, 1e300):
            with pytest.raises(ValueError, match="CMP_RESULT"):
                b.component.parameters.set("CMP_RESULT", value)


async def test_a_flood_of_list_requests_costs_neither_memory_nor_bandwidth() -> None:
    async with bench(parameters=[Parameter(f"CMP_P{i}", i, 0, 100) for i in range(30)]) as b:
        request = mavlink.MAVLink_param_request_list_message(1, 191)
        for _ in range(2000):
            b.ground.send(request)
            b.ground.send(read_message("", 7))
            await asyncio.sleep(0.002)
            assert len(b.component.parameters._pending) <= 30
        await asyncio.sleep(2)
        found = values(b.ground)
        assert {value[0] for value in found} == {f"CMP_P{i}" for i in range(30)}
        assert len(found) <= (2000 * 0.002 + 2) * 40 + 1
