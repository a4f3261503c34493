"""Arming and who may forbid it (autopilots 5, 9.1, 9.2)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.sitl.ground import GroundStation
from tests.sitl.craft import Autopilot, Craft

REQUEST = mavlink.MAV_CMD_ARM_AUTHORIZATION_REQUEST
COMMAND = mavlink.MAVLink_command_long_message
TEXT = mavlink.MAVLink_statustext_message
ACCEPTED, REJECTED, DENIED = (
    mavlink.MAV_RESULT_ACCEPTED,
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    mavlink.MAV_RESULT_DENIED,
)
CONTENT_S = 120.0
ACCEL = {"ardupilot": "INS_ACCOFFS_X", "px4": "CAL_ACC1_XOFF"}


def armed(craft: Craft) -> bool:
    return bool(craft.ground.vehicle_heartbeats()[-1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


async def disarm(craft: Craft) -> None:
    await craft.ground.arm(arm=False, force=True)
    await craft.heartbeats(2)
    assert not armed(craft)


def requests(station: GroundStation, since_s: float) -> list[COMMAND]:
    return [m for m in station.all(COMMAND, since_s=since_s) if m.command == REQUEST]


def reply(station: GroundStation, result: int, *, reason: int = 0, valid_s: int = 0, target: int | None = None) -> None:
    to = station.vehicle if target is None else target
    station.send(mavlink.MAVLink_command_ack_message(REQUEST, result, reason, valid_s, to, 1))


@asynccontextmanager
async def authorising(craft: Craft, method: int = 0) -> AsyncIterator[None]:
    """Arm authorisation by whoever has the vehicle's own system id."""
    names = ("COM_ARM_AUTH_REQ", "COM_ARM_AUTH_ID", "COM_ARM_AUTH_MET")
    async with craft.ground.restored(*names):
        await craft.ground.put_all(dict(zip(names, (1, craft.ground.vehicle, method), strict=True)))
        await asyncio.sleep(1.2)
        try:
            yield
        finally:
            await disarm(craft)
    await asyncio.sleep(1.2)


