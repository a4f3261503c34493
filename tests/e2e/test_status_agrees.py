"""All lines of one status tell the same moment, and the figures that the records have."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from companion.daemon.calibrating import manager
from companion.daemon.calibrating.manager import Precondition
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
        calibrations = rig.service.calibrating.manager
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 120.0)
        await rig.until(lambda: calibrations.running is None, 120.0)
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
        assert calibrations.state is not State.IDLE
        assert found == set()


@pytest.mark.parametrize("at_arm", ["gate", "warn", "off"])
async def test_a_silent_sensor_is_the_first_reason_everywhere(tmp_path: Path, at_arm: str) -> None:
    """Without a gate too, and if nothing calibrates by itself: a calibration would be refused. At first it waits."""
    rig = Rig(tmp_path, at_arm=at_arm, **QUICK)
    rig.unplugged.add("gradienter")
    async with rig.running():
        await rig.ready()
        assert rig.service.arming.readiness.judge(rig.now_s).verdict == "wait"
        assert rig.service.status()["headline"]["word"] == "WAIT"
        await rig.until(lambda: rig.service.arming.readiness.judge(rig.now_s).verdict == "refuse", 30.0)
        await asyncio.sleep(10.0)
        assert "gradienter" in rig.service.arming.readiness.judge(rig.now_s).words
        assert "gradienter" in rig.service.status()["headline"]["reason"]


async def test_headline_gate_and_requests_follow_one_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ladder = {
        Precondition.STORAGE: ("FAULT", "storage"),
        Precondition.ONE_AUTOPILOT: ("TWO AUTOPILOTS", "conflict"),
        Precondition.ARM_STATE_KNOWN: ("NO AUTOPILOT", "no heartbeat"),
        Precondition.ONE_COMPANION: ("TWO COMPANIONS", "second companion"),
        Precondition.RESTORED: ("RESTORING", "restoring"),
    }
    async with Rig(tmp_path, at_arm="gate", **QUICK).running() as rig:
        await rig.ready()
        for count, (first, (word, words)) in enumerate(ladder.items()):
            unmet = [(one, ladder[one][1]) for one in list(ladder)[count:]]
            monkeypatch.setattr(manager, "blocked", lambda *_, unmet=unmet: iter(unmet))
            assert rig.service.calibrating.manager.blocking_reason() == (first, words)
            assert words in rig.service.arming.readiness.judge(rig.now_s).words
            assert rig.service.status()["headline"]["word"] == word
