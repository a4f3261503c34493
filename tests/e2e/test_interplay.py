"""Two events at the same moment: EKF settling and a reboot, a countdown and a write."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import Refusal
from companion.estimation.machine import State
from companion.estimation.records.validity import Why
from companion.estimation.request import What
from sim.ardupilot.double import offset_names
from sim.imu_model import DEG_H
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

QUICK: dict[str, Any] = {"min_still_s": 4.0, "max_s": 8.0, "feed_s": 0.2, "imu_rate_hz": 50.0, "at_arm": "gate"}
PX4_QUICK: dict[str, Any] = {
    **QUICK,
    "firmware": "px4",
    "part": "bmi088",
    "default_streams": False,
    "parameters": {"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0},
}
GYRO_Y = offset_names(1, "gyro")[1]


async def settling(rig: Rig) -> None:
    await rig.until(lambda: rig.service.calibrating.manager.state is State.SETTLING, 90.0)


def whys(rig: Rig) -> set[Why]:
    return {finding.why for finding in rig.service.arming.in_force.findings(rig.now_s)}


def test_a_boot_that_measures_the_gyros_while_the_ekf_settles_is_not_called_calibrated(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, parameters={"INS_GYR_CAL": 1.0}, **QUICK).running() as rig:
            await settling(rig)
            rig.autopilot.reboot()
            await rig.until(lambda: bool(rig.service.calibrating.store.history(1)), 60.0)
            (record,) = rig.service.calibrating.store.history(1)
            assert record.state == "failed"
            assert record.reason.startswith("the autopilot restarted and replaced INS_GYROFFS_X")
            assert record.imus[0].written[GYRO_Y].outcome == "failed"
            assert record.imus[0].written[offset_names(1, "accel")[0]].outcome == "verified"
            await asyncio.sleep(1.0)
            assert rig.service.arming.readiness.answer().verdict != "accept"
            assert rig.service.arming.readiness.state(rig.now_s)[0] == "uncalibrated"
            await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 200.0)
            # Either calibrated again, or what the boot has measured was seen to be good enough; it says which.
            again = rig.service.calibrating.store.history(1)[0].state == "done"
            words = rig.service.arming.readiness.answer().words
            assert words.startswith("calibrated" if again else "offsets checked"), words
            assert np.abs(rig.double.residual(1, rig.now_s).gyro_rad_s).max() < 30 * DEG_H

    run_virtual(main())


def test_what_another_station_writes_while_the_ekf_settles_shuts_the_gate_and_stays(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, **QUICK).running() as rig:
            await settling(rig)
            rig.double.write_as_another_station(GYRO_Y, 0.0123)
            await rig.until(lambda: bool(rig.service.calibrating.store.history(1)), 200.0)
            await asyncio.sleep(60.0)
            assert Why.CHANGED in whys(rig)
            assert rig.service.arming.readiness.answer().verdict == "refuse"
            assert "changed by someone else" in rig.service.arming.readiness.answer().words
            assert rig.double.parameter(GYRO_Y) == pytest.approx(0.0123)
            assert len(rig.service.calibrating.store.history()) == 1

    run_virtual(main())


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_the_gates_countdown_never_counts_up_and_is_kept(tmp_path: Path, firmware: Literal["ardupilot", "px4"]) -> None:
    async def main() -> None:
        async with Rig(tmp_path, **(QUICK if firmware == "ardupilot" else PX4_QUICK)).running() as rig:
            await rig.until(lambda: rig.service.arming.readiness.answer().words.startswith("hold still"), 10.0)
            began_s, said, counted, ends = rig.now_s, set(), [], []
            while (answer := rig.service.arming.readiness.answer()).verdict != "accept":
                assert rig.now_s < began_s + 90.0
                assert len(f"Not armed: {answer.words}") <= 50
                said.add(answer.words)
                seconds = re.search(r"(\d+) s", answer.words)
                if seconds and "at most" not in answer.words:
                    counted.append(int(seconds[1]))
                    ends.append(rig.now_s + float(seconds[1]))
                await asyncio.sleep(0.25)
            assert any("writing offsets" in words for words in said)
            assert any("checking new offsets" in words for words in said)
            assert counted == sorted(counted, reverse=True)
            # It may stand still for a moment, where what comes next is not known better.
            assert -4.0 < ends[0] - rig.now_s < 8.0

    run_virtual(main())


def other_autopilot(autopilot: int, *, armed: bool = False) -> bytes:
    """A heartbeat of another autopilot under the ids of ours."""
    data: bytes = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, autopilot, 128 if armed else 0, 0, mavlink.MAV_STATE_STANDBY, 3
    ).pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    return data


def test_a_second_autopilot_with_our_system_id_stops_everything_and_is_named(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, **QUICK).running() as rig:
            await rig.ready()
            for _ in range(40):
                rig.wire.carry_from_other(other_autopilot(mavlink.MAV_AUTOPILOT_PX4))
                await asyncio.sleep(1.0)
            assert rig.autopilot.writes == []
            assert rig.service.core.vehicle.firmware == "ardupilot"
            answer = rig.service.arming.readiness.answer()
            assert (answer.verdict, answer.words) == ("refuse", "two autopilots have system id 1")
            refusal = rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
            assert isinstance(refusal, Refusal)
            assert refusal.reason == "two autopilots have system id 1"
            # It goes away, and all goes on.
            await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 90.0)

    run_virtual(main())
