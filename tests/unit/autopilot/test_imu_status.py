"""Raw means of PX4's IMUs that its console prints, on the double."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass

import numpy as np
import pytest

from companion.autopilot.telemetry.px4_console import EkfBias, ImuStatus, Px4Console
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from tests.support.wire import Wire

BIASES = ((100.0, -60.0, 170.0), (-80.0, 40.0, 150.0))


@dataclass
class ImuStatusDouble:
    double: PX4Double
    ekf_bias: EkfBias
    heard: list[tuple[int, int, int, ImuSample]]


@contextlib.asynccontextmanager
async def aboard(
    wanted: tuple[int, ...] = (1, 2), *, slow: bool = False, **more: bool
) -> AsyncIterator[ImuStatusDouble]:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0))
    models = [
        ImuModel(
            aircraft, "white_only", seed=n,
            gyro_bias_rad_s=[value * DEG_H for value in gyro], accel_bias_m_s2=[n * MG, -MG, 2.0 * MG],
        )
        for n, gyro in enumerate(BIASES)
    ]  # fmt: skip
    parameters = {"CAL_GYRO1_XOFF": 0.02, "SENS_BOARD_X_OFF": 3.0}
    double = PX4Double(aircraft, models, parameters=parameters, default_streams=False, **more)
    link = MavlinkLink()
    Wire(link, double, seed=1)
    vehicle = Vehicle(link)
    console = Px4Console(link, vehicle)
    heard: list[tuple[int, int, int, ImuSample]] = []
    ekf_bias = EkfBias(console, vehicle)
    status = ImuStatus(console, ekf_bias, lambda: wanted, lambda *raw: heard.append(raw), slow=slow)
    tasks = [asyncio.create_task(run()) for run in (double.run, status.run)]
    try:
        async with asyncio.timeout(20.0):
            await vehicle.found.wait()
        yield ImuStatusDouble(double, ekf_bias, heard)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        vehicle.close()


async def test_every_imu_tells_its_bias_whatever_its_offsets_are() -> None:
    async with aboard() as found:
        await asyncio.sleep(30.0)
        for instance in (1, 2):
            own = [raw for number, _, _, raw in found.heard if number == instance]
            assert len(own) > 35
            imu = found.double.vehicle_imus[instance - 1]
            assert {raw[1:3] for raw in found.heard if raw[0] == instance} == {(imu.device_id, imu.device_id)}
            # The truth: what the sensor reads, turned by the board's rotation and nothing else.
            true = imu.model.expected(0.0)
            turned = np.concatenate((imu.gyro.rotation @ true[:3], imu.accel.rotation @ true[3:]))
            rows = np.array([raw.gyro_rad_s + raw.accel_m_s2 for raw in own])
            off = (rows.mean(axis=0) - turned) / np.repeat([DEG_H, MG], 3)
            assert np.abs(off[:3]).max() < 15.0
            assert np.abs(off[3:]).max() < 0.1
            assert own[-1].temperature_degc == pytest.approx(25.0)


async def test_a_publication_counts_once() -> None:
    async with aboard((1,)) as found:
        await asyncio.sleep(10.0)
        stamps = [raw.t_device_s for *_, raw in found.heard]
        assert len(stamps) == len(set(stamps)) > 20


async def test_on_a_slow_line_it_takes_less_than_a_quarter() -> None:
    async with aboard(slow=True) as found:
        channel = found.double.channels[0]
        before = channel.sent["SERIAL_CONTROL"]
        await asyncio.sleep(20.0)
        bytes_s = (channel.sent["SERIAL_CONTROL"] - before) * 93 / 20.0
        assert 300.0 < bytes_s < 0.25 * 5760.0
        assert len(found.heard) > 10


async def test_nothing_is_typed_while_armed_or_while_offsets_are_written() -> None:
    async with aboard() as found:
        await asyncio.sleep(5.0)
        found.double.arm()
        await asyncio.sleep(3.0)
        typed = len(found.double.shell.typed)
        await asyncio.sleep(10.0)
        assert len(found.double.shell.typed) == typed
        found.double.disarm()
        await asyncio.sleep(5.0)
        with found.ekf_bias.held():
            await asyncio.sleep(2.0)
            heard = len(found.heard)
            await asyncio.sleep(10.0)
        assert len(found.heard) == heard
        # New offsets change nothing in raw readings: it goes on at once.
        await asyncio.sleep(3.0)
        assert len(found.heard) > heard


async def test_a_board_whose_console_has_no_listener_is_asked_seldom() -> None:
    async with aboard(console=False) as found:
        await asyncio.sleep(120.0)
        assert found.heard == []
        assert len(found.double.shell.typed) < 20
