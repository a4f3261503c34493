"""The firmware's own gyro calibration as it is watched from outside; the whole of it is in tests/e2e."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.gyro_calibration import TIMEOUT_S, calibrate
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import ArmState
from companion.errors import NotDisarmedError
from tests.support.virtual_time import run_virtual

OFFSETS = {f"INS_GYROFFS_{axis}": 0.01 for axis in "XYZ"}


class _Autopilot:
    """Answers everything at once; its gyro offsets stay at zero, as if its calibration never ended."""

    name = "ArduPilot, system 1"
    boots = 1

    def __init__(self, result: int, arm_state: ArmState = ArmState.DISARMED) -> None:
        self.vehicle = self.commands = self.disarmed = self
        self.result, self.arm_state = result, arm_state
        self.looks = self.sent = 0

    def require_same_boot(self, boots: int, doing: str) -> None:
        assert boots == self.boots, doing

    async def ensure(self) -> None:
        if self.arm_state is not ArmState.DISARMED:
            raise NotDisarmedError(self.arm_state.why_not_written)

    def send(self, command: int, *parameters: float, timeout_s: float) -> asyncio.Future[int | None]:
        self.sent += 1
        answer: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()
        answer.set_result(self.result)
        return answer

    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]:
        self.looks += 1
        return dict.fromkeys(names, 0.0)


@pytest.mark.parametrize("result", [mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED])
def test_offsets_that_stay_at_zero_after_the_answer_are_looked_at_four_times_a_second(result: int) -> None:
    autopilot = _Autopilot(result)

    async def main() -> float:
        began_s = asyncio.get_running_loop().time()
        await calibrate(cast("ParameterClient", autopilot), OFFSETS, lambda words: None)
        return asyncio.get_running_loop().time() - began_s

    assert TIMEOUT_S <= run_virtual(main()) < TIMEOUT_S + 2.0
    assert autopilot.looks <= 4.0 * TIMEOUT_S + 10


@pytest.mark.parametrize("arm_state", [ArmState.ARMED, ArmState.UNKNOWN])
def test_it_is_not_asked_for_unless_the_aircraft_is_surely_disarmed(arm_state: ArmState) -> None:
    autopilot = _Autopilot(mavlink.MAV_RESULT_ACCEPTED, arm_state)
    with pytest.raises(NotDisarmedError, match=r"did not run: .*armed"):
        run_virtual(calibrate(cast("ParameterClient", autopilot), OFFSETS, lambda words: None))
    assert autopilot.sent == 0
