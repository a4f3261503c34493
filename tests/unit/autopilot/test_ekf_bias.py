"""Floats of PX4's IMUs: HIGHRES_IMU with the bias put back that the console tells, on the double; what lines lose."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.autopilot.telemetry.imu_stream import ImuStream
from companion.autopilot.telemetry.px4_console import LOOK_EVERY_S, MISSES, EkfBias, Px4Console
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from tests.support.wire import Wire

UNITS = np.array([DEG_H] * 3 + [MG] * 3)


@dataclass
class EkfDouble:
    double: PX4Double
    ekf_bias: EkfBias
    stream: ImuStream
    samples: list[ImuSample] = field(default_factory=list)
    kinds: list[str | None] = field(default_factory=list)

    def error(self, instance: int) -> np.ndarray:
        """Mean of what was heard less what the autopilot's output is: three deg/h, three mg."""
        left = self.double.residual(instance, asyncio.get_running_loop().time())
        truth = self.double.aircraft.truth_at(0.0)
        true = np.concatenate((truth.rate_rad_s + left.gyro_rad_s, truth.force_m_s2 + left.accel_m_s2))
        rows = np.array([sample.gyro_rad_s + sample.accel_m_s2 for sample in self.samples])
        return np.asarray((rows.mean(axis=0) - true) / UNITS)


@contextlib.asynccontextmanager
async def aboard(
    instance: int = 1,
    *,
    primary: int = 0,
    rate_hz: float = 25.0,
    part: str = "white_only",
    loss: float = 0.0,
    **more: bool,
) -> AsyncIterator[EkfDouble]:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0))
    biases = ((500.0, -700.0, 1000.0), (-400.0, 300.0, 800.0))
    models = [
        ImuModel(
            aircraft,
            part,
            seed=n,
            gyro_bias_rad_s=[value * DEG_H for value in bias],
            accel_bias_m_s2=[0.02] * 3,
        )
        for n, bias in enumerate(biases)
    ]
    double = PX4Double(aircraft, models, parameters={"IMU_GYRO_CAL_EN": 0}, default_streams=False, **more)
    double.primary_imu = primary
    link = MavlinkLink()
    Wire(link, double, seed=1, loss=loss, duplicate=loss)
    vehicle = Vehicle(link)
    ekf_bias = EkfBias(Px4Console(link, vehicle), vehicle)
    found = EkfDouble(double, ekf_bias, None)  # type: ignore[arg-type]
    found.stream = ImuStream(
        link, vehicle, instance, found.samples.append, rate_hz=rate_hz, ekf_bias=ekf_bias,
        on_kind_change=lambda kind: found.kinds.append(None if kind is None else kind.name),
    )  # fmt: skip
    tasks = [
        asyncio.create_task(double.run()),
        asyncio.create_task(ekf_bias.run()),
        asyncio.create_task(found.stream.run()),
    ]
    try:
        await asyncio.sleep(10.0)
        yield found
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        vehicle.close()


async def test_the_first_imu_comes_in_floats_and_is_right_to_two_deg_h() -> None:
    async with aboard(rate_hz=100.0) as found:
        assert found.kinds[-1] == "HIGHRES_IMU+bias"
        assert found.stream.kind is not None
        assert not found.stream.kind.integers
        found.samples.clear()
        await asyncio.sleep(40.0)
        assert 3900 < len(found.samples) < 4100
        error = found.error(1)  # 40 s of this noise: 2.1 deg/h, 0.011 mg
        assert np.abs(error[:3]).max() < 7.0
        assert np.abs(error[3:]).max() < 0.04
        sigmas = np.sqrt(found.samples[-1].shared_variance or ()) / UNITS
        assert 0.2 < sigmas[:3].max() < 4.0
        assert 0.001 < sigmas[3:].max() < 0.03
        assert found.samples[-1].temperature_degc == pytest.approx(25.0)


async def test_floats_go_with_the_imu_that_flies() -> None:
    async with aboard(1, primary=1) as found:
        assert found.kinds == ["SCALED_IMU"]
        found.double.primary_imu = 0
        await asyncio.sleep(30.0)
        assert found.kinds == ["SCALED_IMU", "HIGHRES_IMU+bias"]
        found.double.primary_imu = 1
        await asyncio.sleep(2.0 * LOOK_EVERY_S + 1.0)
        assert found.kinds[2:] == ["SCALED_IMU"]
    async with aboard(2, primary=1) as found:
        assert found.kinds[-1] == "HIGHRES_IMU+bias"
        found.samples.clear()
        await asyncio.sleep(20.0)
        assert np.abs(found.error(2)[:3]).max() < 5.0


async def test_while_offsets_are_written_it_is_the_integers() -> None:
    async with aboard() as found:
        typed = found.double.shell.typed
        with found.ekf_bias.held():
            typed.clear()
            await asyncio.sleep(30.0)
            assert found.kinds[-1] == "SCALED_IMU"
        await asyncio.sleep(55.0)
        assert found.kinds[-1] == "SCALED_IMU"  # the autopilot's estimator is not settled yet
        assert typed == []
        await asyncio.sleep(15.0)
        assert found.kinds[-1] == "HIGHRES_IMU+bias"


async def test_a_line_that_loses_and_doubles_messages_takes_longer_and_tells_nothing_wrong() -> None:
    async with aboard(loss=0.07) as found:
        await asyncio.sleep(60.0)
        assert found.kinds[-1] == "HIGHRES_IMU+bias"
        found.samples.clear()
        await asyncio.sleep(60.0)
        assert np.abs(found.error(1)[:3]).max() < 7.0


async def test_a_bias_that_jumps_is_not_put_back_until_it_is_steady_again() -> None:
    async with aboard() as found:
        found.double.vehicle_imus[0].model.turn_on([0.01] * 3, [0.02] * 3)
        await asyncio.sleep(20.0)
        assert found.kinds == ["HIGHRES_IMU+bias", "SCALED_IMU", "HIGHRES_IMU+bias"]


async def test_it_types_nothing_but_looks_and_nothing_into_an_armed_autopilot() -> None:
    async with aboard() as found:
        typed = found.double.shell.typed
        assert {line.split()[0] for line in typed} == {"listener"}
        found.double.arm()
        await asyncio.sleep(1.0)
        typed.clear()
        await asyncio.sleep(60.0)
        assert typed == []
        assert found.kinds[-1] == "SCALED_IMU"
        found.double.disarm()
        await asyncio.sleep(20.0)
        assert found.kinds[-1] == "HIGHRES_IMU+bias"


async def test_a_board_without_listener_is_asked_now_and_then_and_gives_integers() -> None:
    async with aboard(console=False, rate_hz=10.0) as found:
        await asyncio.sleep(90.0)
        assert found.kinds == ["SCALED_IMU"]
        assert len(found.double.shell.typed) == MISSES + 1


async def test_after_a_restart_it_begins_anew() -> None:
    async with aboard() as found:
        found.double.reboot()
        await asyncio.sleep(5.0)
        assert not found.ekf_bias.known_of(1)
        await asyncio.sleep(35.0)
        assert found.kinds[-1] == "HIGHRES_IMU+bias"
