"""The simulator survives any input; in every pose the devices agree with the truth."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.aircraft import VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.binary_imus import WitMotionImu
from sim.compasses import PniCompass, RionCompass
from sim.devices import HMR3300, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.gradienters import RionInclinometer, WitMotionInclinometer
from sim.imu_model import ImuModel
from sim.px4.double import PX4Double
from sim.station import Station
from tests.support.virtual_time import run_virtual


def all_devices() -> list[SerialDevice]:
    aircraft = VirtualAircraft()
    imu = ImuModel(aircraft)
    binary = [PniCompass(aircraft), RionCompass(aircraft), RionInclinometer(aircraft)]
    return [
        *(HMR3300(aircraft), Gradienter(aircraft), VectorNavBinary(imu), ImuLine(imu)),
        *(*binary, WitMotionImu(imu), WitMotionInclinometer(aircraft)),
    ]


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=300), max_size=8))
def test_devices_survive_any_command(chunks: list[bytes]) -> None:
    for device in all_devices():
        for number, chunk in enumerate(chunks):
            device.command(chunk, number * 0.1)
        device.frames_until(1.0)


@pytest.mark.parametrize(("kind", "name"), [(ArduPilotDouble, "INS_GYR_CAL"), (PX4Double, "IMU_GYRO_CAL_EN")])
@settings(max_examples=30)
@given(chunks=st.lists(st.binary(max_size=300), max_size=20))
def test_the_doubles_survive_any_bytes_and_still_answer(
    kind: type[ArduPilotDouble | PX4Double], name: str, chunks: list[bytes]
) -> None:
    async def main() -> None:
        aircraft = VirtualAircraft()
        double = kind(aircraft, [ImuModel(aircraft)])
        station = Station()
        loop = asyncio.get_running_loop()
        double.attach(lambda data: station.receive(data, loop.time()))
        station.attach(lambda data: double.receive(data, loop.time()))
        for chunk in chunks:
            double.receive(chunk, loop.time())
        double.receive(bytes(300), loop.time())  # whatever was half received is over now
        assert len(await station.read_parameter(name)) == 1

    run_virtual(main())
