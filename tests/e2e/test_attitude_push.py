"""Heading into the autopilot: the whole daemon on a virtual aircraft, and what the autopilot makes of what it sends."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.daemon.heading.attitude_service import AttitudeService
from companion.daemon.job import Job
from companion.estimation.machine import What
from sim.motions import Turn
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual
from tests.support.witness import WriteWitness

Vision = mavlink.MAVLink_vision_position_estimate_message
Firmware = Literal["ardupilot", "px4"]
USES_OURS: dict[str, dict[str, float]] = {
    "ardupilot": {"VISO_TYPE": 1, "EK3_SRC1_YAW": 6},
    "px4": {"EKF2_EV_CTRL": 8, "EKF2_EVA_NOISE": 0.05},
}
QUICK = {"min_still_s": 3.0, "max_s": 6.0}
"""Shortest calibration before the push: worse biases make it harder for the attitude, not easier."""


class Flight:
    def __init__(self, rig: Rig, witness: WriteWitness) -> None:
        self.rig, self.witness = rig, witness

    @property
    def attitude(self) -> AttitudeService:
        assert self.rig.service.heading.attitude is not None
        return self.rig.service.heading.attitude

    @property
    def true_yaw_rad(self) -> float:
        return self.rig.aircraft.angles_rad(self.rig.aircraft.time_at(self.rig.now_s))[2]

    def theirs_deg(self) -> float:
        yaw = self.rig.autopilot.estimated_angles_rad(self.rig.now_s)[2]
        return math.degrees(abs(math.remainder(yaw - self.true_yaw_rad, 2.0 * math.pi)))

    def turn(self, **angles_deg: float) -> None:
        """Begin a turn now that takes 3 s."""
        start_s = self.rig.aircraft.time_at(self.rig.now_s) + 0.2
        self.rig.aircraft.add(Turn(start_s=start_s, duration_s=3.0, **angles_deg))

    async def sleep(self, seconds: float) -> None:
        end_s = self.rig.now_s + seconds
        await self.rig.until(lambda: self.rig.now_s >= end_s, seconds + 1.0)

    async def calibrate(self) -> None:
        job = self.rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(job, Job)
        assert (await job.finished).outcome == "done"

    async def pushing(self, within_s: float = 30.0) -> None:
        await self.rig.until(lambda: self.attitude.health.pushing, within_s)


@asynccontextmanager
async def flight(
    folder: Path,
    *,
    firmware: Firmware = "ardupilot",
    mode: str = "yaw",
    rate_hz: float = 30.0,
    calibrated: bool = True,
    used: bool = True,
    **options: Any,
) -> AsyncIterator[Flight]:
    """A rig whose serial IMU carries the attitude, calibrated in a few seconds, pushing."""
    more = f'[push]\nattitude = "{mode}"\nattitude_rate_hz = {rate_hz}\n'
    parameters = (USES_OURS[firmware] if used else {}) | options.pop("parameters", {})
    options = {"own_imu": True, "feed_s": 0.01, "imu_rate_hz": 20.0, "imus": 1} | QUICK | options
    rig = Rig(folder, firmware=firmware, more=more, parameters=parameters, **options)
    witness = WriteWitness(rig)
    async with rig.running():
        await rig.ready()
        flying = Flight(rig, witness)
        if calibrated:
            await flying.calibrate()
            await flying.pushing()
        yield flying
        assert rig.link.received["handler error"] == 0


@pytest.mark.parametrize(("firmware", "own_imu"), [("ardupilot", False), ("px4", True)])
async def test_the_heading_follows_the_aircraft_through_a_turn(
    tmp_path: Path, firmware: Firmware, own_imu: bool
) -> None:
    """Within the compass' degree and the delay of the autopilot's own telemetry, on truth."""

    async with flight(tmp_path, firmware=firmware, own_imu=own_imu, imu_rate_hz=50.0) as flying:
        rig = flying.rig
        rig.autopilot.arm()
        flying.turn(heading_deg=110.0, roll_deg=20.0, pitch_deg=-10.0)
        await flying.sleep(8.0)
        yaw = flying.witness.of(Vision)[-1].yaw
        assert math.degrees(abs(math.remainder(yaw - flying.true_yaw_rad, 2.0 * math.pi))) < 2.0
        last = flying.witness.of(Vision)[-1]
        roll, pitch, _ = rig.aircraft.angles_rad(rig.aircraft.time_at(rig.now_s))
        assert (last.roll, last.pitch) == pytest.approx((roll, pitch), abs=math.radians(1.0))
        assert flying.theirs_deg() < 3.0


async def test_nothing_is_pushed_before_a_calibration_or_without_a_compass(tmp_path: Path) -> None:
    async with flight(tmp_path, calibrated=False) as flying:
        await flying.sleep(30.0)
        assert not flying.witness.of(Vision)
        assert flying.attitude.view()["why_not"] == "waiting for a calibration"
        flying.rig.unplugged.add("compass")
        await flying.sleep(10.0)
        assert not flying.witness.of(Vision)


async def test_the_push_stays_ended_while_the_daemon_finishes_a_write(tmp_path: Path) -> None:
    async with flight(tmp_path) as flying:
        flying.attitude.close()
        sent = len(flying.witness.of(Vision))
        await flying.sleep(12.0)
        assert len(flying.witness.of(Vision)) == sent


async def test_a_silent_imu_stops_the_push_at_once_and_says_so(tmp_path: Path) -> None:
    """In flight a second of silence is the end until the next landing; a short one is bridged."""

    async with flight(tmp_path) as flying:
        rig = flying.rig
        rig.autopilot.arm()
        await flying.sleep(1.0)
        rig.unplugged.add("own")
        silent_s = rig.now_s
        await flying.sleep(0.6)
        last_s = flying.witness.times(Vision)[-1]
        assert last_s < silent_s + 0.25
        assert not flying.attitude.health.pushing
        rig.unplugged.discard("own")
        await flying.pushing(5.0)
        assert rig.now_s - silent_s > 3.0  # well for a while first
        rig.unplugged.add("own")
        await flying.sleep(2.0)
        rig.unplugged.discard("own")
        await flying.sleep(5.0)
        assert flying.attitude.view()["why_not"] == "attitude lost in flight: it is aligned again on the ground"
        texts = rig.ground.texts()
        assert any(text.startswith("Attitude push stopped: IMU own sends nothing") for text in texts)
        rig.autopilot.disarm()
        await flying.pushing(30.0)


async def test_a_new_alignment_that_turns_the_heading_is_a_reset(tmp_path: Path) -> None:
    """The aircraft is carried round while the daemon hears no IMU; PX4 resets its yaw by the counter."""

    async with flight(tmp_path, firmware="px4") as flying:
        await flying.sleep(2.0)
        assert flying.witness.of(Vision)[-1].reset_counter == 0
        flying.rig.unplugged.add("own")
        await flying.sleep(1.5)
        flying.turn(heading_deg=50.0)
        await flying.sleep(5.0)
        flying.rig.unplugged.discard("own")
        await flying.pushing(40.0)
        await flying.sleep(3.0)
        assert flying.witness.of(Vision)[-1].reset_counter == 1
        assert flying.theirs_deg() < 2.0


async def test_a_tilt_that_differs_for_long_stops_the_push(tmp_path: Path) -> None:
    """One of the two is wrong and nobody can say which."""

    async with flight(tmp_path, used=False) as flying:
        rig = flying.rig
        rig.autopilot.arm()
        rig.double.set_parameter("AHRS_TRIM_Y", math.radians(9.0))
        await rig.until(lambda: not flying.attitude.health.pushing, 20.0)
        assert "tilt differs by" in flying.attitude.health.why_not
        rig.double.set_parameter("AHRS_TRIM_Y", 0.0)
        await flying.pushing(20.0)


async def test_a_heading_that_goes_its_own_way_after_agreeing_stops_the_push(tmp_path: Path) -> None:
    """Before they have ever agreed the autopilot may have any heading: that is what ours is for."""

    async with flight(tmp_path, used=False, calibrated=False) as flying:
        rig = flying.rig
        rig.double.estimator.compass = False
        rig.double.estimator.yaw_error_rad = math.radians(60.0)
        await flying.calibrate()
        await flying.pushing()
        await flying.sleep(15.0)
        assert flying.attitude.health.pushing
        rig.double.estimator.yaw_error_rad = 0.0
        await flying.sleep(15.0)
        rig.autopilot.arm()
        rig.double.estimator.yaw_error_rad = math.radians(-60.0)
        await rig.until(lambda: not flying.attitude.health.pushing, 20.0)
        assert "heading differs by" in flying.attitude.health.why_not
        assert "attitude push stopped" in rig.service.status()["headline"]["reason"]
        rig.double.estimator.yaw_error_rad = 0.0
        await flying.pushing(20.0)


async def test_a_compass_that_disagrees_for_long_stops_the_push(tmp_path: Path) -> None:
    """A motor's field: the gyros know better for a while, and then nobody does."""

    async with flight(tmp_path, used=False) as flying:
        rig = flying.rig
        rig.autopilot.arm()
        compass: Any = rig.devices["compass"]
        begun_s = rig.now_s
        compass.heading_error_deg = 3.0
        while compass.heading_error_deg < 40.0:
            await flying.sleep(0.05)
            compass.heading_error_deg += 0.15
        await rig.until(lambda: not flying.attitude.health.pushing, 60.0)
        assert "compass disagrees for" in flying.attitude.health.why_not
        assert rig.now_s - begun_s > 18.0
        assert math.degrees(abs(flying.witness.of(Vision)[-1].yaw - flying.true_yaw_rad)) < 6.0
        compass.heading_error_deg = 0.0
        await flying.pushing(20.0)


