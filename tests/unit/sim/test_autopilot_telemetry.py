"""The double's telemetry: what ArduPilot makes of a sensor (autopilots 1.2, 2 and 9.1)."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.earth import STANDARD_GRAVITY_M_S2, mounting_matrix
from sim.imu_model import DEG_H, MG, ImuModel
from sim.station import Station
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

GYRO_BIAS = (100.0 * DEG_H, -60.0 * DEG_H, 170.0 * DEG_H)
ACCEL_BIAS = (1.0 * MG, -2.0 * MG, 3.0 * MG)
SET_INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
HIGHRES = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
Scene = Callable[[ArduPilotDouble, Station], Awaitable[None]]


def play(
    scene: Scene,
    *,
    aircraft: VirtualAircraft | None = None,
    imus: int = 1,
    spec: str = "perfect",
    parameters: Mapping[str, float] | None = None,
    board_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gyro_bias: tuple[float, float, float] = GYRO_BIAS,
    accel_bias: tuple[float, float, float] = ACCEL_BIAS,
    **options: Any,
) -> None:
    """Run a scene with a double and a companion-like station (1/191) on a wire, on virtual time."""

    async def main() -> None:
        world = aircraft or VirtualAircraft(Pose(5.0, -3.0, 40.0), Site(40.0, 116.0, 50.0, -7.5))
        models = [
            ImuModel(
                world, spec, seed=n, gyro_bias_rad_s=gyro_bias, accel_bias_m_s2=accel_bias, mounting_deg=board_deg
            )
            for n in range(imus)
        ]  # fmt: skip
        double = ArduPilotDouble(world, models, parameters={"INS_GYR_CAL": 0, **(parameters or {})}, **options)
        station = Station(1, 191)
        Wire(station, double)
        running = asyncio.create_task(double.run())
        await asyncio.sleep(0.05)
        try:
            await scene(double, station)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    run_virtual(main())


def highres(station: Station, since_s: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Time, three rates, three specific forces (n, 7)."""
    return np.array(
        [
            (t_s, m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc)
            for t_s, m in station.timed(mavlink.MAVLink_highres_imu_message, since_s=since_s)
        ]
    )


def test_highres_imu_is_sensor_minus_offset_times_scale() -> None:
    parameters = {
        "INS_GYROFFS_X": 2e-4, "INS_GYROFFS_Z": -3e-4, "INS_ACCOFFS_X": 0.3, "INS_ACCOFFS_Y": -0.1,
        "INS_ACCOFFS_Z": 0.2, "INS_ACCSCAL_X": 1.01, "INS_ACCSCAL_Z": 0.98,
    }  # fmt: skip

    async def scene(double: ArduPilotDouble, station: Station) -> None:
        assert await station.command(SET_INTERVAL, HIGHRES, 10_000) == 0
        await asyncio.sleep(1.0)
        rate, force = double.aircraft.truth_at(0.0)
        last = highres(station)[-1]
        gyro_offset, accel_offset, scale = [2e-4, 0.0, -3e-4], [0.3, -0.1, 0.2], [1.01, 1.0, 0.98]
        assert last[1:4] == pytest.approx(rate + GYRO_BIAS - gyro_offset, abs=1e-8)
        assert last[4:] == pytest.approx((force + ACCEL_BIAS - accel_offset) * scale, abs=2e-6)

    play(scene, parameters=parameters)


