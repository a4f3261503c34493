"""Exactly one final ACK a request, whatever the wire, the senders and the service do."""

from __future__ import annotations

import asyncio
import math
import random
from collections import Counter
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.commands import Calibrate, Cancel, Undo
from companion.component.commands import CommandMessage, judge
from companion.component.service import Refusal
from companion.links.mavlink.link import MavlinkLink
from tests.support.component import (
    ACCEPTED,
    CALIBRATE,
    CANCEL,
    CANCELLED,
    FAILED,
    IN_PROGRESS,
    PREFLIGHT,
    UNDO,
    ComponentBench,
    Ground,
    bench,
    command_message,
)
from tests.support.virtual_time import run_virtual

COMMANDS = (CALIBRATE, CALIBRATE, CALIBRATE, UNDO, PREFLIGHT, CANCEL, 400)
Key = tuple[int, int, int]


class Ack(NamedTuple):
    key: Key
    result: int


def acks_in(raw: list[bytes]) -> list[Ack]:
    """The COMMAND_ACKs in what the component sent, read from the bytes: one frame to an item."""
    found = []
    for data in raw:
        if int.from_bytes(data[7:10], "little") == 77:
            payload = data[10 : 10 + data[1]].ljust(10, b"\0")
            command = int.from_bytes(payload[0:2], "little")
            found.append(Ack((payload[8], payload[9], command), payload[2]))
    return found


def tap(b: ComponentBench) -> list[bytes]:
    """Messages of the component before the wire loses or doubles them."""
    sent: list[bytes] = []
    transmit = b.link._transmit
    assert transmit is not None

    def both(data: bytes) -> None:
        sent.append(data)
        transmit(data)

    b.link._transmit = both
    return sent


def watch_starts(b: ComponentBench) -> list[str]:
    """Jobs that were started by a packet that should not have started one: a copy, or an answered retransmission."""
    wrong: list[str] = []
    last_final_s: dict[Key, float] = {}
    packets: set[bytes] = set()
    started = 0
    transmit = b.link._transmit
    assert transmit is not None

    def watch_sent(data: bytes) -> None:
        for ack in acks_in([data]):
            if ack.result != IN_PROGRESS:
                last_final_s[ack.key] = asyncio.get_running_loop().time()
        transmit(data)

    def watch_received(message: mavlink.MAVLink_command_long_message, t_s: float) -> None:
        nonlocal started  # the component's handler was subscribed before, and has done its work
        key = (message.get_srcSystem(), message.get_srcComponent(), message.command)
        packet = bytes(message.get_msgbuf())
        if len(b.service.started) > started:
            if packet in packets:
                wrong.append(f"a copy of {key} started a job")
            if message.confirmation > 0 and t_s - last_final_s.get(key, -math.inf) <= 3.0 - 1e-6:
                wrong.append(f"a retransmission of {key} started a job")
        started = len(b.service.started)
        packets.add(packet)

    b.link._transmit = watch_sent
    b.link.subscribe(mavlink.MAVLink_command_long_message, watch_received)
    return wrong


async def play_service(b: ComponentBench, dice: random.Random) -> None:
    """Jobs that end in every way and at any time, and refusals in between."""
    while True:
        await asyncio.sleep(dice.choice((0.0, 0.05, 0.3, 1.0, 2.5)))
        b.service.takes_s = dice.choice((None, 0, 0.01, 0.7, 2.0))
        b.service.refusal = Refusal(dice.choice(("armed", "busy")), "no") if dice.random() < 0.15 else None
        for job in b.service.jobs:
            if not job.finished.done() and dice.random() < 0.5:
                job.finish(dice.choice(("done", "failed", "cancelled")))


@pytest.mark.parametrize("block", range(10))
def test_without_loss_every_request_has_one_final_ack_even_if_packets_are_doubled(block: int) -> None:
    async def main(seed: int) -> None:
        dice = random.Random(seed)
        async with bench(seed=seed, duplicate=dice.choice((0.0, 0.3, 1.0))) as b:
            sent = tap(b)
            players = asyncio.create_task(play_service(b, dice))
            senders = [Ground(255, 190), Ground(255, 191), Ground(3, 1)]
            asked: Counter[Key] = Counter()
            for _ in range(25):
                sender, command = dice.choice(senders), dice.choice(COMMANDS)
                key = (sender.system_id, sender.component_id, command)
                finals = Counter(ack.key for ack in acks_in(sent) if ack.result != IN_PROGRESS)
                if finals[key] == asked[key]:
                    asked[key] += 1  # a new press; while one is open, this is its repeat
                packet = sender.pack(command_message(command, 1, int_=dice.random() < 0.5))
                b.ground.send_raw(packet)
                # Closer together than the wire's delay, "open" could not be told from here.
                await asyncio.sleep(dice.choice((0.02, 0.1, 0.4, 1.5)))
            players.cancel()
            for job in b.service.jobs:
                job.finish("done")
            await asyncio.sleep(1)
            finals = Counter(ack.key for ack in acks_in(sent) if ack.result != IN_PROGRESS)
            assert finals == asked, f"seed {seed}"

    for seed in range(block * 20, block * 20 + 20):
        run_virtual(main(seed))


class Press(NamedTuple):
    """One press of a button at a ground station, with all that came back until it was over."""

    key: Key
    results: list[int]
    gave_up: bool


