"""Floats of PX4's IMUs from HIGHRES_IMU and SCALED_IMU: the stream on the double, and single messages."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.autopilot.telemetry.imu_messages import Reading
from companion.autopilot.telemetry.imu_stream import ImuStream
from companion.autopilot.telemetry.pairing import Pairing
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import ImuSample
from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

UNITS = np.array([DEG_H] * 3 + [MG] * 3)


@dataclass
class Aboard:
    double: PX4Double
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
async def aboard(instance: int = 1, *, primary: int = 0, rate_hz: float = 100.0) -> AsyncIterator[Aboard]:
    aircraft = VirtualAircraft(Pose(5.0, -3.0, 40.0))
    biases = ((500.0, -700.0, 1000.0), (-400.0, 300.0, 800.0))
    models = [
        ImuModel(
            aircraft,
            "white_only",
            seed=n,
            gyro_bias_rad_s=[value * DEG_H for value in bias],
            accel_bias_m_s2=[0.02] * 3,
        )
        for n, bias in enumerate(biases)
    ]
    double = PX4Double(aircraft, models, parameters={"IMU_GYRO_CAL_EN": 0})
    double.primary_imu = primary
    link = MavlinkLink()
    Wire(link, double, seed=1)
    vehicle = Vehicle(link)
    found = Aboard(double, None)  # type: ignore[arg-type]
    found.stream = ImuStream(
        link, vehicle, instance, found.samples.append, rate_hz=rate_hz,
        on_kind_change=lambda kind: found.kinds.append(None if kind is None else kind.message),
    )  # fmt: skip
    tasks = [asyncio.create_task(double.run()), asyncio.create_task(found.stream.run())]
    try:
        await asyncio.sleep(10.0)
        yield found
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        vehicle.close()


def test_the_first_imu_comes_in_floats_and_is_right_to_two_deg_h() -> None:
    async def main() -> None:
        async with aboard() as found:
            assert found.kinds[-1] == "HIGHRES_IMU+SCALED_IMU"
            assert found.stream.kind is not None
            assert not found.stream.kind.truncates
            found.samples.clear()
            await asyncio.sleep(20.0)
            assert 1900 < len(found.samples) < 2200
            error = found.error(1)  # 20 s of this noise: 1.6 deg/h, 0.011 mg
            assert np.abs(error[:3]).max() < 5.0
            assert np.abs(error[3:]).max() < 0.04
            sigmas = np.sqrt(found.samples[-1].shared_variance or ()) / UNITS
            assert 0.2 < sigmas[:3].max() < 4.0
            assert 0.001 < sigmas[3:].max() < 0.02
            assert found.samples[-1].temperature_degc == pytest.approx(25.0)

    run_virtual(main())


def test_floats_go_with_the_imu_that_flies() -> None:
    async def main() -> None:
        async with aboard(1, primary=1) as found:
            assert found.kinds == ["SCALED_IMU"]
            found.double.primary_imu = 0
            await asyncio.sleep(30.0)
            assert found.kinds == ["SCALED_IMU", "HIGHRES_IMU+SCALED_IMU"]
            found.double.primary_imu = 1
            await asyncio.sleep(5.0)
            assert found.kinds[2:] == ["SCALED_IMU"]
        async with aboard(2, primary=1) as found:
            assert found.kinds[-1] == "HIGHRES_IMU+SCALED_IMU2"
            found.samples.clear()
            await asyncio.sleep(20.0)
            assert np.abs(found.error(2)[:3]).max() < 5.0

    run_virtual(main())


def test_while_offsets_are_written_it_is_the_integers() -> None:
    async def main() -> None:
        async with aboard() as found:
            found.stream.pairing.pause(paused=True)
            await asyncio.sleep(30.0)
            assert found.kinds[-1] == "SCALED_IMU"
            found.stream.pairing.pause(paused=False)
            await asyncio.sleep(15.0)
            assert found.kinds[-1] == "SCALED_IMU"  # the autopilot's estimator is not settled yet
            await asyncio.sleep(15.0)
            assert found.kinds[-1] == "HIGHRES_IMU+SCALED_IMU"

    run_virtual(main())


def reading(t_s: float, values: np.ndarray) -> Reading:
    x, y, z, ax, ay, az = values.tolist()
    return Reading(t_s, (x, y, z), (ax, ay, az), None)


def fed(pairing: Pairing, *, seconds: float, begin_s: float = 0.0, late_s: float = 0.0008, floats: bool = True) -> None:
    """Samples of 5 ms, each in both messages; the integers' stamp is so much later, in whole milliseconds."""
    random = np.random.default_rng(1)
    steps = np.array([1e-3] * 3 + [MG] * 3)
    for number in range(int(seconds * 200)):
        t_s = begin_s + number * 0.005
        true = np.array([2.3, -0.4, 0.1, 30.2, -8.8, -999.1]) + 0.5 * random.standard_normal(6)
        if floats:
            pairing.add_floats(reading(t_s, (true - 0.7) * steps))
        pairing.add_integers(reading(np.floor((t_s + late_s) * 1e3) * 1e-3, np.fix(true) * steps))


@pytest.mark.parametrize("late_s", [0.0, 0.0008, 0.0024])
def test_the_stamp_of_publishing_is_somewhat_later(late_s: float) -> None:
    pairing = Pairing()
    fed(pairing, seconds=4.0, late_s=late_s)
    assert pairing.known
    corrected, variances = pairing.corrected(reading(4.0, np.zeros(6)))
    assert corrected.gyro_rad_s == pytest.approx([0.7e-3] * 3, abs=5e-6)
    assert corrected.accel_m_s2 == pytest.approx([0.7 * MG] * 3, abs=0.005 * MG)
    assert max(variances[:3]) < 8e-6**2


def test_a_sample_later_is_no_pair() -> None:
    pairing = Pairing()
    fed(pairing, seconds=4.0, late_s=0.005)
    assert not pairing.known


def test_without_floats_there_is_nothing_known_any_more() -> None:
    pairing = Pairing()
    fed(pairing, seconds=4.0)
    assert pairing.known
    fed(pairing, seconds=2.0, begin_s=4.0, floats=False)
    assert not pairing.known


def test_after_a_restart_of_its_clock_it_begins_anew() -> None:
    pairing = Pairing()
    fed(pairing, seconds=4.0, begin_s=100.0)
    fed(pairing, seconds=4.0)
    assert pairing.known