@pytest.mark.parametrize(
    ("number", "board_deg"),
    [(2, (0.0, 0.0, 90.0)), (8, (180.0, 0.0, 0.0)), (25, (0.0, 270.0, 0.0)), (38, (90.0, 68.8, 293.3)),
     (101, (10.0, -20.0, 30.0))],
)  # fmt: skip
def test_orientation_undoes_the_boards_mounting_and_offsets_act_in_board_axes(
    number: int, board_deg: tuple[float, float, float]
) -> None:
    parameters: dict[str, float] = {"AHRS_ORIENTATION": number, "INS_GYROFFS_X": 1e-3}
    if number == 101:
        parameters |= {"CUST_ROT_ENABLE": 1, "CUST_ROT1_ROLL": 10, "CUST_ROT1_PITCH": -20, "CUST_ROT1_YAW": 30}

    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await station.command(SET_INTERVAL, HIGHRES, 20_000)
        await asyncio.sleep(0.5)
        rate, force = double.aircraft.truth_at(0.0)
        last = highres(station)[-1]
        in_vehicle = mounting_matrix(*board_deg)
        assert last[1:4] == pytest.approx(rate + in_vehicle @ (np.array(GYRO_BIAS) - [1e-3, 0.0, 0.0]), abs=1e-8)
        assert last[4:] == pytest.approx(force + in_vehicle @ (np.array(ACCEL_BIAS) - 0.001), abs=2e-6)

    play(scene, parameters=parameters, board_deg=board_deg)


@pytest.mark.parametrize("rate_us", [8_000, 20_000])
def test_noise_is_that_of_the_20_hz_filter_whatever_the_rate_and_averages_to_n2_over_t(rate_us: int) -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await station.command(SET_INTERVAL, HIGHRES, rate_us)
        await asyncio.sleep(60.0)
        readings = highres(station)[50:]
        # Seen on the real firmware with this part: 0.23 mrad/s and 0.33 mG.
        assert readings[:, 1:4].std(axis=0) == pytest.approx([2.3e-4] * 3, rel=0.05)
        assert readings[:, 4:].std(axis=0) == pytest.approx([3.3e-4 * STANDARD_GRAVITY_M_S2] * 3, rel=0.06)
        per_second = 1_000_000 // rate_us
        means = readings[: len(readings) // per_second * per_second, 1:4].reshape(-1, per_second, 3).mean(axis=1)
        density = math.sqrt(float((0.5 * np.diff(means, axis=0) ** 2).mean()))
        assert density == pytest.approx(7.1 * DEG_H, rel=0.15)

    play(scene, spec="white_only")


def test_the_estimator_keeps_a_stale_gyro_bias_after_a_write_for_about_two_minutes() -> None:
    async def yaw_deg(station: Station) -> float:
        await station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_ATTITUDE)
        return math.degrees(station.all(mavlink.MAVLink_attitude_message)[-1].yaw)

    async def omega(station: Station) -> float:
        await station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AHRS)
        return float(station.all(mavlink.MAVLink_ahrs_message)[-1].omegaIx)

    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await asyncio.sleep(250.0)
        assert await omega(station) == pytest.approx(-GYRO_BIAS[0], rel=0.02)  # minus the bias
        await station.set_parameter("INS_GYROFFS_X", GYRO_BIAS[0])
        assert await omega(station) == pytest.approx(-GYRO_BIAS[0], rel=0.05)
        # As seen on the real firmware: a step of 0.3 deg/s turns the heading by 5 deg within 40 s.
        await station.set_parameter("INS_GYROFFS_Z", GYRO_BIAS[2] + math.radians(0.3))
        before_deg = await yaw_deg(station)
        await asyncio.sleep(40.0)
        assert await yaw_deg(station) - before_deg == pytest.approx(-5.0, abs=1.5)
        assert await omega(station) == pytest.approx(-GYRO_BIAS[0] / math.e, rel=0.1)
        await asyncio.sleep(120.0)
        assert abs(await omega(station)) < 3.0 * DEG_H
        assert abs(await yaw_deg(station) - before_deg) < 1.5

    play(scene)


def test_before_4_6_there_is_no_highres_imu_and_rates_are_capped_silently() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        assert await station.command(SET_INTERVAL, HIGHRES, 10_000) == mavlink.MAV_RESULT_DENIED
        assert await station.command(SET_INTERVAL, mavlink.MAVLINK_MSG_ID_RAW_IMU, 1_000) == 0
        since_s = asyncio.get_running_loop().time()
        await asyncio.sleep(1.0)
        assert len(station.all(mavlink.MAVLink_raw_imu_message, since_s=since_s)) == pytest.approx(333, abs=3)
        assert not any("too fast" in text for text in station.texts())
        assert double.parameter("SYSID_THISMAV") == 1

    play(scene, version="4.5")
