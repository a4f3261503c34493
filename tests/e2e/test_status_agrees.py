"""All lines of one status tell the same moment, and the figures that the records have."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from companion.estimation.machine import State
from sim.imu_model import DEG_H as SIM_DEG_H
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig

QUICK: dict[str, Any] = {"min_still_s": 4.0, "max_s": 8.0}


def contradictions(rig: Rig) -> list[str]:
    """Contradictions between the headline and the line about arming."""
    status = rig.service.status()
    headline, arming, vehicle = status["headline"], status["arming"], status["vehicle"]
    found = []
    if (headline["word"] == "READY") is not (arming["verdict"] == "accept") and status["progress"] is None:
        found.append(f"{headline} beside {arming['verdict']}, {arming['words']}")
    if "no heartbeat" in f"{headline['reason']} {arming['words']}" and vehicle["armed"] == "disarmed":
        found.append(f"{headline}, {arming['words']} above {vehicle['summary']}")
    if "its offsets" in arming["words"] and arming["state"] != "uncalibrated":
        found.append(f"{arming['state']} while offsets are unknown: {arming['words']}")
    return found


async def test_headline_and_arming_say_the_same_at_every_moment(tmp_path: Path) -> None:
    """Through calibrations, a failed one, a lost link and a restart of the autopilot, looked at a hundred times a
    second."""

    async with Rig(tmp_path, at_arm="gate", **QUICK).running() as rig:
        found: set[str] = set()

        async def look() -> None:
            while True:
                found.update(contradictions(rig))
                await asyncio.sleep(0.01)

        looking = asyncio.create_task(look())
        manager = rig.service.calibrating.manager
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 120.0)
        await rig.until(lambda: manager.running is None, 120.0)
        rig.double.faults.echo_without_effect = True
        rig.model.turn_on([2000.0 * SIM_DEG_H, 0.0, 0.0], [0.0, 0.0, 0.0])
        await calibrated(rig)
        rig.double.faults.echo_without_effect = False
        rig.wire.cut = True
        await asyncio.sleep(4.0)
        rig.wire.cut = False
        await asyncio.sleep(4.0)
        rig.double.reboot()
        await asyncio.sleep(6.0)
        looking.cancel()
        assert manager.state is not State.IDLE
        assert found == set()
