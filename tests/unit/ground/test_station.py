"""Answers to people on the ground for every end of a request: the real component, and no MAVSDK."""

from __future__ import annotations

import asyncio
from typing import cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.statustext import Severity, Weight
from companion.errors import ConfigError, NobodyHeardError
from companion.estimation.machine import What
from companion.ground.heard import Address
from companion.ground.link import GroundLink
from companion.ground.station import Display, Station
from tests.support.component import ComponentBench, bench
from tests.support.ground_wire import StationOnTheWire, is_final


class Notes:
    def __init__(self) -> None:
        self.stages: list[str] = []
        self.texts: list[str] = []

    def progress(self, percent: int, text: str) -> None:
        if self.stages[-1:] != [text]:
            self.stages.append(text)

    def text(self, text: str) -> None:
        self.texts.append(text)


def station_on(wire: StationOnTheWire, notes: Notes | None = None) -> Station:
    # As much of a GroundLink as a station uses.
    return Station(cast("GroundLink", wire), "udpin:0.0.0.0:14550", cast("Display", notes or Notes()))


def beat(wire: StationOnTheWire, system_id: int, component_id: int, kind: int, autopilot: int) -> None:
    fields = {"type": kind, "autopilot": autopilot, "base_mode": 0, "system_status": mavlink.MAV_STATE_STANDBY}
    wire.heard.update("HEARTBEAT", Address(system_id, component_id), fields, asyncio.get_running_loop().time())


async def until_started(b: ComponentBench, jobs: int = 1) -> None:
    while len(b.service.started) < jobs:
        await asyncio.sleep(0.05)


async def test_it_says_what_it_waits_for_and_how_it_ends() -> None:
    wire, notes = StationOnTheWire(), Notes()
    wire.values = {"CMP_GYR_SIG": 2.5, "CMP_ACC_SIG": 0.0}
    async with bench(ground=wire) as b:
        station = station_on(wire, notes)
        await station.find(None, 5.0)
        asking = asyncio.create_task(station.calibrate(What.BOTH, None, reboot=False))
        await until_started(b)
        b.texts.say(Severity.INFO, "Hold still: gyro moves 0.31 deg/s, max 0.10")
        await asyncio.sleep(1.0)
        for percent in (75, 85):
            b.service.jobs[0].progress_percent = percent
            await asyncio.sleep(1.0)
        b.texts.say(Severity.WARNING, "Before flight: reboot PX4: tilt 1.2 deg off", Weight.RESULT)
        b.texts.say(Severity.NOTICE, "Calibration done: sigma 2.5 deg/h", Weight.RESULT)
        b.service.jobs[0].finish("done")
        outcome = await asking
        assert (outcome.state, outcome.reason, outcome.good) == ("done", "sigma 2.5 deg/h", True)
        assert outcome.lines[0].startswith("DONE after")
        assert "warning: Before flight: reboot PX4: tilt 1.2 deg off" in outcome.lines
        assert outcome.answer["gyro_sigma_deg_h"] == 2.5
        assert outcome.answer["accel_sigma_mg"] is None, "0 is how the companion says that it has none"
        assert "Hold still: gyro moves 0.31 deg/s, max 0.10" in notes.texts
        assert notes.stages[-2:] == ["writing to the autopilot", "checking that the autopilot uses the new values"]


async def test_a_refusal_of_somebody_elses_request_is_not_taken_for_ours() -> None:
    wire = StationOnTheWire()
    async with bench(ground=wire) as b:
        station = station_on(wire)
        await station.find(1, 5.0)
        asking = asyncio.create_task(station.calibrate(What.GYROS, None, reboot=False))
        await until_started(b)
        b.texts.say(Severity.WARNING, "Calibration refused: a calibration is running", Weight.REFUSAL)
        await asyncio.sleep(1.0)
        b.texts.say(Severity.ERROR, "Calibration failed: the aircraft moved", Weight.RESULT)
        b.service.jobs[0].finish("failed")
        outcome = await asking
        assert (outcome.state, outcome.reason, outcome.good) == (
            "failed",
            "Calibration failed: the aircraft moved",
            False,
        )


@pytest.mark.parametrize(
    ("value", "words"),
    [(3.0, "last calibration: cancelled"), (0.0, "has it restarted?"), (None, "has it restarted?")],
)
async def test_an_end_that_was_not_heard_is_no_success(value: float | None, words: str) -> None:
    wire = StationOnTheWire()
    wire.deaf_to = is_final
    if value is not None:
        wire.values["CMP_STATE"] = value
    async with bench(ground=wire) as b:
        b.service.takes_s = 2.0
        b.service.mav_state = mavlink.MAV_STATE_STANDBY
        station = station_on(wire)
        await station.find(1, 5.0)
        outcome = await station.calibrate(What.BOTH, None, reboot=False)
        assert (outcome.state, outcome.good) == ("lost", False)
        assert words in outcome.reason


@pytest.mark.parametrize(
    ("autopilot", "words"), [(False, "companion ground status"), (True, "restores the old values")]
)
async def test_a_companion_that_is_gone_is_given_up_with_words(autopilot: bool, words: str) -> None:
    wire, notes = StationOnTheWire(), Notes()
    async with bench(ground=wire) as b:
        station = station_on(wire, notes)
        await station.find(1, 5.0)
        asking = asyncio.create_task(station.calibrate(What.BOTH, None, reboot=False))
        await until_started(b)
        b.wire.cut = True
        while not asking.done():
            if autopilot:
                beat(wire, 1, 1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4)
            await asyncio.sleep(1.0)
        outcome = await asking
        assert (outcome.state, outcome.good) == ("lost", False)
        assert words in outcome.reason
        assert "nothing heard for 10 s" in notes.stages


async def test_a_one_way_link_is_named() -> None:
    wire = StationOnTheWire()
    async with bench(ground=wire) as b:
        station = station_on(wire)
        await station.find(1, 5.0)
        b.wire.cut = True
        with pytest.raises(NobodyHeardError, match="component 191 of system 1 beats, but does not answer"):
            await station.undo()


async def test_with_two_vehicles_on_the_link_nobody_guesses() -> None:
    for chosen in (None, 2):
        wire = StationOnTheWire()
        for system_id in (1, 2):
            beat(wire, system_id, 191, mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
            beat(wire, system_id, 1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4)
        station = station_on(wire)
        if chosen is None:
            with pytest.raises(ConfigError, match="systems 1, 2 are heard: say which with --system N"):
                await station.find(chosen, 5.0)
        else:
            await station.find(chosen, 5.0)
            assert station.vehicle.system_id == chosen