async def test_a_heading_that_drifts_is_not_believed_until_it_is_aligned_again(tmp_path: Path) -> None:
    """3 deg/s: of a gyro that no compass holds. The autopilot's gyros say nothing of the kind."""

    async with flight(tmp_path, firmware="px4") as flying:
        rig = flying.rig
        rig.autopilot.arm()
        flying.turn(heading_deg=110.0, roll_deg=20.0, pitch_deg=-10.0)
        await flying.sleep(6.0)
        assert flying.attitude.health.pushing
        gyro, accel = rig.own_model.true_bias(0.0)
        rig.unplugged.add("compass")
        rig.own_model.turn_on(gyro + np.radians([0.0, 0.0, 3.0]), accel)
        await rig.until(lambda: not flying.attitude.health.pushing, 3.7)
        assert "deg off the autopilot's gyros" in flying.attitude.health.why_not
        assert math.degrees(abs(flying.witness.of(Vision)[-1].yaw - flying.true_yaw_rad)) < 9.0
        assert flying.theirs_deg() < 8.0
        rig.own_model.turn_on(gyro, accel)
        rig.unplugged.discard("compass")
        stopped_s = rig.now_s
        await flying.sleep(15.0)
        assert not flying.witness.of(Vision, stopped_s + 0.1)
        rig.autopilot.disarm()
        await flying.pushing(40.0)
        await flying.sleep(3.0)
        assert math.degrees(abs(flying.witness.of(Vision)[-1].yaw - flying.true_yaw_rad)) < 2.0


