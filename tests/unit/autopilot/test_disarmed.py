"""Proof that the autopilot is disarmed, on injected times; nothing leaves without it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.disarmed import DisarmedProof
from companion.autopilot.vehicle.heartbeats import ArmingWatch
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import NotDisarmedError
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, flying_on

X = "INS_GYROFFS_X"


def asked(*numbers: int, at_s: float = 0.0) -> DisarmedProof:
    proof = DisarmedProof()
    proof.begin(at_s)
    for number in numbers:
        proof.asked(number, at_s)
    return proof


def test_a_heartbeat_behind_the_answer_proves_it() -> None:
    proof = asked(7)
    proof.answered(7, 0.01)
    assert not proof.holds(0.01)
    proof.heard(armed=False)
    assert proof.holds(0.02)


def test_a_heartbeat_before_the_answer_may_have_waited_and_proves_nothing() -> None:
    proof = asked(7)
    proof.heard(armed=False)
    proof.answered(7, 0.01)
    assert not proof.holds(0.02)


def test_an_answer_to_no_question_of_ours_proves_nothing() -> None:
    proof = asked(7)
    proof.answered(8, 0.01)
    proof.heard(armed=False)
    assert not proof.holds(0.02)


def test_an_answer_to_the_question_of_an_earlier_write_proves_nothing_for_this_one() -> None:
    proof = asked(7)
    proof.begin(0.05)
    proof.answered(7, 0.06)
    proof.heard(armed=False)
    assert not proof.holds(0.07)


def test_an_armed_heartbeat_takes_the_proof_back() -> None:
    proof = asked(7)
    proof.answered(7, 0.01)
    proof.heard(armed=False)
    proof.heard(armed=True)
    proof.heard(armed=False)
    assert not proof.holds(0.02)


def test_a_proof_ends_so_long_after_its_question() -> None:
    proof = asked(7)
    proof.answered(7, 0.01)
    proof.heard(armed=False)
    for turn in range(30):
        assert proof.holds(0.05 * turn + 0.02)
    assert not proof.holds(1.52)


@pytest.mark.parametrize(("pause_s", "holds"), [(0.09, True), (0.11, False), (3.0, False)])
def test_after_a_pause_of_our_own_nothing_counts_that_was_asked_before_it(pause_s: float, holds: bool) -> None:
    before = asked(7)
    before.answered(7, 0.0)
    before.heard(armed=False)
    assert before.holds(pause_s) == holds, "the process stood still between proof and write"
    while_waiting = asked(7)
    while_waiting.awake(pause_s)
    while_waiting.answered(7, pause_s)
    while_waiting.heard(armed=False)
    assert while_waiting.holds(pause_s + 0.09) == holds, "what is read then may have waited"


def test_a_forger_who_is_nearer_does_not_answer_for_the_autopilot_behind_him() -> None:
    proof = asked(7)
    for answer_s in (0.001, 0.06):
        proof.answered(7, answer_s)
    proof.begin(1.0)
    proof.asked(8, 1.0)
    proof.answered(8, 1.001)
    proof.heard(armed=False)
    assert not proof.holds(1.002), "the slower of the two can still say that it is armed"
    assert proof.holds(1.061)


def test_a_question_is_forgotten_after_some_more() -> None:
    proof = asked(*range(1, 100))
    proof.answered(1, 0.01)
    proof.heard(armed=False)
    assert not proof.holds(0.02)


def contradicted(until_s: float) -> ArmingWatch:
    """Armed and disarmed by turns every tenth of a second, from 0 on."""
    arming = ArmingWatch()
    for tenth in range(int(until_s * 10) + 1):
        arming.heard(0.1 * tenth, armed=tenth % 2 == 0)
    return arming


def test_after_a_contradiction_disarmed_is_believed_only_when_nothing_else_was_heard_for_long() -> None:
    arming = contradicted(2.0)
    for second in range(3, 32):
        arming.heard(float(second), armed=False)
        assert arming.contradicts_itself(second + 0.9), second
    arming.heard(31.9, armed=True)
    arming.heard(32.0, armed=False)
    assert arming.contradicts_itself(61.8), "one armed heartbeat that comes through begins it anew"
    assert not arming.contradicts_itself(61.9)
    arming.heard(62.0, armed=False)
    for at_s, armed in ((70.0, True), (72.0, False)):
        arming.heard(at_s, armed=armed)
        assert not arming.contradicts_itself(at_s), "an ordinary arming is no contradiction any more"


def test_after_a_contradiction_armed_is_believed_sooner() -> None:
    arming = contradicted(2.0)
    for second in range(3, 12):
        arming.heard(float(second), armed=True)
        assert arming.contradicts_itself(second + 0.8)
    assert not arming.contradicts_itself(12.0)


@contextlib.asynccontextmanager
async def aboard(autopilot: ScriptedAutopilot) -> AsyncIterator[tuple[ParameterClient, MavlinkLink]]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    async with flying_on(link, autopilot):
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        yield client, link
    vehicle.close()


def unanswered(autopilot: ScriptedAutopilot) -> Callable[[object], bool]:
    """Lets every message pass but our questions, so that their answers stay away."""
    return lambda message: message.get_type() != "TIMESYNC"  # type: ignore[attr-defined]


async def test_neither_acknowledgement_nor_heartbeat_is_an_answer_and_why_nothing_is_written_is_said() -> None:
    autopilot = ScriptedAutopilot(parameters={X: 0.0})
    async with aboard(autopilot) as (client, _):
        autopilot.on_message = unanswered(autopilot)
        with pytest.raises(NotDisarmedError, match=r"not written: ArduPilot.* does not answer whether it is armed"):
            await client.write(X, 0.5)
        assert autopilot.sets == []
        questions = [each for each in autopilot.requests if each.get_type() == "TIMESYNC"]
        assert len({question.ts1 for question in questions}) == len(questions) > 20
        autopilot.on_message = lambda _message: True
        assert await client.write(X, 0.5) == 0.5


async def test_a_heartbeat_that_can_only_be_waited_for_is_waited_for() -> None:
    autopilot = ScriptedAutopilot(parameters={X: 0.0})
    autopilot.result_of = lambda _message: mavlink.MAV_RESULT_UNSUPPORTED
    autopilot.on_message = lambda message: message.get_type() != "COMMAND_LONG"
    async with aboard(autopilot) as (client, _):
        loop = asyncio.get_running_loop()
        for late_s in (0.05, 0.3, 0.6):
            await asyncio.sleep(late_s)
            began_s = loop.time()
            await client.write(X, 0.5)
            assert loop.time() - began_s < 1.2
        assert {armed for _, _, armed in autopilot.sets} == {False}


@pytest.mark.parametrize("pause_s", [0.05, 0.5])
async def test_a_process_that_stands_still_between_the_proof_and_the_write_does_not_write(pause_s: float) -> None:
    autopilot = ScriptedAutopilot(parameters={X: 0.0})
    async with aboard(autopilot) as (client, link):
        send, stopped = link.send, False

        def stop(message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
            nonlocal stopped
            if message.get_type() == "PARAM_SET" and not stopped:
                stopped = True
                asyncio.get_running_loop()._jumping.now_s += pause_s  # type: ignore[attr-defined]
                autopilot.armed = pause_s > 0.1
            return send(message, *allowed)

        link.send = stop  # type: ignore[method-assign]
        if pause_s < 0.1:
            await client.write(X, 0.5)
        else:
            with pytest.raises(NotDisarmedError, match="the aircraft is armed"):
                await client.write(X, 0.5)
        assert [armed for _, _, armed in autopilot.sets] == [False] * (pause_s < 0.1)


async def test_what_has_arrived_is_read_before_anything_is_written() -> None:
    autopilot = ScriptedAutopilot(parameters={X: 0.0})
    async with aboard(autopilot) as (client, link):
        armed = mavlink.MAVLink_heartbeat_message(2, 3, mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 0, 3, 3)
        waiting = [armed.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))]
        transmit = link._transmit

        def settled() -> bool:
            while waiting and any(each.get_type() == "TIMESYNC" for each in autopilot.requests):
                link.receive(waiting.pop(), asyncio.get_running_loop().time())
            return True

        link.attach(transmit, settled)
        with pytest.raises(NotDisarmedError, match="armed"):
            await client.write(X, 0.5)
        assert autopilot.sets == []
        link.attach(transmit, lambda: False)
        await asyncio.sleep(4.0)
        with pytest.raises(NotDisarmedError):
            await client.write(X, 0.5)
        assert autopilot.sets == [], "more came than could be read, or something still waited to leave"


async def test_heartbeats_are_asked_for_more_often_before_the_first_write_and_again_when_that_was_lost() -> None:
    autopilot = ScriptedAutopilot(parameters={X: 0.0})
    lost: list[object] = []

    def lose_the_first(message: object) -> bool:
        wanted = getattr(message, "command", 0) == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and message.param1 == 0  # type: ignore[attr-defined]
        if wanted and len(lost) < 2:
            lost.append(message)
            return False
        return True

    autopilot.on_message = lose_the_first
    async with aboard(autopilot):
        assert lost
        await asyncio.sleep(10.0)
        assert autopilot.heartbeat_s == pytest.approx(0.2)
