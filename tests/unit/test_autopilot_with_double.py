"""The autopilot room against the simulator's double, which was written without a look at it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import changes_for, output_step
from companion.autopilot.parameters.change import WriteFailedError
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.verify import Observation, judge
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.telemetry.ekf_bias import EkfBias
from companion.autopilot.telemetry.imu_stream import ImuStream
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample, Vector
from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.imu_model import DEG_H, MG, ImuModel
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

GYRO_BIAS = np.array([1080.0, -900.0, 1000.0]) * DEG_H
ACCEL_BIAS = np.array([30.0, -20.0, 25.0]) * MG
POSE = Pose(5.0, -3.0, 40.0)
# Independent of companion.physics: Earth rate and gravity of autopilots 9.3, in the body of that pose.
_TEN = (
    mavlink.MAVLINK_MSG_ID_ATTITUDE,
    mavlink.MAVLINK_MSG_ID_AHRS,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_RAW_IMU,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
)
RATE = np.array([9.64, -6.93, -9.24]) * DEG_H


class Stage:
    def __init__(self, *, count: int = 1, **options: Any) -> None:
        self.aircraft = VirtualAircraft(POSE)
        mounting = options.pop("mounting_deg", (0.0, 0.0, 0.0))
        instance, rate_hz = options.pop("instance", 1), options.pop("stream_rate_hz", 100.0)
        imus = [
            ImuModel(
                self.aircraft,
                "white_only",
                seed=n,
                gyro_bias_rad_s=GYRO_BIAS.tolist(),
                accel_bias_m_s2=ACCEL_BIAS.tolist(),
                mounting_deg=mounting,
            )
            for n in range(count)
        ]
        options["parameters"] = {"INS_GYR_CAL": 0, **options.pop("parameters", {})}
        self.double = ArduPilotDouble(self.aircraft, imus, **options)
        self.link = MavlinkLink()
        self.wire = Wire(self.link, self.double, seed=1)
        self.vehicle = Vehicle(self.link)
        self.client = ParameterClient(self.link, self.vehicle)
        self.writer = ParameterWriter(self.client, self.vehicle)
        self.samples: list[ImuSample] = []
        self.stream = ImuStream(
            self.link,
            self.vehicle,
            instance,
            self.samples.append,
            rate_hz=rate_hz,
            ekf_bias=EkfBias(self.link, self.vehicle),
            on_kind_change=lambda kind: None,
        )

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        tasks = [asyncio.create_task(self.double.run()), asyncio.create_task(self.stream.run())]
        try:
            await self.vehicle.found.wait()
            await asyncio.sleep(2.0)
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self.vehicle.close()

    async def mean(self, seconds: float) -> tuple[Any, Any, Any]:
        self.samples.clear()
        await asyncio.sleep(seconds)
        gyro = np.array([sample.gyro_rad_s for sample in self.samples])
        accel = np.array([sample.accel_m_s2 for sample in self.samples])
        return gyro.mean(0), accel.mean(0), gyro.std(0) / np.sqrt(len(gyro) / 10)


def vector(values: Any) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def truth_accel() -> Any:
    pitch, roll = np.radians(5.0), np.radians(-3.0)
    g = 9.801543
    return -g * np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])


@pytest.mark.parametrize(
    ("orientation", "mounting"), [(0, (0.0, 0.0, 0.0)), (2, (0.0, 0.0, 90.0)), (24, (0.0, 90.0, 0.0))]
)
@pytest.mark.parametrize("without_effect", [False, True])
def test_measured_written_and_judged(
    orientation: int, mounting: tuple[float, float, float], *, without_effect: bool
) -> None:
    async def main() -> None:
        stage = Stage(mounting_deg=mounting, parameters={"AHRS_ORIENTATION": orientation})
        async with stage.running():
            calibration = await read_calibration(stage.client, 1)
            before, accel, sigma = await stage.mean(10.0)
            changes = changes_for(calibration, vector(before - RATE), vector(accel - truth_accel()))
            stage.double.faults.echo_without_effect = without_effect
            written = await stage.writer.apply(changes)
            assert {w.outcome for w in written.values()} == {"stored"}
            await asyncio.sleep(1.0)
            after, accel_after, sigma_after = await stage.mean(10.0)
            verdict = judge(
                Observation(
                    parameters=calibration.parameters.gyro_offset,
                    unit="rad/s",
                    before=vector(before),
                    before_sigma=vector(sigma),
                    after=vector(after),
                    after_sigma=vector(sigma_after),
                    expected_step=output_step(calibration, changes)[0],
                    truth=vector(RATE),
                    tolerance=2 * DEG_H,
                    orientation=calibration.orientation,
                )
            )
            if without_effect:
                assert [axis.word for axis in verdict.axes] == ["not seen"] * 3
                assert "INS_GYROFFS_X" in verdict.problems[0]
            else:
                assert verdict.problems == ()
                assert np.abs(after - RATE).max() < 20 * DEG_H
                assert np.abs(accel_after - truth_accel()).max() < 0.2 * MG

    run_virtual(main())


def small_changes(stage: Stage, calibration: Any) -> Any:
    return changes_for(calibration, (0.001, 0.002, 0.003), (0.01, 0.02, 0.03))


def test_arming_in_the_middle() -> None:
    async def main() -> None:
        stage = Stage()
        async with stage.running():
            changes = small_changes(stage, await read_calibration(stage.client, 1))
            stage.double.faults.arm_after_writes = 3
            with pytest.raises(WriteFailedError) as caught:
                await stage.writer.apply(changes)
            assert caught.value.kind == "armed in the middle"
            for change in changes:
                changed = abs(stage.double.parameter(change.parameter) - change.before) > 1e-6
                assert changed == (change.parameter in caught.value.left_changed)

    run_virtual(main())


@pytest.mark.parametrize("number", [1, 3, 6])
def test_a_restart_in_the_middle(number: int) -> None:
    async def main() -> None:
        stage = Stage()
        async with stage.running():
            changes = small_changes(stage, await read_calibration(stage.client, 1))
            stage.double.faults.reboot_after_writes = number
            with pytest.raises(WriteFailedError, match="rebooted in the middle") as caught:
                await stage.writer.apply(changes)
            assert caught.value.left_changed == ()
            for change in changes:
                assert stage.double.parameter(change.parameter) == pytest.approx(change.before, abs=1e-9)
            await asyncio.sleep(8.0)
            before = stage.stream.samples
            await asyncio.sleep(1.0)
            assert stage.stream.samples > before + 50

    run_virtual(main())


@pytest.mark.parametrize(
    ("fault", "kind"), [("refuse", "refused"), ("ignore", "no answer"), ("wrong_echo", "answered another value")]
)
def test_faults_of_one_parameter(fault: str, kind: str) -> None:
    async def main() -> None:
        stage = Stage()
        async with stage.running():
            changes = small_changes(stage, await read_calibration(stage.client, 1))
            getattr(stage.double.faults, fault).add("INS_GYROFFS_Y")
            with pytest.raises(WriteFailedError) as caught:
                await stage.writer.apply(changes)
            assert caught.value.kind == kind
            for change in changes:
                if change.parameter not in caught.value.left_changed:
                    assert stage.double.parameter(change.parameter) == pytest.approx(change.before, abs=1e-9)

    run_virtual(main())


async def stream_of(stage: Stage, seconds: float = 8.0) -> tuple[str | None, float]:
    """The message that the samples come from, and how many come a second."""
    await asyncio.sleep(seconds)
    before = stage.stream.samples
    await asyncio.sleep(4.0)
    kind = stage.stream.kind
    return None if kind is None else kind.message, (stage.stream.samples - before) / 4.0


@pytest.mark.parametrize(("version", "int_only"), [("4.5", False), ("4.8", True)])
def test_without_highres_imu_before_4_6_or_with_1_mb_of_flash_the_integers_serve(version: str, int_only: bool) -> None:
    async def main() -> None:
        stage = Stage(version=version)
        stage.double.faults.int_only = int_only
        async with stage.running():
            message, found_hz = await stream_of(stage)
            assert message == "SCALED_IMU"
            assert found_hz == pytest.approx(100.0, abs=2.0)
            await read_calibration(stage.client, 1)

    run_virtual(main())


@pytest.mark.parametrize(("version", "rate_hz"), [("4.8", 100.0), ("4.6", 100.0), ("4.5", 333.3)])
def test_a_rate_above_the_loops_is_denied_and_the_next_lower_taken_or_before_4_6_capped_and_taken_as_it_comes(
    version: str, rate_hz: float
) -> None:
    async def main() -> None:
        stage = Stage(version=version, stream_rate_hz=400.0)
        async with stage.running():
            _, found_hz = await stream_of(stage)
            assert found_hz == pytest.approx(rate_hz, rel=0.02)
            assert stage.stream.problem == ""

    run_virtual(main())


def test_a_plane_with_a_loop_of_50_hz_gives_40_hz() -> None:
    async def main() -> None:
        stage = Stage(vehicle="plane")
        async with stage.running():
            message, found_hz = await stream_of(stage)
            assert message == "HIGHRES_IMU"
            assert found_hz == pytest.approx(40.0, abs=1.0)

    run_virtual(main())


def test_when_all_ten_intervals_of_the_link_are_taken_the_nearest_serves() -> None:
    async def main() -> None:
        stage = Stage()
        for number, message_id in enumerate(_TEN):
            stage.double.channels[0].set_stream(message_id, 0.045 + 0.025 * number, 0.0)
        async with stage.running():
            _, found_hz = await stream_of(stage)
            assert found_hz == pytest.approx(1000.0 / 45.0, abs=1.0)
            assert stage.stream.problem == ""

    run_virtual(main())


def test_an_all_zero_scaled_imu3_is_not_an_imu() -> None:
    async def main() -> None:
        stage = Stage(count=2, instance=3)
        async with stage.running():
            await asyncio.sleep(8.0)
            assert stage.stream.kind is None
            assert stage.stream.problem == "SCALED_IMU3 is all zero: there is no third IMU"
            assert stage.samples == []

    run_virtual(main())
