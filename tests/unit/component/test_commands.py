"""The command server, as a ground station sees it."""

from __future__ import annotations

import asyncio
import math
from itertools import pairwise
from typing import Literal

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import Refusal
from companion.estimation.machine import What
from tests.support.component import (
    ACCEPTED,
    CALIBRATE,
    CANCEL,
    CANCELLED,
    DENIED,
    FAILED,
    IN_PROGRESS,
    PREFLIGHT,
    TEMPORARILY_REJECTED,
    UNDO,
    UNSUPPORTED,
    Ground,
    bench,
    command_message,
)
from tests.support.wire import Wire

NAN = math.nan


@pytest.mark.parametrize("int_", [False, True], ids=["LONG", "INT"])
@pytest.mark.parametrize(
    ("command", "params", "what"),
    [
        (CALIBRATE, (0,), What.BOTH),
        (CALIBRATE, (1,), What.GYROS),
        (CALIBRATE, (2,), What.ACCELEROMETERS),
        (CALIBRATE, (1, 1), What.GYROS),  # and a reboot
        (PREFLIGHT, (1, 0, 0, 0, 1), What.BOTH),
        (PREFLIGHT, (1,), What.GYROS),
        (PREFLIGHT, (1, 0, 1), What.GYROS),  # what Mission Planner's "Preflight Calibration" button sends
        (PREFLIGHT, (0, 0, 0, 0, 1), What.ACCELEROMETERS),
        (UNDO, (), "undo"),
    ],
)
async def test_what_is_asked_for_is_started(
    command: int, params: tuple[float, ...], what: What | Literal["undo"], int_: bool
) -> None:
    async with bench() as b:
        b.service.takes_s = 1.0
        b.ground.command(command, *params, int_=int_)
        await asyncio.sleep(2)
        assert [started.what for started in b.service.started] == [what]
        assert b.service.started[0].requester == "mavlink 255/190"
        assert b.service.reboots == ([] if command == UNDO else [params == (1, 1)])
        assert b.ground.finals(command) == [ACCEPTED]


@pytest.mark.parametrize(
    ("command", "params"),
    [
        *[(CALIBRATE, (value,)) for value in (NAN, 0.5, 3, -1, math.inf, 1e-9, 1.0000001, 1e30)],
        (CALIBRATE, (0, 2)),
        (PREFLIGHT, ()),
        (PREFLIGHT, (2,)),
        (PREFLIGHT, (NAN,)),
        (PREFLIGHT, (0.5,)),
        (PREFLIGHT, (0, 1)),
        (PREFLIGHT, (0, 0, 1)),
        (PREFLIGHT, (1, 0, 2)),
        (PREFLIGHT, (1, 0, 0, NAN)),
        (PREFLIGHT, (0, 0, 0, 0, 2)),
        (PREFLIGHT, (0, 0, 0, 0, 76)),
        (PREFLIGHT, (1, 0, 0, 0, 0, 1)),
        (PREFLIGHT, (1, 0, 0, 0, 0, 0, 1)),
    ],
)
async def test_other_parameters_are_denied_with_words(command: int, params: tuple[float, ...]) -> None:
    async with bench() as b:
        b.ground.command(command, *params)
        await asyncio.sleep(3)
        assert b.ground.acks() == [DENIED]
        assert b.service.started == []
        (text,) = b.ground.texts()
        assert text.startswith("Calibration refused: ")
        assert len(text) <= 50


@pytest.mark.parametrize("int_", [False, True], ids=["LONG", "INT"])
@pytest.mark.parametrize("command", [CALIBRATE, 512])
@pytest.mark.parametrize("target", [(1, 1), (1, 0), (0, 191), (0, 0), (2, 191), (1, 190)])
async def test_what_is_addressed_to_others_is_ignored(target: tuple[int, int], command: int, int_: bool) -> None:
    async with bench() as b:
        b.ground.command(command, 1, target=target, int_=int_)
        await asyncio.sleep(3)
        assert (b.ground.acks(), b.ground.texts(), b.service.started) == ([], [], [])


