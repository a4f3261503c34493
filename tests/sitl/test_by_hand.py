"""A real firmware without any other sensor: held on all sides, turned on a slope, judged by its telemetry."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose
from sim.companion_process import CompanionProcess
from sim.earth import Array
from sim.hands import AHEAD_S, PLACEMENT_DEG, PROPPED_DEG, SIDES, Hands
from sim.imu_model import MG
from sim.scenario import demo
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.daemon import obeyed
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import SETTLE_S, ground_station, mean_reading
from sim.sitl.vehicle import SitlVehicle
from tests.sitl.craft import BINARIES, missing

pytestmark = pytest.mark.real_clock

LEVEL_MG, SCALE_PERCENT, LEVEL_DEG = 0.5, 0.03, 0.08
"""Limits for a part without profile: one sigma of its stands is 0.4 mg, though it is hundredths in fact."""
NAMES = {
    "ardupilot-sitl": [f"INS_ACC{what}_{axis}" for what in ("OFFS", "SCAL") for axis in "XYZ"],
    "px4-sitl": [f"CAL_ACC{slot}_{axis}{what}" for slot in (0, 1) for what in ("OFF", "SCALE") for axis in "XYZ"],
}
TRIM = {
    "ardupilot-sitl": ["AHRS_TRIM_X", "AHRS_TRIM_Y"],
    "px4-sitl": ["SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF"],
}
OBSERVED_S = 4.0
STILL_AFTER_S = 1.5
"""Time from the end of a movement until every filter has settled."""
STORED_S = 4.0
"""Time in which PX4 stores set values."""


class Accelerometer(NamedTuple):
    """Errors of an accelerometer's output in its own axes; `level_mg`: when level, up being -1 g on z."""

    level_mg: Array
    scale_percent: Array


class ByHandBench:
    """One firmware, hands that hold its aircraft, and a ground station that judges its telemetry by the truth."""

    def __init__(self, vehicle: SitlVehicle, ground: GroundStation, folder: Path) -> None:
        self.vehicle, self.ground = vehicle, ground
        self.hands = Hands(vehicle.aircraft, placement_deg=PLACEMENT_DEG, propped_deg=PROPPED_DEG, seed=1, takes_s=2.0)
        self.companion = CompanionProcess(folder)

    async def type(self, *words: str) -> str:
        return await obeyed(self.companion, self.hands, self.vehicle, *words)

    async def values(self, names: list[str]) -> list[float]:
        return [await self.ground.get(name) for name in names]

    async def stand(self, until_s: float) -> None:
        """Wait until it stands, in aircraft time, and a little longer."""
        await self.vehicle.sleep(max(until_s - self.vehicle.now_s, 0.0) + STILL_AFTER_S)

    async def judged(self) -> Accelerometer:
        """Fit output = A force + bias to telemetry and truth on six sides; the aircraft ends on its spot."""
        outputs, forces = [], []
        for pitch, roll in SIDES.values():
            await self.stand(self.hands.hold(self.vehicle.now_s + AHEAD_S, pitch, roll))
            begun_s = self.vehicle.now_s
            outputs.append((await mean_reading(self.vehicle, self.ground, 1, OBSERVED_S))[3:])
            forces.append(self.vehicle.aircraft.truth_at(begun_s).force_m_s2)
        await self.stand(self.hands.back(self.vehicle.now_s + AHEAD_S))
        both = np.column_stack([np.array(forces), np.ones(len(forces))])
        found, *_ = np.linalg.lstsq(both, np.array(outputs), rcond=None)
        scale_percent = 100.0 * (np.linalg.norm(found[:3], axis=0) - 1.0)
        return Accelerometer(found[3] / MG + np.array([0.0, 0.0, -10.0]) * scale_percent, scale_percent)

    async def attitude_error_deg(self) -> Array:
        """Roll and pitch of ATTITUDE after a restart, less the truth."""
        await self.vehicle.sleep(STORED_S)
        await self.vehicle.power_cycle()
        await self.vehicle.sleep(SETTLE_S)
        await self.ground.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 20.0)
        seen = await self.ground.collect(mavlink.MAVLink_attitude_message, OBSERVED_S)
        assert seen
        told_rad = np.mean([(message.roll, message.pitch) for message in seen], axis=0)
        off = told_rad - np.array(self.vehicle.aircraft.angles_rad(self.vehicle.now_s)[:2])
        return np.asarray(np.degrees((off + np.pi) % (2.0 * np.pi) - np.pi))


@pytest.mark.sitl
@pytest.mark.parametrize("kind", list(NAMES))
async def test_a_bare_board_is_right_after_stands_by_hand_and_as_it_was_after_undo(kind: str, tmp_path: Path) -> None:
    """20 mg, 0.5 %, a board that sits askew, a spot that slopes by 5 deg."""
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    scenario = demo(
        pose=Pose(4.0, -3.0, 40.0), unix_s=time.time(), accel_mg=(20.0, -20.0, 20.0),
        accel_scale=(0.005, -0.005, 0.005), board_deg=(0.8, -0.6),
    )  # fmt: skip
    what = Path(os.environ[BINARIES[kind]]), scenario, tmp_path / "firmware"
    vehicle = Px4Sitl(*what) if kind == "px4-sitl" else ArduPilotSitl(*what)
    async with vehicle, ground_station(vehicle) as ground:
        await vehicle.sleep(SETTLE_S)
        bench = ByHandBench(vehicle, ground, tmp_path)
        before, level = await bench.values(NAMES[kind]), await bench.values(TRIM[kind])
        await bench.type("setup", "--yes", "--udp", vehicle.url.rsplit(":", 1)[1])
        async with bench.companion as daemon:
            await daemon.ready()
            await bench.type("align", "faces", "--write")
            left = await bench.judged()
            assert np.abs(left.level_mg).max() < LEVEL_MG, left
            if kind == "px4-sitl":  # starts without scales that are within 1 % of 1
                await bench.type("undo")
                assert await bench.values(NAMES[kind]) == before
                await bench.type("align", "faces", "--write")
                await bench.stand(bench.hands.back(vehicle.now_s + AHEAD_S))
            else:
                assert np.abs(left.scale_percent).max() < SCALE_PERCENT, left
            written = await bench.values(NAMES[kind])
            await bench.type("align", "turn", "--level")
        assert np.abs(await bench.attitude_error_deg()).max() < LEVEL_DEG
        async with bench.companion as daemon:
            await daemon.ready()
            await bench.type("undo")
        assert await bench.values(TRIM[kind]) == level
        assert await bench.values(NAMES[kind]) == written
