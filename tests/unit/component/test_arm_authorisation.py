"""Arm authorisation against what PX4 sends and takes (autopilots 5.2 and 9.2)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Literal

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmAnswer
from tests.support.component import (
    ACCEPTED,
    DENIED,
    TEMPORARILY_REJECTED,
    ComponentBench,
    Ground,
    bench,
    command_message,
)

AUTHORISE = 3001
VEHICLE = 7


@asynccontextmanager
async def asked_by_px4(**more: object) -> AsyncIterator[ComponentBench]:
    """The component with PX4 (system 7, component 1) at the other end of the wire."""
    async with bench(system_id=VEHICLE, ground=Ground(VEHICLE, 1)) as b:
        await asyncio.sleep(0.1)
        yield b


async def ask(b: ComponentBench, target: tuple[int, int] = (VEHICLE, 0), confirmation: int = 0) -> None:
    b.ground.command(AUTHORISE, target=target, confirmation=confirmation)
    await asyncio.sleep(0.1)


def answers(b: ComponentBench) -> list[tuple[int, int, int]]:
    """One for each question; each comes twice."""
    every = [(ack.result, ack.progress, ack.result_param2) for ack in b.ground.ack_messages()]
    assert every[0::2] == every[1::2]
    return every[0::2]


async def test_an_accept_carries_its_validity_in_result_param2_and_nothing_in_progress() -> None:
    async with asked_by_px4() as b:
        await ask(b)
        assert answers(b) == [(ACCEPTED, 0, 10)]
        ack = b.ground.ack_messages()[0]
        assert ack.command == AUTHORISE
        assert (ack.target_system, ack.target_component) == (VEHICLE, 1)
        assert (ack.get_srcSystem(), ack.get_srcComponent()) == (VEHICLE, 191)
        assert b.ground.texts() == []  # PX4 says "Authorized" itself


async def test_an_answer_with_target_system_0_would_be_ignored_so_it_is_never_sent() -> None:
    async with asked_by_px4() as b:
        for verdict in ("accept", "wait", "refuse"):
            b.gate.says = ArmAnswer(verdict, "because")
            await ask(b)
        acks = [m for _, m in b.ground.received if isinstance(m, mavlink.MAVLink_command_ack_message)]
        assert [ack.target_system for ack in acks] == [VEHICLE] * 6


async def test_a_wait_is_temporarily_rejected_and_says_what_to_do() -> None:
    async with asked_by_px4() as b:
        b.gate.says = ArmAnswer("wait", "hold still 6 s")
        await ask(b)
        assert answers(b) == [(TEMPORARILY_REJECTED, 0, 0)]
        assert b.ground.texts() == ["Not armed: hold still 6 s"]


async def test_a_denial_has_reason_1_so_that_px4_leaves_the_words_to_us() -> None:
    async with asked_by_px4() as b:
        b.gate.says = ArmAnswer("refuse", "no data from gradienter for 12 s")
        await ask(b)
        assert answers(b) == [(DENIED, 1, 0)]
        assert b.ground.texts() == ["Not armed: no data from gradienter for 12 s"]


async def test_both_requests_of_an_attempt_and_every_retransmission_are_answered_and_told_once() -> None:
    async with asked_by_px4() as b:
        b.gate.says = ArmAnswer("wait", "hold still 6 s")
        await ask(b)
        b.gate.says = ArmAnswer("wait", "hold still 5 s")  # other words: still the same attempt
        await ask(b)
        for confirmation in (1, 2, 3):
            await asyncio.sleep(0.5)
            await ask(b, confirmation=confirmation)
        assert [result for result, _, _ in answers(b)] == [TEMPORARILY_REJECTED] * 5
        assert b.ground.texts() == ["Not armed: hold still 6 s"]
        await asyncio.sleep(3.0)
        await ask(b)
        assert b.ground.texts() == ["Not armed: hold still 6 s", "Not armed: hold still 5 s"]


@pytest.mark.parametrize("component", [0, 191])
async def test_requests_to_component_0_and_to_191_are_answered(component: int) -> None:
    async with asked_by_px4() as b:
        await ask(b, target=(VEHICLE, component))
        assert answers(b) == [(ACCEPTED, 0, 10)]


async def test_every_answer_is_repeated_since_px4_drops_one_that_bears_the_time_of_its_question() -> None:
    async with asked_by_px4() as b:
        await ask(b)
        first, second = [t_s for t_s, m in b.ground.received if m.get_type() == "COMMAND_ACK"]
        assert 0.04 < second - first < 0.06


async def test_requests_to_another_component_or_by_another_system_are_ignored() -> None:
    async with asked_by_px4() as b:
        await ask(b, target=(VEHICLE, 195))
        assert answers(b) == []
    async with bench(system_id=VEHICLE, ground=Ground(9, 1)) as b:
        await asyncio.sleep(0.1)
        await ask(b)
        assert [m for _, m in b.ground.received if m.get_type() == "COMMAND_ACK"] == []
    async with bench(system_id=VEHICLE, ground=Ground(VEHICLE, 190)) as b:
        await asyncio.sleep(0.1)
        await ask(b)
        assert [m for _, m in b.ground.received if m.get_type() == "COMMAND_ACK"] == []


async def test_a_question_to_another_system_is_not_answered() -> None:
    async with asked_by_px4() as b:
        await ask(b, target=(10, 0))
        await ask(b, target=(10, 0), confirmation=1)
        assert answers(b) == []
        assert b.ground.texts() == []


@pytest.mark.parametrize("verdict", ["accept", "wait", "refuse"])
async def test_warn_always_accepts_with_the_warning_in_words(verdict: Literal["accept", "wait", "refuse"]) -> None:
    async with asked_by_px4() as b:
        b.gate.at_arm = "warn"
        b.gate.says = ArmAnswer(verdict, "not calibrated yet")
        await ask(b)
        assert answers(b) == [(ACCEPTED, 0, 10)]
        warned = ["Arming uncalibrated: not calibrated yet"]
        assert b.ground.texts() == ([] if verdict == "accept" else warned)


async def test_off_answers_nothing() -> None:
    async with asked_by_px4() as b:
        b.gate.at_arm = "off"
        await ask(b)
        assert b.ground.ack_messages() == []
        assert b.ground.texts() == []


async def test_the_answer_leaves_in_the_same_pass_of_the_loop_as_the_question_came() -> None:
    async with asked_by_px4() as b:
        sent: list[str] = []
        b.link.attach(lambda data: sent.append("sent"))
        before = len(sent)
        b.link.receive(b.ground.pack(command_message(AUTHORISE, target=(VEHICLE, 0))), 0.0)
        assert len(sent) == before + 1


def tunnels(b: ComponentBench) -> list[bytes]:
    return [
        bytes(m.payload[: m.payload_length])
        for _, m in b.ground.received
        if isinstance(m, mavlink.MAVLink_tunnel_message) and (m.target_system, m.target_component) == (VEHICLE, 1)
    ]


async def test_the_script_hears_the_verdict_twice_a_second_only_while_it_is_asked_for() -> None:
    async with asked_by_px4() as b:
        await asyncio.sleep(3.0)
        assert tunnels(b) == []
        b.gate.asks_script = True
        b.gate.says = ArmAnswer("wait", "hold still 6 s")
        await asyncio.sleep(5.0)
        assert 9 <= len(tunnels(b)) <= 11
        assert set(tunnels(b)) == {b"CMPA\x01\x00hold still 6 s"}
        b.ground.received.clear()
        b.gate.says = ArmAnswer("refuse", "x" * 60)
        await asyncio.sleep(0.6)
        assert tunnels(b)[-1] == b"CMPA\x01\x02" + b"x" * (41 - len("Companion: "))
        b.gate.at_arm = "warn"
        await asyncio.sleep(0.6)
        assert tunnels(b)[-1][5] == 3
