"""The instant of arming: PX4 asks, ArduPilot's script listens, people are told why (autopilots 5 and 9.2)."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config.sections import AtArm
from sim.firmware.faults import Faults
from sim.motions import Handling
from tests.support.component import Ground
from tests.support.rig import Rig
from tests.support.wire import Wire

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
AUTHORISED_BY_US = {"COM_ARM_AUTH_REQ": 1.0, "COM_ARM_AUTH_ID": 1.0}


def px4(folder: Path, at_arm: AtArm = "gate", **parameters: float) -> Rig:
    return Rig(folder, firmware="px4", at_arm=at_arm, max_s=15.0, parameters={**AUTHORISED_BY_US, **parameters})


async def ready(rig: Rig) -> None:
    await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 100.0)


async def try_to_arm(rig: Rig, force: float = 0.0) -> int:
    """The result of an arm command of the ground station; 3 s later, so that all words have come."""
    before = len(rig.ground.acks(ARM))
    rig.ground.command(ARM, 1.0, force, target=(1, 1))
    await rig.until(lambda: len(rig.ground.acks(ARM)) > before, 10.0)
    await asyncio.sleep(3.0)
    return rig.ground.acks(ARM)[-1]


def armed(rig: Rig) -> bool:
    return rig.px4.armed


def texts(rig: Rig) -> str:
    return " | ".join(rig.ground.texts())


async def test_px4_arms_with_a_fresh_calibration_and_refuses_without_with_the_reason_on_the_ground_station(
    tmp_path: Path,
) -> None:
    async with px4(tmp_path).running() as rig:
        await rig.until(lambda: rig.service.arming.in_force.reading() is None, 20.0)
        await asyncio.sleep(2.0)
        assert await try_to_arm(rig) == 1
        assert not armed(rig)
        assert "Arm auth: Temporarily rejected" in texts(rig)
        assert "Not armed: hold still" in texts(rig)
        assert texts(rig).count("Not armed") == 1  # both requests of the attempt were answered, people told once
        await ready(rig)
        assert await try_to_arm(rig) == 0
        assert armed(rig)
        assert "Armed: calibrated" in texts(rig)


async def test_after_a_large_accelerometer_step_px4_has_to_be_rebooted_before_the_gate_opens(tmp_path: Path) -> None:
    """EKF2 keeps the tilt from the wrong offsets (autopilots 9.3)."""

    async with px4(tmp_path, CAL_ACC0_XOFF=0.3).running() as rig:
        readiness = rig.service.arming.readiness
        await rig.until(lambda: readiness.answer().words.startswith("reboot PX4"), 100.0)
        assert float(np.degrees(np.hypot(*rig.px4.vehicle_imus[0].estimator.tilt_error_rad))) > 0.3
        assert await try_to_arm(rig) == 1
        assert re.search(r"Not armed: reboot PX4: tilt 1\.\d deg off", texts(rig))
        assert all(len(words) <= 50 for words in rig.ground.texts() if "reboot" in words)
        rig.px4.reboot()
        await rig.until(lambda: rig.service.core.vehicle.boots == 1, 20.0)
        await ready(rig)
        assert await try_to_arm(rig) == 0


async def test_a_loop_that_stands_still_closes_the_gate(tmp_path: Path) -> None:
    async with px4(tmp_path).running() as rig:
        await ready(rig)
        rig.service.arming.readiness.update = lambda: None  # type: ignore[method-assign]
        await asyncio.sleep(2.0)
        assert rig.service.arming.readiness.answer().verdict == "wait"
        assert await try_to_arm(rig) == 1


async def test_moving_the_aircraft_closes_the_gate_and_two_seconds_of_rest_open_it(tmp_path: Path) -> None:
    async with px4(tmp_path).running() as rig:
        await ready(rig)
        begin_s = rig.now_s
        rig.aircraft.add(Handling(start_s=rig.aircraft.time_at(begin_s), duration_s=6.0, seed=3))
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict != "accept", 3.0)
        assert await try_to_arm(rig) == 1
        assert "Not armed: hold still" in texts(rig)
        await rig.until(lambda: rig.now_s > begin_s + 6.0, 10.0)
        await ready(rig)
        assert rig.now_s - begin_s < 6.0 + 6.0
        assert await try_to_arm(rig) == 0


async def test_warn_lets_it_arm_and_says_in_which_state(tmp_path: Path) -> None:
    async with px4(tmp_path, "warn").running() as rig:
        await rig.until(lambda: rig.service.arming.in_force.reading() is None, 20.0)
        await asyncio.sleep(1.0)
        assert await try_to_arm(rig) == 0
        assert armed(rig)
        assert "Arming uncalibrated: not calibrated yet" in texts(rig)
        assert "Armed UNCALIBRATED: not calibrated yet" in texts(rig)


async def test_a_dead_gradienter_is_a_fault_that_denies_and_is_named(tmp_path: Path) -> None:
    async with px4(tmp_path).running() as rig:
        await ready(rig)
        rig.unplugged.add("gradienter")
        await asyncio.sleep(5.0)
        assert await try_to_arm(rig) == 1
        assert "Not armed: no data from gradienter for" in texts(rig)
        assert "Arm auth: Denied" not in texts(rig)  # reason 1: the companion has said it


async def test_what_was_in_force_at_arming_is_kept_and_shown_with_its_record(tmp_path: Path) -> None:
    async with px4(tmp_path, "warn").running() as rig:
        await rig.until(lambda: rig.service.core.vehicle.system_id == 1, 20.0)
        rig.px4.arm()
        await rig.until(lambda: rig.service.arming.armings.last is not None, 5.0)
        rig.px4.disarm()
        await rig.until(lambda: len(rig.service.calibrating.store.history()) == 1, 100.0)
        await asyncio.sleep(90.0)
        rig.px4.arm()
        await asyncio.sleep(1.5)
        history: dict[str, Any] = {}
        async for reply in rig.service.faces.answer({"command": "history"}):
            history = reply
    (record,) = history["records"]
    last, first = history["armings"]
    assert list(record["armings"]) == [last]
    assert (last["state"], last["calibration"]) == ("calibrated", record["started_at"])
    assert 80.0 < last["calibrated_ago_s"] < 100.0
    assert last["gyro_sigma_use_rad_s"] == max(record["imus"][0]["gyro_sigma_use_rad_s"])
    assert last["accel_sigma_use_m_s2"] == max(record["imus"][0]["accel_sigma_use_m_s2"])
    assert (first["state"], first["calibration"], first["calibrated_ago_s"]) == ("uncalibrated", None, None)
    assert "autopilot" in first["reason"] or "not calibrated yet" in first["reason"] or "imu fc" in first["reason"]


def tunnelled(rig: Rig, since_s: float) -> list[bytes]:
    return [
        bytes(message.payload[: message.payload_length])
        for t_s, message in rig.spy.received  # type: ignore[attr-defined]
        if isinstance(message, mavlink.MAVLink_tunnel_message) and t_s >= since_s
    ]


def spied(rig: Rig) -> Ground:
    """Observe everything that the companion sends, including what ArduPilot does not forward."""
    spy = Ground()
    carry = Wire._carry

    def listen(wire: Wire, data: bytes, to: Any) -> None:
        if to is rig.autopilot and not wire.cut and wire is rig.wire:
            spy.receive(data, rig.now_s)
        carry(wire, data, to)

    rig.wire._carry = listen.__get__(rig.wire)  # type: ignore[method-assign]
    rig.spy = spy  # type: ignore[attr-defined]
    return spy


async def test_ardupilots_script_hears_the_verdict_only_while_it_gates(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate").running() as rig:
        spied(rig)
        await ready(rig)
        since_s = rig.now_s
        await asyncio.sleep(10.0)
        heard = tunnelled(rig, since_s)
        assert 19 <= len(heard) <= 21
        assert {payload[:6] for payload in heard} == {b"CMPA\x01\x01"}
        rig.aircraft.add(Handling(start_s=rig.aircraft.time_at(rig.now_s), duration_s=5.0, seed=3))
        await asyncio.sleep(4.0)
        assert tunnelled(rig, rig.now_s - 0.6)[-1].startswith(b"CMPA\x01\x00hold still")
        # A pilot who switches the gate off at the flight line is let go.
        rig.service.core.wanted.switch(at_arm="warn")
        await asyncio.sleep(1.0)
        assert tunnelled(rig, rig.now_s - 0.6)[-1][5] == 3


def refuses_one(faults: Faults) -> None:
    faults.refuse = {"INS_GYROFFS_Z"}


def has_no_effect(faults: Faults) -> None:
    faults.echo_without_effect = True


@pytest.mark.parametrize("fault", [refuses_one, has_no_effect])
async def test_a_write_that_is_rolled_back_leaves_the_gate_shut(
    tmp_path: Path, fault: Callable[[Faults], None]
) -> None:
    async with Rig(tmp_path, at_arm="gate", max_s=12.0).running() as rig:
        fault(rig.double.faults)
        await rig.until(lambda: rig.service.calibrating.manager.state.is_writing, 100.0)
        for _ in range(200):
            await asyncio.sleep(0.25)
            assert rig.service.arming.readiness.answer().verdict != "accept"
        assert rig.service.calibrating.store.history()[0].state == "failed"


async def test_a_second_autopilot_with_our_system_id_shuts_the_gate(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", max_s=12.0).running() as rig:
        await rig.ready()
        other = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for _ in range(20):
            beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
            rig.wire.carry_from_other(beat.pack(other))
            await asyncio.sleep(1.0)
        answer = rig.service.arming.readiness.answer()
        assert (answer.verdict, answer.words) == ("refuse", "two autopilots have system id 1")
        assert rig.double.writes == []


async def test_a_px4_that_does_not_ask_is_found_and_what_to_set_is_said(tmp_path: Path) -> None:
    async with px4(tmp_path, COM_ARM_AUTH_REQ=0.0).running() as rig:
        await rig.until(lambda: rig.service.arming.gate_setup.known, 30.0)
        assert rig.service.arming.gate_setup.problem == "set COM_ARM_AUTH_REQ 1"
        await rig.until(lambda: "NO GATE" in texts(rig), 5.0)
