"""A real firmware whose compass has iron: turned on a slope, judged by the heading of its telemetry all round."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose
from sim.earth import Array
from sim.hands import AHEAD_S
from sim.scenario import demo
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.compasses import NAMES, add_iron
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import SETTLE_S, ground_station
from tests.sitl.craft import BINARIES, missing
from tests.sitl.test_by_hand import ByHandBench

pytestmark = pytest.mark.real_clock

KINDS = {"ardupilot-sitl": "ardupilot", "px4-sitl": "px4"}
MESSAGES: dict[str, Any] = {
    "ardupilot-sitl": mavlink.MAVLink_raw_imu_message,
    "px4-sitl": mavlink.MAVLink_highres_imu_message,
}
LEFT_DEG = 1.0
STEPS = 8


async def heading_errors_deg(bench: ByHandBench, kind: str) -> Array:
    """Error of the tilt-compensated heading of the telemetry, at eight headings."""
    declination, errors = math.radians(bench.vehicle.aircraft.site.declination_deg), []
    for _ in range(STEPS):
        await bench.stand(bench.hands.turn(bench.vehicle.now_s + AHEAD_S, 360.0 / STEPS))
        await bench.ground.stream(MESSAGES[kind].id, 20.0)
        seen: list[Any] = await bench.ground.collect(MESSAGES[kind], 2.0)
        field = np.mean([(one.xmag, one.ymag, one.zmag) for one in seen], axis=0)
        body = bench.vehicle.aircraft.body_from_ned(bench.vehicle.now_s)
        north, east, _ = body.T @ field
        errors.append(math.remainder(math.atan2(east, north) - declination, math.tau))
    return np.asarray(np.degrees(-np.array(errors)))


@pytest.mark.sitl
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("way", ["--headings=4", "--sides"])
async def test_iron_is_gone_after_an_alignment_and_back_after_undo(kind: str, way: str, tmp_path: Path) -> None:
    """150 mG of hard iron and soft iron of 5 %, on a slope of 5 deg."""
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    scenario = demo(pose=Pose(4.0, -3.0, 40.0), unix_s=time.time())
    what = Path(os.environ[BINARIES[kind]]), scenario, tmp_path / "firmware"
    vehicle = Px4Sitl(*what) if kind == "px4-sitl" else ArduPilotSitl(*what)
    async with vehicle, ground_station(vehicle) as ground:
        await add_iron(vehicle, ground)
        await vehicle.sleep(SETTLE_S)
        bench = ByHandBench(vehicle, ground, tmp_path)
        names = [name for each in NAMES[KINDS[kind]] for name in each]
        for each, value in zip(NAMES[KINDS[kind]], (0.0, 1.0, 0.0), strict=True):
            await ground.put_all(dict.fromkeys(each, value))
        old = await bench.values(names)
        await bench.type("setup", "--yes", "--udp", vehicle.url.rsplit(":", 1)[1])
        async with bench.companion as daemon:
            await daemon.ready()
            await bench.type("align", "faces", "--write")
            await bench.stand(bench.hands.back(vehicle.now_s + AHEAD_S))
            await bench.type("align", "compass", way, "--write")
            await bench.stand(bench.hands.back(vehicle.now_s + AHEAD_S))
            left = await heading_errors_deg(bench, kind)
            print(f"{kind}, {way}: left {left.round(2)} deg")
            assert np.sqrt(np.mean(np.square(left))) < LEFT_DEG, left
            assert " deg, aligned 20" in await bench.type("status")
            await bench.type("undo")
        assert await bench.values(names) == old
