"""The whole table of PX4's arm authorisation (autopilots 5.2, 9.2)."""

from __future__ import annotations

import asyncio

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.station import Station
from tests.support.px4_stage import ARM, PX4Stage, now_s

ASK = mavlink.MAV_CMD_ARM_AUTHORIZATION_REQUEST
ON = {"COM_ARM_AUTH_REQ": 1, "COM_ARM_AUTH_ID": 1}


def requests(station: Station) -> list[tuple[float, mavlink.MAVLink_command_long_message]]:
    return [(t, m) for t, m in station.timed(mavlink.MAVLink_command_long_message) if m.command == ASK]


def firsts(station: Station) -> list[float]:
    return [t_s for t_s, message in requests(station) if message.confirmation == 0]


class Authorizer:
    """Answers every request 100 ms later with what it is told."""

    def __init__(
        self,
        stage: PX4Stage,
        result: int,
        *,
        station: Station | None = None,
        progress: int = 0,
        param2: int = 5,
        target: tuple[int, int] = (1, 1),
        after_s: float = 0.1,
    ) -> None:
        self.station = station or stage.companion
        self.result, self.progress, self.param2, self.target, self.after_s = result, progress, param2, target, after_s
        self.answers = 0
        self._seen = 0
        self._task = asyncio.create_task(self._watch())

    def stop(self) -> None:
        self._task.cancel()

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(0.005)
            new = [m for _, m in requests(self.station) if m.confirmation == 0][self._seen :]
            for _ in new:
                self._seen += 1
                asyncio.get_running_loop().call_later(self.after_s, self.answer)

    def answer(self) -> None:
        self.answers += 1
        self.station.send(
            mavlink.MAVLink_command_ack_message(ASK, self.result, self.progress, self.param2, *self.target)
        )


async def arm(stage: PX4Stage, *, force: float = 0.0) -> tuple[int, float]:
    """Result of an arm command from the ground and the time it took."""
    begun_s = now_s()
    result = await stage.ground.command(ARM, 1, force, wait_s=10.0)
    return result, now_s() - begun_s


async def test_no_answer_denies_after_two_timeouts_with_two_requests() -> None:
    async with PX4Stage(parameters=ON) as stage:
        result, took_s = await arm(stage)
        assert result == 1
        assert took_s == pytest.approx(2.05, abs=0.07)
        first, second = firsts(stage.companion)
        assert second - first == pytest.approx(1.0, abs=0.01)
        await asyncio.sleep(1.0)
        texts = stage.ground.texts()
        assert [text for text in texts if text.startswith("Arm auth")] == ["Arm auth: No response"] * 2
        assert "".join(texts).endswith("Arming denied: Resolve system health failures first\t")
        assert texts[-2:] == ["Arming denied: Resolve system health failures firs", "t\t"]
        assert stage.double.authorization.requests == 2


@pytest.mark.parametrize(
    ("result", "progress", "text"),
    [
        (2, 0, "Arm auth: Denied"),
        (2, 1, None),
        (2, 2, "Arm auth: Denied, waypoint 7 have a invalid value"),
        (2, 3, "Arm auth: Denied by timeout in authorizer"),
        (2, 4, "Arm auth: Denied because airspace is in use"),
        (2, 5, "Arm auth: Denied because of bad weather"),
        (1, 0, "Arm auth: Temporarily rejected"),
        (3, 0, "Arm auth: Denied"),
        (4, 0, "Arm auth: Denied"),
    ],
)
async def test_a_denial_denies_and_says_the_reason_in_progress(result: int, progress: int, text: str | None) -> None:
    async with PX4Stage(parameters=ON) as stage:
        authorizer = Authorizer(stage, result, progress=progress, param2=7)
        acknowledged, took_s = await arm(stage)
        assert acknowledged == 1
        assert 0.1 < took_s < 0.3  # 110 to 220 ms in the real one
        assert not stage.double.armed
        await asyncio.sleep(0.5)
        said = [said for said in stage.ground.texts() if said.startswith("Arm auth")]
        assert said == ([] if text is None else [text[:50]] * 2)
        assert authorizer.answers == 2  # both requests of the attempt
        authorizer.stop()


@pytest.mark.parametrize(("accepted_s", "armed"), [(0.6, True), (1.6, True), (2.4, False)])
async def test_in_progress_does_not_extend_the_time_out(accepted_s: float, armed: bool) -> None:
    async with PX4Stage(parameters=ON) as stage:
        working = Authorizer(stage, mavlink.MAV_RESULT_IN_PROGRESS, after_s=0.02)
        loop = asyncio.get_running_loop()
        done = Authorizer(stage, mavlink.MAV_RESULT_ACCEPTED, after_s=100.0)
        loop.call_later(accepted_s, done.answer)
        result, _ = await arm(stage)
        assert (result == 0) is armed
        working.stop()
        done.stop()