def test_it_arms_when_asked_and_disarms(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        # It may have just started, and how soon its estimator is content is the machine's affair.
        async with asyncio.timeout(CONTENT_S):
            while await craft.ground.arm() != ACCEPTED:
                await craft.heartbeats(2)
        await craft.heartbeats(2)
        assert armed(craft)
        await disarm(craft)

    autopilot.run(main)


def test_a_heartbeat_that_is_asked_for_is_there_30_ms_after_the_answer(autopilot: Autopilot) -> None:
    """The companion waits for it before each write, so that no other heartbeat stands for the autopilot's."""

    async def main(craft: Craft) -> None:
        loop, ground = asyncio.get_running_loop(), craft.ground
        late_s = []
        for _ in range(40):
            asked_s = loop.time()
            ground.send(
                mavlink.MAVLink_command_long_message(
                    ground.vehicle, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_HEARTBEAT, *[0.0] * 6
                )
            )
            await asyncio.sleep(0.3)
            answers = [
                t_s
                for t_s, answer in ground.timed(mavlink.MAVLink_command_ack_message, since_s=asked_s)
                if answer.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            ]
            beats = [
                t_s
                for t_s, beat in ground.timed(mavlink.MAVLink_heartbeat_message, since_s=asked_s)
                if beat.get_srcComponent() == 1
            ]
            assert answers
            assert beats
            late_s.append(beats[0] - answers[0])
        print(f"heartbeat behind the answer: {sorted(round(1e3 * each, 1) for each in late_s)} ms")
        # A busy machine may hold a process up now and then, which holds up its answer as well.
        assert sorted(late_s)[-4] <= 0.03

    autopilot.run(main)


def test_a_write_is_accepted_and_works_while_armed(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        name = ACCEL[craft.firmware]
        async with craft.ground.restored(name) as before:
            assert await craft.ground.arm() == ACCEPTED
            assert await craft.ground.put(name, before[name] + 0.1) == pytest.approx(before[name] + 0.1)
            await craft.heartbeats(2)
            assert armed(craft)
            await disarm(craft)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_ardupilot_asks_nobody_for_authorisation(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion:
            since_s = asyncio.get_running_loop().time()
            assert await craft.ground.arm() == ACCEPTED
            await asyncio.sleep(0.5)
            assert not requests(companion, since_s)
            assert not requests(craft.ground, since_s)
            await disarm(craft)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_the_authorisation_request_goes_to_the_system_in_com_arm_auth_id_on_all_links_with_all_params_zero(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft):
            since_s = asyncio.get_running_loop().time()
            begun_s = since_s
            assert await craft.ground.arm() == REJECTED
            took_s = asyncio.get_running_loop().time() - begun_s
            await asyncio.sleep(0.3)
            for station in (companion, craft.ground):
                seen = requests(station, since_s)
                assert len(seen) >= 2
                for request in seen:
                    assert (request.target_system, request.target_component) == (craft.ground.vehicle, 0)
                    assert (request.get_srcSystem(), request.get_srcComponent()) == (craft.ground.vehicle, 1)
                    assert not any(getattr(request, f"param{n}") for n in range(1, 8))
            assert 1.5 < took_s < 4.0  # two requests, COM_ARM_AUTH_TO each
            assert "Arm auth: No response" in craft.ground.texts_since(since_s)
            assert not armed(craft)

    autopilot.run(main)


async def answer_requests(station: GroundStation, result: int, **options: int) -> None:
    """Answer every request 20 ms after it came, until cancelled."""
    answered = 0
    since_s = asyncio.get_running_loop().time()
    while True:
        seen = len(requests(station, since_s))
        if seen > answered:
            await asyncio.sleep(0.02)
            reply(station, result, reason=options.get("reason", 0), valid_s=options.get("valid_s", 0),
                  target=options.get("target"))  # fmt: skip
            answered = seen
        await asyncio.sleep(0.005)


@asynccontextmanager
async def authoriser(station: GroundStation, result: int, **options: int) -> AsyncIterator[None]:
    task = asyncio.create_task(answer_requests(station, result, **options))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.only("px4")
def test_an_accepted_request_arms_and_needs_no_other_within_its_validity(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft):
            loop = asyncio.get_running_loop()
            async with authoriser(companion, ACCEPTED, valid_s=5):
                begun_s = loop.time()
                assert await craft.ground.arm() == ACCEPTED
                assert loop.time() - begun_s < 0.5
            await craft.ground.arm(arm=False, force=True)
            since_s = loop.time()
            assert await craft.ground.arm() == ACCEPTED
            assert not requests(companion, since_s)
            await asyncio.sleep(5.0)  # it would still hold for the test after this

    autopilot.run(main)


@pytest.mark.only("px4")
def test_the_two_step_method_denies_the_first_attempt_and_lets_the_second_pass(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with (
            craft.companion() as companion,
            authorising(craft, method=1),
            authoriser(companion, ACCEPTED, valid_s=5),
        ):
            loop = asyncio.get_running_loop()
            begun_s = loop.time()
            assert await craft.ground.arm() == REJECTED
            assert loop.time() - begun_s < 0.5
            await asyncio.sleep(1.0)
            assert await craft.ground.arm() == ACCEPTED
            await asyncio.sleep(5.0)  # it would still hold for the test after this

    autopilot.run(main)


@pytest.mark.only("px4")
def test_an_answer_before_any_request_is_ignored_by_px4(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft):
            reply(companion, ACCEPTED, valid_s=30)
            await asyncio.sleep(0.3)
            since_s = asyncio.get_running_loop().time()
            assert await craft.ground.arm() == REJECTED
            assert "No response" in craft.ground.texts_since(since_s)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_an_acceptance_that_is_not_addressed_to_the_vehicle_is_ignored(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft), authoriser(companion, ACCEPTED, target=0):
            since_s = asyncio.get_running_loop().time()
            assert await craft.ground.arm() == REJECTED
            assert "No response" in craft.ground.texts_since(since_s)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_a_denial_is_told_with_its_reason_and_force_does_not_get_around_it(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft):
            for force in (False, True):
                async with authoriser(companion, DENIED, reason=5):
                    since_s = asyncio.get_running_loop().time()
                    assert await craft.ground.arm(force=force) == REJECTED
                    await asyncio.sleep(0.2)
                    assert requests(companion, since_s)
                    assert "weather" in craft.ground.texts_since(since_s)
            assert not armed(craft)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_px4_sends_statustext_only_on_links_with_a_ground_station(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion, authorising(craft), authoriser(companion, DENIED):
            since_s = asyncio.get_running_loop().time()
            await craft.ground.arm()
            await asyncio.sleep(1.0)
            assert craft.ground.all(TEXT, since_s=since_s)
            assert companion.vehicle_heartbeats(since_s)
            assert not companion.all(TEXT, since_s=since_s)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_ardupilot_sends_statustext_on_every_link_that_has_spoken(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as companion:
            await asyncio.sleep(1.5)
            since_s = asyncio.get_running_loop().time()
            await craft.ground.stream(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 400.0)
            await asyncio.sleep(1.0)
            for station in (companion, craft.ground):
                assert "too fast" in station.texts_since(since_s)

    autopilot.run(main)