async def press(b: ComponentBench, sender: Ground, command: int, dice: random.Random) -> Press:
    """A ground station by the protocol's book: retransmit on silence, stop at the first final result."""
    key = (sender.system_id, sender.component_id, command)
    results: list[int] = []
    loop = asyncio.get_running_loop()
    for confirmation in range(5):
        before = len(b.ground.received)
        b.ground.send_raw(sender.pack(command_message(command, 1, confirmation=confirmation)))
        silent_since_s = loop.time()
        while loop.time() - silent_since_s < 1.2:
            await asyncio.sleep(0.05)
            for _, message in b.ground.received[before:]:
                if isinstance(message, mavlink.MAVLink_command_ack_message) and key == (
                    message.target_system,
                    message.target_component,
                    message.command,
                ):
                    silent_since_s = loop.time()
                    results.append(message.result)
            before = len(b.ground.received)
            if results and results[-1] != IN_PROGRESS:
                await asyncio.sleep(dice.choice((0.1, 0.5, 2.0)))
                return Press(key, results, gave_up=False)
    return Press(key, results, gave_up=True)


@pytest.mark.parametrize("block", range(10))
def test_with_loss_a_press_never_starts_two_jobs_nor_ends_in_two_ways(block: int) -> None:
    async def main(seed: int) -> Counter[str]:
        dice = random.Random(seed)
        seen: Counter[str] = Counter()
        async with bench(seed=seed, loss=dice.choice((0.1, 0.3, 0.5)), duplicate=dice.choice((0.0, 0.3))) as b:
            sent = tap(b)
            wrong = watch_starts(b)
            players = asyncio.create_task(play_service(b, dice))
            presses: list[Press] = []

            async def station(sender: Ground) -> None:
                presses.extend([await press(b, sender, dice.choice(COMMANDS), dice) for _ in range(5)])

            async with asyncio.TaskGroup() as group:
                for sender in (Ground(255, 190), Ground(255, 191), Ground(3, 1)):
                    group.create_task(station(sender))
            players.cancel()
            for job in b.service.jobs:
                job.finish("done")
            await asyncio.sleep(1)

            for one in presses:
                finals = {result for result in one.results if result != IN_PROGRESS}  # the wire doubles ACKs too
                assert len(finals) == (0 if one.gave_up else 1), f"seed {seed}: {one}"
                seen["gave up" if one.gave_up else "ended"] += 1
            assert wrong == [], f"seed {seed}"
            seen["jobs"] += len(b.service.started)
            # And every job that was started was ended towards its requester, in the way it ended.
            ended = {(ack.key, ack.result) for ack in acks_in(sent)}
            for started in b.service.started:
                system_id, component_id = (int(part) for part in started.requester.split()[1].split("/"))
                result = {"done": ACCEPTED, "failed": FAILED, "cancelled": CANCELLED}[
                    started.job.finished.result().outcome
                ]
                commands = (UNDO,) if started.what == "undo" else (CALIBRATE, PREFLIGHT)
                assert any(((system_id, component_id, command), result) in ended for command in commands)
        return seen

    total: Counter[str] = Counter()
    for seed in range(1000 + block * 15, 1000 + block * 15 + 15):
        total += run_virtual(main(seed))
    assert total["ended"] > 4 * total["gave up"], "the wire was so bad that nothing was tested"
    assert total["jobs"] > total["ended"] / 4


@settings(max_examples=300)
@given(
    command=st.sampled_from([CALIBRATE, CANCEL, UNDO, PREFLIGHT, 512, 520, 3001]) | st.integers(0, 65535),
    parameters=st.lists(st.floats(width=32) | st.sampled_from([0.0, 1.0, 2.0]), min_size=7, max_size=7),
)
def test_only_exact_parameters_start_something(command: int, parameters: list[float]) -> None:
    message = command_message(command, *parameters)
    link, heard = MavlinkLink(system_id=9), list[CommandMessage]()
    link.subscribe(mavlink.MAVLink_command_long_message, lambda received, _: heard.append(received))
    link.receive(Ground().pack(message), 0.0)
    request = judge(heard[0])
    assert link.received["handler error"] == 0
    match request:
        case Calibrate() if command == CALIBRATE:
            assert parameters[0] == request.biases.value
        case Calibrate():
            assert command == PREFLIGHT
            assert (parameters[0], parameters[4]) == (request.biases.gyros, request.biases.accelerometers)
            assert parameters[2] in (0.0, 1.0)  # ground pressure, which Mission Planner ticks by habit
            assert not any([parameters[1], parameters[3], *parameters[5:]])
        case Undo() | Cancel():
            assert command in (UNDO, CANCEL)
        case "version":
            assert (command, parameters[0]) in ((512, 148), (520, 1))
        case Refusal(kind, reason):
            assert reason
            assert kind in ("other", "unsupported")
            assert (kind != "unsupported") == (
                command in (CALIBRATE, PREFLIGHT)
                or (command == 512 and not (parameters[0] >= 0 and math.fmod(parameters[0], 1) == 0
                                            and parameters[0] < 2**24))
            )  # fmt: skip


@settings(max_examples=50)
@given(st.lists(st.binary(max_size=60), max_size=30), st.integers(0, 2**32))
def test_garbage_between_the_packets_does_no_harm(garbage: list[bytes], seed: int) -> None:
    async def main() -> None:
        dice = random.Random(seed)
        async with bench() as b:
            b.service.takes_s = 0.5
            for noise in garbage:
                b.link.receive(noise, asyncio.get_running_loop().time())
                if dice.random() < 0.3:
                    b.ground.command(dice.choice(COMMANDS), 1)
                await asyncio.sleep(0.2)
            # What follows enough quiet bytes is understood again: no false frame is longer than 280 bytes.
            b.link.receive(bytes(300), asyncio.get_running_loop().time())
            await asyncio.sleep(1)
            before = len(b.ground.finals(CANCEL))
            b.ground.command(CANCEL)
            await asyncio.sleep(0.1)
            assert len(b.ground.finals(CANCEL)) == before + 1

    run_virtual(main())