async def test_our_own_echo_is_no_command() -> None:
    async with bench() as b:
        echo = Ground(1, 191)
        b.link.receive(echo.pack(command_message(CALIBRATE, 0)), asyncio.get_running_loop().time())
        await asyncio.sleep(1)
        assert b.service.started == []


@pytest.mark.parametrize(("outcome", "result"), [("done", ACCEPTED), ("failed", FAILED), ("cancelled", CANCELLED)])
async def test_progress_comes_at_once_and_often_and_then_one_end(
    outcome: Literal["done", "failed", "cancelled"], result: int
) -> None:
    async with bench() as b:
        await asyncio.sleep(0.123)
        asked_s = asyncio.get_running_loop().time()
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(0.05)
        (job,) = b.service.jobs
        for percent in range(1, 101):
            job.progress_percent = percent
            await asyncio.sleep(0.1)
        job.finish(outcome, "the figures")
        ended_s = asyncio.get_running_loop().time()
        await asyncio.sleep(5)
        times = b.ground.times("COMMAND_ACK")
        assert times[0] - asked_s < 0.02
        assert all(later - earlier <= 0.41 for earlier, later in pairwise(times))
        assert times[-1] - ended_s < 0.02
        acks = b.ground.ack_messages()
        assert [ack.result for ack in acks] == [IN_PROGRESS] * (len(acks) - 1) + [result]
        progress = [ack.progress for ack in acks[:-1]]
        assert progress == sorted(progress)
        assert (progress[0], progress[-1] > 95) == (0, True)
        assert len(set(progress)) > 20
        assert acks[-1].progress == 0
        assert b.ground.texts() == [], "the words of the end are the service's"


async def test_progress_stays_a_percentage() -> None:
    async with bench() as b:
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(0.1)
        for percent in (-7, 101, 255, 100000):
            b.service.jobs[0].progress_percent = percent
            await asyncio.sleep(0.5)
        assert {ack.progress for ack in b.ground.ack_messages()} == {0, 100}


@pytest.mark.parametrize("command", [CALIBRATE, PREFLIGHT, UNDO])
async def test_a_job_that_is_done_at_once_is_still_announced_first(command: int) -> None:
    async with bench() as b:
        b.service.takes_s = 0
        b.ground.command(command, 1)
        await asyncio.sleep(5)
        assert b.ground.acks() == [IN_PROGRESS, ACCEPTED]


async def test_acks_name_their_requester() -> None:
    async with bench() as b:
        b.service.takes_s = 1.0
        other = Ground(42, 17)
        b.ground.send_raw(other.pack(command_message(CALIBRATE, 2)))
        await asyncio.sleep(2)
        targets = {
            (m.target_system, m.target_component, m.get_srcSystem(), m.get_srcComponent(), m.command)
            for _, m in b.ground.received
            if isinstance(m, mavlink.MAVLink_command_ack_message)
        }
        assert targets == {(42, 17, 1, 191, CALIBRATE)}