async def test_two_compasses_that_differ_are_not_settled_by_pushing(tmp_path: Path) -> None:
    """EKF2 takes 40 deg without a word, and arms; ours is pushed once that compass is out of use."""

    async with flight(tmp_path, firmware="px4", calibrated=False) as flying:
        compass: Any = flying.rig.devices["compass"]
        flying.rig.autopilot.has_compass = True
        compass.heading_error_deg = 40.0
        await flying.calibrate()
        await flying.sleep(10.0)
        assert not flying.witness.of(Vision)
        assert "40 deg from the autopilot's compass: one of the two is wrong" in flying.attitude.health.why_not
        flying.rig.autopilot.has_compass = False
        await flying.pushing(10.0)


def test_a_fault_of_ours_costs_the_push_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The collector gets every sample; on the ground it begins anew by itself."""

    async def main() -> None:
        async with flight(tmp_path) as flying:
            (own,) = [device for device in flying.rig.service.devices.sensors if device.name == "own"]
            estimator = flying.attitude.carrier.estimator
            monkeypatch.setattr(estimator, "update", lambda *_, **__: 1 / 0)
            before = own.decoder.accepted
            await rig_stops(flying)
            assert flying.attitude.health.why_not == "internal error; the log has the details"
            last = len(flying.witness.of(Vision))
            await flying.pushing(30.0)
            assert len(flying.witness.of(Vision)) - last <= 2
            assert flying.attitude.carrier.estimator is not estimator
            assert own.decoder.accepted > before + 200
            assert flying.rig.service.core.collector.glance(flying.rig.now_s).obstacle is None

    async def rig_stops(flying: Flight) -> None:
        await flying.rig.until(lambda: not flying.attitude.health.pushing, 2.0)

    run_virtual(main())
