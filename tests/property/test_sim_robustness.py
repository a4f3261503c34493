"""Whatever comes, the simulator does not fall; whatever the pose, the devices agree with the truth."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.binary_imus import WitMotionImu
from sim.compasses import PniCompass, RionCompass
from sim.devices import HMR3300, Gradienter, ImuLine, SerialDevice, VectorNavBinary
from sim.earth import EARTH_RATE_RAD_S, angles_of, body_from_ned
from sim.gradienters import RionInclinometer, WitMotionInclinometer
from sim.imu_model import ImuModel
from sim.px4.double import PX4Double
from sim.station import Station
from tests.support.virtual_time import run_virtual

TILT = st.floats(-60.0, 60.0)
HEADING = st.floats(0.0, 359.99)
LATITUDE = st.floats(-89.0, 89.0)


@settings(max_examples=100)
@given(TILT, TILT, HEADING, LATITUDE)
def test_the_truth_has_the_right_length_and_the_right_angle(
    pitch: float, roll: float, heading: float, latitude: float
) -> None:
    aircraft = VirtualAircraft(Pose(pitch, roll, heading), Site(latitude, 0.0, 0.0))
    rate, force = aircraft.truth_at(0.0)
    assert np.linalg.norm(rate) == pytest.approx(EARTH_RATE_RAD_S, rel=1e-12)
    assert np.linalg.norm(force) == pytest.approx(aircraft.site.gravity_m_s2, rel=1e-12)
    # The Earth's axis stands at the latitude above the horizon, however the aircraft stands.
    sine = float(rate @ force) / (np.linalg.norm(rate) * np.linalg.norm(force))
    assert sine == pytest.approx(math.sin(math.radians(latitude)), abs=1e-9)


@settings(max_examples=100)
@given(TILT, TILT, HEADING)
def test_angles_come_back_from_their_matrix(pitch: float, roll: float, heading: float) -> None:
    angles = angles_of(body_from_ned(math.radians(roll), math.radians(pitch), math.radians(heading)))
    assert np.degrees(angles[:2]) == pytest.approx([roll, pitch], abs=1e-9)
    assert (math.degrees(angles[2]) - heading + 180.0) % 360.0 == pytest.approx(180.0, abs=1e-9)


@settings(max_examples=60)
@given(TILT, TILT, HEADING)
def test_a_compass_always_says_three_numbers_in_range(pitch: float, roll: float, heading: float) -> None:
    compass = HMR3300(VirtualAircraft(Pose(pitch, roll, heading)), heading_noise_deg=0.0)
    values = [float(field) for field in compass.frames_until(0.0)[0].data.split(b",")]
    assert 0.0 <= values[0] < 360.0
    assert (values[0] - heading + 180.0) % 360.0 == pytest.approx(180.0, abs=0.051)
    assert values[1:] == pytest.approx([pitch, roll], abs=0.051)


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


@settings(max_examples=60)
@given(st.floats(0.001, 3.0), st.lists(st.floats(0.0, 3.0), max_size=10))
def test_frames_come_once_each_and_in_order_however_often_one_asks(rate_scale: float, asks: list[float]) -> None:
    device = Gradienter(VirtualAircraft(), rate_hz=10.0 * rate_scale)
    frames = [frame for t_s in [*sorted(asks), 3.0] for frame in device.frames_until(t_s)]
    times = [frame.sampled_s for frame in frames]
    assert times == sorted(set(times))
    assert len(times) == math.floor(3.0 * 10.0 * rate_scale + 1e-6) + 1