class TestCancel:
    async def test_with_nothing_running_is_accepted(self) -> None:
        async with bench() as b:
            b.ground.command(CANCEL, NAN)
            await asyncio.sleep(2)
            b.ground.command(CANCEL, NAN, confirmation=1)
            await asyncio.sleep(0.5)
            acks = b.ground.ack_messages()
            assert [(ack.result, ack.result_param2) for ack in acks] == [(ACCEPTED, 1)] * 2

    async def test_of_nothing_says_so_also_when_the_transport_was_full_at_first(self) -> None:
        async with bench() as b:
            b.link.attach(lambda data: False)
            b.link.receive(b.ground.pack(command_message(CANCEL)), asyncio.get_running_loop().time())
            await asyncio.sleep(0.5)
            assert b.ground.acks(CANCEL) == []
            Wire(b.link, b.ground)
            await asyncio.sleep(0.5)
            assert [(ack.result, ack.result_param2) for ack in b.ground.ack_messages()] == [(ACCEPTED, 1)]

    async def test_ends_the_request_it_cancels_too(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.ground.send_raw(Ground(254, 1).pack(command_message(CANCEL)))
            await asyncio.sleep(3)
            assert b.ground.finals(CALIBRATE) == [CANCELLED]
            accepted = [
                m.result
                for _, m in b.ground.received
                if isinstance(m, mavlink.MAVLink_command_ack_message) and m.command == CANCEL
            ]
            assert accepted == [ACCEPTED]

    async def test_and_a_new_request_in_the_same_breath_both_work(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            other = Ground(254, 1)
            together = other.pack(command_message(CANCEL)) + other.pack(command_message(UNDO))
            b.link.receive(together, asyncio.get_running_loop().time())
            await asyncio.sleep(1)
            assert b.ground.finals(CALIBRATE) == [CANCELLED]
            assert [started.what for started in b.service.started] == [What.BOTH, "undo"]


class TestBusy:
    async def test_another_sender_and_another_command_are_put_off(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.ground.command(UNDO)
            b.ground.command(PREFLIGHT, 1)
            other = Ground(255, 191)
            b.ground.send_raw(other.pack(command_message(CALIBRATE, 0)))
            await asyncio.sleep(3)
            assert b.ground.acks(UNDO) == b.ground.acks(PREFLIGHT) == [TEMPORARILY_REJECTED]
            answers = [
                m.result
                for _, m in b.ground.received
                if isinstance(m, mavlink.MAVLink_command_ack_message) and m.target_component == 191
            ]
            assert answers == [TEMPORARILY_REJECTED]
            assert len(b.service.started) == 1
            assert set(b.ground.texts()) == {
                "Undo refused: a calibration is running",
                "Calibration refused: a calibration is running",
            }
            b.service.jobs[0].finish("done")
            await asyncio.sleep(1)
            assert b.ground.finals(CALIBRATE) == [ACCEPTED]

    @pytest.mark.parametrize("confirmation", [0, 1])
    async def test_a_repeat_is_told_that_it_is_in_progress(self, confirmation: int) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(0.1)
            before = len(b.ground.acks())
            b.ground.command(CALIBRATE, 0, confirmation=confirmation)
            await asyncio.sleep(0.1)
            assert b.ground.acks()[before:] == [IN_PROGRESS]
            assert len(b.service.started) == 1
            assert b.ground.texts() == []

    async def test_asking_for_something_else_meanwhile_is_answered_in_words(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(0.1)
            b.ground.command(CALIBRATE, 1)
            await asyncio.sleep(1)
            assert set(b.ground.acks()) == {IN_PROGRESS}
            assert len(b.service.started) == 1
            assert b.ground.texts() == ["Still calibrating gyros and accelerometers"]

    async def test_nonsense_meanwhile_is_denied_and_the_job_ends_as_it_should(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(0.1)
            b.ground.command(CALIBRATE, 7)
            await asyncio.sleep(1)
            b.service.jobs[0].finish("done")
            await asyncio.sleep(1)
            assert b.ground.finals() == [DENIED, ACCEPTED]


@pytest.mark.parametrize("command", [CALIBRATE, PREFLIGHT, UNDO])
@pytest.mark.parametrize(
    ("kind", "result"),
    [
        ("armed", DENIED),
        ("unknown", DENIED),
        ("nothing_to_undo", DENIED),
        ("other", DENIED),
        ("busy", TEMPORARILY_REJECTED),
    ],
)
async def test_the_services_refusals(
    kind: Literal["armed", "unknown", "busy", "nothing_to_undo", "other"], result: int, command: int
) -> None:
    async with bench() as b:
        b.service.refusal = Refusal(kind, "the reason")
        b.ground.command(command, 1)
        await asyncio.sleep(3)
        assert b.ground.acks() == [result]
        name = "Undo" if command == UNDO else "Calibration"
        assert b.ground.texts() == [f"{name} refused: the reason"]


@pytest.mark.parametrize(("command", "param1"), [(CALIBRATE, 0), (UNDO, 0), (CANCEL, 0)])
async def test_a_service_that_breaks_is_a_failure_not_silence(command: int, param1: float) -> None:
    async with bench() as b:
        b.service.error = ZeroDivisionError("a defect")
        b.ground.command(command, param1)
        await asyncio.sleep(3)
        assert b.ground.acks() == [FAILED]
        assert len(b.ground.texts()) == 1


async def test_stopping_the_companion_ends_the_request() -> None:
    async with bench() as b:
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(1)
        b.task.cancel()
        await asyncio.sleep(0.1)
        assert b.ground.finals() == [FAILED]
        assert b.ground.texts() == ["Failed: the companion stops"]
        b.ground.command(CALIBRATE, 0)
        await asyncio.sleep(1)
        assert len(b.service.started) == 1


class TestRetransmission:
    @pytest.mark.parametrize("outcome", ["done", "failed", "cancelled"])
    async def test_after_the_end_gets_the_same_end_again(self, outcome: Literal["done", "failed", "cancelled"]) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.service.jobs[0].finish(outcome)
            await asyncio.sleep(0.1)
            (first,) = b.ground.finals()
            await asyncio.sleep(2.8)
            b.ground.command(CALIBRATE, 0, confirmation=1)
            await asyncio.sleep(0.05)
            assert b.ground.finals() == [first, first]
            assert len(b.service.started) == 1

    async def test_long_after_the_end_starts_anew(self) -> None:
        async with bench() as b:
            b.service.takes_s = 0.5
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(3.7)
            b.ground.command(CALIBRATE, 0, confirmation=1)
            await asyncio.sleep(1)
            assert len(b.service.started) == 2

    async def test_a_new_press_of_the_button_starts_anew(self) -> None:
        async with bench() as b:
            b.service.takes_s = 0.5
            for _ in range(3):
                b.ground.command(CALIBRATE, 0)
                await asyncio.sleep(0.6)
            assert len(b.service.started) == 3
            assert b.ground.finals() == [ACCEPTED] * 3

    async def test_of_the_first_to_arrive_starts(self) -> None:
        async with bench() as b:
            b.ground.command(CALIBRATE, 0, confirmation=2)
            await asyncio.sleep(0.1)
            assert len(b.service.started) == 1

    async def test_of_a_refusal_gets_the_refusal_again(self) -> None:
        async with bench() as b:
            b.service.refusal = Refusal("armed", "armed")
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.service.refusal = None
            b.ground.command(CALIBRATE, 0, confirmation=1)
            await asyncio.sleep(1)
            assert b.ground.acks() == [DENIED, DENIED]
            assert b.service.started == []

    async def test_of_a_cancel_does_not_cancel_what_was_started_since(self) -> None:
        async with bench() as b:
            b.ground.command(CANCEL)
            await asyncio.sleep(0.5)
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(0.5)
            b.ground.command(CANCEL, confirmation=1)
            await asyncio.sleep(0.5)
            assert b.ground.acks(CANCEL) == [ACCEPTED, ACCEPTED]
            assert not b.service.jobs[0].finished.done()


async def test_a_sender_that_never_counts_its_packets_may_press_again() -> None:
    async with bench() as b:
        b.service.takes_s = 0
        packet = b.ground.pack(command_message(CALIBRATE, 0))
        for _ in range(3):
            b.ground.send_raw(packet)
            await asyncio.sleep(0.6)
        assert b.ground.finals() == [ACCEPTED] * 3
        assert len(b.service.started) == 3


@pytest.mark.parametrize("command", [400, 31013, 31014, 2500, 65535])
async def test_unknown_commands_are_unsupported(command: int) -> None:
    async with bench() as b:
        b.ground.command(command, 1)
        await asyncio.sleep(1)
        assert b.ground.acks() == [UNSUPPORTED]
        assert b.ground.texts() == [f"Command {command} is not supported by the companion"]


async def test_arm_authorisation_is_left_to_who_decides_it() -> None:
    async with bench() as b:
        b.ground.command(3001)
        b.ground.command(3001, target=(1, 0))
        await asyncio.sleep(1)
        assert (b.ground.acks(), b.ground.texts()) == ([], [])


@pytest.mark.parametrize(("command", "param1"), [(512, 148), (520, 1)])
async def test_the_version_is_sent_on_request(command: int, param1: float) -> None:
    async with bench() as b:
        b.ground.command(command, param1)
        await asyncio.sleep(1)
        assert b.ground.acks() == [ACCEPTED]
        (version,) = [m for _, m in b.ground.received if isinstance(m, mavlink.MAVLink_autopilot_version_message)]
        # MAVLINK2 8192, COMMAND_INT 8, PARAM_FLOAT 2, PARAM_ENCODE_C_CAST 131072; never BYTEWISE (16) too
        assert version.capabilities == 8192 + 8 + 2 + 131072
        assert version.get_srcComponent() == 191


@pytest.mark.parametrize(
    ("message_id", "result"),
    [(0, UNSUPPORTED), (395, UNSUPPORTED), (16777215, UNSUPPORTED), (NAN, DENIED), (148.5, DENIED), (-1, DENIED)],
)
async def test_other_messages_cannot_be_requested(message_id: float, result: int) -> None:
    async with bench() as b:
        b.ground.command(512, message_id)
        await asyncio.sleep(1)
        assert b.ground.acks() == [result]
        assert len(b.ground.texts()) == 1


async def test_a_flood_of_commands_leaves_nothing_behind() -> None:
    async with bench() as b:
        b.wire.unplug()
        now_s = asyncio.get_running_loop().time
        b.link.attach(lambda data: None)
        for system_id in range(1, 251):
            sender = Ground(system_id, 1)
            for command in range(20):
                b.link.receive(sender.pack(command_message(command + 400)), now_s())
        server = b.component._commands
        assert len(server._finals) <= 32
        assert len(server._packets) <= 32


class TestBrokenTransport:
    async def test_the_end_is_told_when_the_transport_is_back_in_time(self) -> None:
        async with bench() as b:
            transmit = b.link._transmit
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            for gone in (None, lambda data: False):
                b.ground.command(CALIBRATE, 0)
                await asyncio.sleep(1)
                b.link.attach(gone)
                b.service.jobs[-1].finish("failed")
                await asyncio.sleep(2)
                before = len(b.ground.finals())
                b.link.attach(transmit)
                await asyncio.sleep(0.2)
                assert b.ground.finals()[before:] == [FAILED]
                await asyncio.sleep(5)
                assert len(b.ground.finals()) == before + 1

    async def test_long_after_it_is_told_to_nobody(self) -> None:
        async with bench() as b:
            transmit = b.link._transmit
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.link.attach(None)
            b.service.jobs[0].finish("done")
            await asyncio.sleep(3.2)
            b.link.attach(transmit)
            await asyncio.sleep(5)
            assert b.ground.finals() == []

    async def test_a_new_press_forgets_an_end_that_was_never_told(self) -> None:
        async with bench() as b:
            transmit = b.link._transmit
            b.ground.command(CALIBRATE, 0)
            await asyncio.sleep(1)
            b.link.attach(None)
            b.service.jobs[0].finish("failed")
            await asyncio.sleep(0.5)
            again = b.ground.pack(command_message(CALIBRATE, 0))
            b.link.receive(again, asyncio.get_running_loop().time())
            b.link.attach(transmit)
            await asyncio.sleep(1)
            assert b.ground.finals() == []
            b.service.jobs[1].finish("done")
            await asyncio.sleep(1)
            assert b.ground.finals() == [ACCEPTED]
