"""Meaning of the firmwares' IMU messages, row by row (autopilots 2, 4.5, 9.1, 9.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.messages import SCALED_IMU
from sim.imu_model import DEG_H, MG
from sim.sitl.hil_backend import FIFO_STEPS
from sim.sitl.residuals import gridded_mean, truncated_mean
from tests.sitl.craft import Autopilot, Craft

HIGHRES = mavlink.MAVLink_highres_imu_message
RATE_HZ = {"ardupilot": 100.0, "px4": 250.0}
UNBIASED_INTEGERS = {"ardupilot": 1, "px4": 2}
"""PX4's simulator passes the first IMU through another 16 bits (autopilots 9.3)."""


@pytest.mark.firmware_watch
def test_scaled_imu_is_truncated_toward_zero(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        instance = UNBIASED_INTEGERS[craft.firmware]
        rows = await craft.ground.imu(SCALED_IMU[instance - 1], 6.0, rate_hz=RATE_HZ[craft.firmware])
        expected = craft.expected(instance)[3:] / MG
        assert np.all(np.abs(expected) > 40.0)  # the tilt keeps every axis far from zero
        short = (np.abs(expected) - np.abs(rows[:, 3:].mean(axis=0) / MG)).tolist()
        assert short == pytest.approx([0.5] * 3, abs=0.15)

    autopilot.run(main)


def test_a_rate_below_one_mrad_s_reads_zero_most_of_the_time(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        instance = UNBIASED_INTEGERS[craft.firmware]
        rows = await craft.ground.imu(SCALED_IMU[instance - 1], 6.0, rate_hz=RATE_HZ[craft.firmware])
        rates = rows[:, :3].mean(axis=0)
        expected = craft.expected(instance)[:3]
        below = np.abs(expected) < 0.6e-3
        assert below.any()
        assert np.all(np.abs(rates[below]) < 0.5 * np.abs(expected[below]) + 0.02e-3)

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.only("ardupilot")
def test_highres_imu_of_ardupilot_is_the_calibrated_sensor_in_floats(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        rows = await craft.ground.imu(HIGHRES, 10.0)
        assert len(np.unique(rows[:, 0])) > 0.9 * len(rows)
        off = rows.mean(axis=0) - craft.expected(1)
        assert np.abs(off[:3] / DEG_H).max() < 12.0
        assert np.abs(off[3:] / MG).max() < 0.08

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.only("px4")
def test_highres_imu_of_px4_has_the_estimators_gyro_bias_taken_out(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        bias = np.concatenate(craft.true_bias(1))[:3] / DEG_H
        rows = await craft.ground.imu(HIGHRES, 10.0, rate_hz=50.0)
        left = (rows.mean(axis=0) - craft.truth())[:3] / DEG_H
        assert np.abs(bias).max() > 80.0
        assert np.abs(left).max() < 30.0

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_raw_imu_of_ardupilot_is_the_same_as_scaled_imu(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        name = "INS_ACCOFFS_X"
        async with craft.ground.restored(name) as before:
            await craft.ground.put(name, before[name] - 0.3)
            await asyncio.sleep(0.5)
            raw = (await craft.ground.imu(mavlink.MAVLink_raw_imu_message, 3.0)).mean(axis=0)
            scaled = (await craft.ground.imu(SCALED_IMU[0], 3.0)).mean(axis=0)
        np.testing.assert_allclose(raw[3:] / MG, scaled[3:] / MG, atol=0.15)
        assert (raw[3] - craft.expected(1)[3]) / MG == pytest.approx(0.3 / MG, abs=0.8)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_px4_does_not_send_raw_imu(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        result = await craft.ground.stream(mavlink.MAVLINK_MSG_ID_RAW_IMU, 50.0)
        assert result == mavlink.MAV_RESULT_FAILED
        assert not await craft.ground.collect(mavlink.MAVLink_raw_imu_message, 0.5)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_scaled_imu3_without_a_third_imu_is_sent_with_accelerometers_and_gyros_all_zero(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        rows = await craft.ground.imu(SCALED_IMU[2], 1.0, rate_hz=50.0)
        assert len(rows) > 40
        assert not rows.any()

    autopilot.run(main)


@pytest.mark.only("px4")
def test_scaled_imu3_without_a_third_imu_is_accepted_and_never_sent(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        assert await craft.ground.stream(mavlink.MAVLINK_MSG_ID_SCALED_IMU3, 50.0) == mavlink.MAV_RESULT_ACCEPTED
        assert not await craft.ground.collect(SCALED_IMU[2], 1.0)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_ardupilot_keeps_rates_up_to_its_loop_and_denies_faster_ones_with_a_text(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        for asked, given in ((50.0, 50.0), (200.0, 200.0), (320.0, 333.3)):
            assert await ground.stream(HIGHRES.id, asked) == mavlink.MAV_RESULT_ACCEPTED
            await asyncio.sleep(0.1)
            seen = await ground.collect(HIGHRES, 2.0)
            span_s = (seen[-1].time_usec - seen[0].time_usec) * 1e-6
            assert (len(seen) - 1) / span_s == pytest.approx(given, rel=0.03)
        since_s = asyncio.get_running_loop().time()
        assert await ground.stream(HIGHRES.id, 400.0) == mavlink.MAV_RESULT_DENIED
        await asyncio.sleep(0.5)
        assert "Requested rate for message ID 105 too fast" in ground.texts_since(since_s)
        await ground.stream(HIGHRES.id, 0.0)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_streams_slow_to_a_quarter_while_the_parameters_of_that_link_are_listed(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        assert await ground.stream(HIGHRES.id, 100.0) == mavlink.MAV_RESULT_ACCEPTED
        await asyncio.sleep(0.5)
        begun_s = loop.time()
        ground.send(mavlink.MAVLink_param_request_list_message(ground.vehicle, 1))

        def complete() -> bool:
            values = ground.all(mavlink.MAVLink_param_value_message, since_s=begun_s)
            return bool(values) and len({message.param_index for message in values}) >= values[-1].param_count

        await ground.wait_for(complete, 30.0, "the whole list")
        listed_s = loop.time() - begun_s
        during = [m.time_usec * 1e-6 for t_s, m in ground.timed(HIGHRES, since_s=begun_s) if t_s < begun_s + listed_s]
        await asyncio.sleep(0.5)
        after = [m.time_usec * 1e-6 for m in await ground.collect(HIGHRES, 1.0)]
        await ground.stream(HIGHRES.id, 0.0)
        assert np.median(np.diff(during)) == pytest.approx(0.04, abs=0.004)
        assert np.median(np.diff(after)) == pytest.approx(0.01, abs=0.002)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_an_interval_beyond_ten_on_a_link_becomes_the_nearest_of_them(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as station:
            kinds = (24, 26, 27, 30, 33, 116, 129, 163, 1, 2)
            for number, kind in enumerate(kinds):
                interval_us = 45_000 + 25_000 * number
                assert await station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, kind, interval_us) == 0
            assert await station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, HIGHRES.id, 10_000) == 0
            await asyncio.sleep(0.2)
            times = [message.time_usec * 1e-6 for message in await station.collect(HIGHRES, 3.0)]
            for kind in (*kinds, HIGHRES.id):
                await station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, kind, -1)
        assert np.median(np.diff(times)) == pytest.approx(0.045, abs=0.005)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_px4_accepts_any_rate_and_sends_at_most_its_imu_rate(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        for asked in (400.0, 1000.0):
            assert await ground.stream(SCALED_IMU[1].id, asked) == mavlink.MAV_RESULT_ACCEPTED
            await asyncio.sleep(0.1)
            seen = await ground.collect(SCALED_IMU[1], 2.0)
            rate_hz = (len(seen) - 1) / (seen[-1].time_boot_ms - seen[0].time_boot_ms) * 1e3
            assert 230.0 < rate_hz < 252.0
        await ground.stream(SCALED_IMU[1].id, 0.0)

    autopilot.run(main)


def test_the_imu_temperature_is_the_aircrafts(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await ground.stream(SCALED_IMU[0].id, 50.0)
        seen = await ground.collect(SCALED_IMU[0], 0.5)
        assert seen[-1].temperature / 100.0 == pytest.approx(craft.aircraft.temperature_degc(craft.now_s), abs=0.5)

    autopilot.run(main)


def test_the_autopilot_has_a_position_where_the_aircraft_is(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        await craft.ground.stream(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 10.0)
        since_s = asyncio.get_running_loop().time()
        seen = await craft.ground.wait_message(mavlink.MAVLink_global_position_int_message, 5.0, since_s=since_s)
        site = craft.aircraft.site
        assert seen.lat == pytest.approx(site.latitude_deg * 1e7, abs=500)
        assert seen.lon == pytest.approx(site.longitude_deg * 1e7, abs=500)
        assert seen.alt / 1000.0 == pytest.approx(site.height_m, abs=5.0)

    autopilot.run(main)


@pytest.mark.only("px4", "sitl")
def test_the_first_simulated_imu_of_px4_is_the_mean_of_three_coarse_readings_weighted_1_2_1(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        step = np.array(FIFO_STEPS[:3]) / 4.0
        rates = (await craft.ground.imu(HIGHRES, 5.0, rate_hz=250.0))[:, :3]
        jumps = np.diff(rates, axis=0) / step  # the estimator's bias, taken out of both, hardly moves
        assert np.abs(jumps - np.rint(jumps)).mean() < 0.02
        assert np.abs(jumps / 2.0 - np.rint(jumps / 2.0)).mean() > 0.1

    autopilot.run(main)


@pytest.mark.parametrize("mean", [0.48, -0.29, 0.82, 1.3, -2.4])
@pytest.mark.parametrize("offset", [0.0, 2.4])
def test_the_mean_behind_two_grids_is_found(mean: float, offset: float) -> None:
    """PX4's sensor 0: rounded to 16 bits, averaged with weights 1 2 1, corrected, cut to a mrad/s."""
    grid, sigma = 1.0653, 0.546
    raw = np.random.default_rng(8).normal(mean + offset, sigma, 30_002)
    rounded = np.rint(raw / grid) * grid
    values = np.trunc((rounded[2:] + 2.0 * rounded[1:-1] + rounded[:-2]) / 4.0 - offset)
    assert gridded_mean(values, sigma, grid, offset) == pytest.approx(mean, abs=0.025)


@pytest.mark.parametrize(("mean", "sigma"), [(0.3, 0.5), (-2.4, 0.4), (0.9, 0.33), (0.0, 0.6), (7.49, 0.35)])
def test_the_mean_of_truncated_readings_is_found(mean: float, sigma: float) -> None:
    """The tables' own estimator, against numbers that numpy has drawn and cut off."""
    values = np.trunc(np.random.default_rng(5).normal(mean, sigma, 40_000))
    assert truncated_mean(values, sigma) == pytest.approx(mean, abs=0.02)
