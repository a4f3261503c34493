from __future__ import annotations

import asyncio

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.commands import MAX_WAITING, Commands
from companion.links.mavlink.link import MavlinkLink

SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL


class CommandPeer:
    """Decodes what is sent and answers by hand."""

    def __init__(self, link: MavlinkLink) -> None:
        self.sent: list[mavlink.MAVLink_message] = []
        self._link = link
        self._codec = mavlink.MAVLink(None)
        self._answers = 0
        link.attach(lambda data: self.sent.extend(self._codec.parse_buffer(data) or ()))

    def ack(self, command: int, result: int, *, who: tuple[int, int] = (1, 1), to: tuple[int, int] = (0, 0)) -> None:
        codec = mavlink.MAVLink(None, srcSystem=who[0], srcComponent=who[1])
        codec.seq = self._answers = self._answers + 1
        message = mavlink.MAVLink_command_ack_message(command, result, 0, 0, *to)
        self._link.receive(message.pack(codec), asyncio.get_running_loop().time())


async def test_the_answer_of_the_right_sender_to_the_right_command_for_us() -> None:
    link = MavlinkLink()
    peer = CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    answer = commands.send(SET_INTERVAL, 105, 10000)
    for who, command, to in (
        ((2, 1), SET_INTERVAL, (0, 0)),
        ((1, 154), SET_INTERVAL, (0, 0)),
        ((1, 1), mavlink.MAV_CMD_REQUEST_MESSAGE, (0, 0)),
        ((1, 1), SET_INTERVAL, (255, 190)),
        ((1, 1), SET_INTERVAL, (1, 190)),
    ):
        peer.ack(command, mavlink.MAV_RESULT_DENIED, who=who, to=to)
        assert not answer.done()
    peer.ack(SET_INTERVAL, mavlink.MAV_RESULT_ACCEPTED, to=(1, 191))
    assert await answer == mavlink.MAV_RESULT_ACCEPTED


async def test_one_of_a_kind_is_in_flight_and_silence_lets_the_next_go() -> None:
    link = MavlinkLink()
    peer = CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    first, second = commands.send(SET_INTERVAL, 105), commands.send(SET_INTERVAL, 26)
    other = commands.send(mavlink.MAV_CMD_REQUEST_MESSAGE, 148)
    assert len(peer.sent) == 2
    start_s = asyncio.get_running_loop().time()
    assert await first is None
    assert asyncio.get_running_loop().time() - start_s == pytest.approx(0.5)
    peer.ack(SET_INTERVAL, mavlink.MAV_RESULT_DENIED)
    assert await second == mavlink.MAV_RESULT_DENIED
    assert await other is None


async def test_a_request_that_was_brought_and_refused_twice_does_not_refuse_the_next_one() -> None:
    link = MavlinkLink()
    peer = CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    first, second = commands.send(SET_INTERVAL, 105), commands.send(SET_INTERVAL, 26)
    for _ in range(2):
        peer.ack(SET_INTERVAL, mavlink.MAV_RESULT_DENIED)
        await asyncio.sleep(0.01)
    assert await first == mavlink.MAV_RESULT_DENIED
    await asyncio.sleep(0.1)
    assert len(peer.sent) == 2
    peer.ack(SET_INTERVAL, mavlink.MAV_RESULT_ACCEPTED)
    assert await second == mavlink.MAV_RESULT_ACCEPTED


async def test_in_progress_starts_the_time_anew() -> None:
    link = MavlinkLink()
    peer = CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    answer = commands.send(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1, timeout_s=1.0)
    for _ in range(5):
        await asyncio.sleep(0.8)
        peer.ack(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, mavlink.MAV_RESULT_IN_PROGRESS)
    assert not answer.done()
    peer.ack(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, mavlink.MAV_RESULT_ACCEPTED)
    assert await answer == mavlink.MAV_RESULT_ACCEPTED


async def test_the_queue_is_bounded_and_an_unknown_target_or_an_end_is_answered_at_once() -> None:
    link = MavlinkLink()
    CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    answers = [commands.send(SET_INTERVAL, i) for i in range(MAX_WAITING + 2)]
    assert answers[-1].done()
    assert commands.results["dropped"] == 1
    commands.close()
    assert all(answer.result() is None for answer in answers)
    nobody = Commands(link, lambda: None)
    assert await nobody.send(SET_INTERVAL, 1) is None


async def test_whoever_gave_up_is_skipped() -> None:
    link = MavlinkLink()
    peer = CommandPeer(link)
    commands = Commands(link, lambda: (1, 1))
    first, second = commands.send(SET_INTERVAL, 105), commands.send(SET_INTERVAL, 26)
    third = commands.send(SET_INTERVAL, 27)
    first.cancel()
    second.cancel()
    await asyncio.sleep(0.6)
    assert [int(m.param1) for m in peer.sent if isinstance(m, mavlink.MAVLink_command_long_message)] == [105, 27]
    assert await third is None
