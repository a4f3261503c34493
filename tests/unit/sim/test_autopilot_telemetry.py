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


def test_without_a_request_only_heartbeats_come() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await asyncio.sleep(10.0)
        assert {message.get_type() for _, message in station.heard} == {"HEARTBEAT"}
        beats = station.timed(mavlink.MAVLink_heartbeat_message)
        assert len(beats) == 11
        beat = beats[0][1]
        assert (beat.autopilot, beat.type, beat.get_srcComponent()) == (3, 2, 1)
        assert not beat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED

    play(scene)


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


def test_a_changed_orientation_is_used_within_a_second_but_never_while_armed() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await station.command(SET_INTERVAL, HIGHRES, 20_000)
        await asyncio.sleep(0.2)
        double.arm()
        await station.set_parameter("AHRS_ORIENTATION", 4)
        await asyncio.sleep(2.0)
        assert highres(station)[-1][6] < -9.0
        assert highres(station)[-1][4] == pytest.approx(0.854 + ACCEL_BIAS[0] - 0.001, abs=1e-3)
        double.disarm()
        await asyncio.sleep(1.2)
        assert highres(station)[-1][4] == pytest.approx(-(0.854 + ACCEL_BIAS[0] - 0.001), abs=1e-3)

    play(scene)


def test_a_new_offset_begins_to_act_at_once_and_is_settled_to_1_percent_after_60_ms() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        await station.command(SET_INTERVAL, HIGHRES, 4_000)
        await asyncio.sleep(0.5)
        before = highres(station)[-1][4]
        loop = asyncio.get_running_loop()
        set_s = loop.time()
        assert await station.set_parameter("INS_ACCOFFS_X", 0.301) == [pytest.approx(0.301)]
        await asyncio.sleep(0.2)
        after = highres(station, set_s)
        share = (before - after[:, 4]) / 0.3
        times = after[:, 0] - set_s
        assert share[-1] == pytest.approx(1.0, abs=1e-3)
        assert 0.02 < share[times > 0.012][0] < 0.6
        assert np.all(np.abs(share[times > 0.062] - 1.0) < 0.01)
        assert np.any(np.abs(share[times > 0.045] - 1.0) > 0.01)
        echo = station.timed(mavlink.MAVLink_param_value_message, since_s=set_s)[0][0] - set_s
        assert 0.002 < echo < 0.012

    play(scene)


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


def test_integer_messages_are_truncated_toward_zero_and_raw_is_not_raw() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        for message_id in (mavlink.MAVLINK_MSG_ID_RAW_IMU, mavlink.MAVLINK_MSG_ID_SCALED_IMU):
            await station.command(SET_INTERVAL, message_id, 50_000)
        await asyncio.sleep(1.0)
        raw = station.all(mavlink.MAVLink_raw_imu_message)[-1]
        scaled = station.all(mavlink.MAVLink_scaled_imu_message)[-1]
        rate, force = double.aircraft.truth_at(0.0)
        expected = [math.trunc(value * 1000.0 / 9.80665) for value in force + np.array([0.0298, -0.00981, 0.0]) - 0.001]
        assert [raw.xacc, raw.yacc, raw.zacc] == expected
        assert [raw.xgyro, raw.ygyro, raw.zgyro] == [
            math.trunc(value * 1000.0) for value in rate + np.array([9.9e-4, -9e-4, 2.5e-3])
        ]
        assert (raw.xgyro, raw.ygyro, raw.zgyro) == (1, 0, 2)
        assert raw.temperature == scaled.temperature == 3715
        for field in ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "xmag"):
            assert getattr(raw, field) == getattr(scaled, field)

    world = VirtualAircraft(Pose(5.0, -3.0, 40.0), temperature_degc=37.15)
    play(scene, aircraft=world, gyro_bias=(9.9e-4, -9e-4, 2.5e-3), accel_bias=(0.0298, -0.00981, 0.0))


def test_scaled_imu2_is_the_second_and_scaled_imu3_is_all_zero_without_a_third() -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        for message_id in (mavlink.MAVLINK_MSG_ID_SCALED_IMU2, mavlink.MAVLINK_MSG_ID_SCALED_IMU3):
            assert await station.command(SET_INTERVAL, message_id, 10_000) == 0
        await station.set_parameter("INS_ACCOFFS_X", 0.5)
        await asyncio.sleep(1.0)
        second = station.all(mavlink.MAVLink_scaled_imu2_message)
        third = station.all(mavlink.MAVLink_scaled_imu3_message)
        assert len(second) == pytest.approx(len(third), abs=1)
        assert len(third) > 90
        force = double.aircraft.truth_at(0.0).force_m_s2[0] + ACCEL_BIAS[0] - 0.001
        assert second[-1].xacc == math.trunc(force / 9.80665e-3)  # not touched by IMU 1's parameter
        fields = ("xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro", "temperature")
        assert all(getattr(message, field) == 0 for message in third for field in fields)
        assert third[-1].zmag != 0
        assert double.parameter("INS_ACC3_ID") == 0

    play(scene, imus=2)


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


@pytest.mark.parametrize(
    ("vehicle", "request_us", "result", "rate_hz"),
    [
        ("copter", 20_000, 0, 50.0), ("copter", 10_000, 0, 100.0), ("copter", 5_000, 0, 200.0),
        ("copter", 4_000, 0, 250.0), ("copter", 3_333, 0, 333.3), ("copter", 3_900, 0, 333.3),
        ("copter", 2_500, 2, 0.0), ("copter", 1_000, 2, 0.0),
        ("plane", 25_000, 0, 40.0), ("plane", 24_390, 2, 0.0), ("plane", 30_303, 0, 33.3),
    ],
)  # fmt: skip
def test_rates_are_whole_milliseconds_and_limited_by_the_loop(
    vehicle: str, request_us: int, result: int, rate_hz: float
) -> None:
    async def scene(double: ArduPilotDouble, station: Station) -> None:
        assert await station.command(SET_INTERVAL, HIGHRES, request_us) == result
        since_s = asyncio.get_running_loop().time()
        await asyncio.sleep(2.0)
        count = len(station.all(mavlink.MAVLink_highres_imu_message, since_s=since_s))
        assert count / 2.0 == pytest.approx(rate_hz, abs=1.0)
        too_fast = any("too fast" in text for text in station.texts())
        assert too_fast == (result != 0)

    play(scene, vehicle=vehicle)


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
