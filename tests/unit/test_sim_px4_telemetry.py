"""What the PX4 double sends, how often and to whom (autopilots 4.5, 5.1, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2
from sim.imu_model import DEG_H, MG
from tests.support.px4_stage import ACCEL_BIAS, GYRO_BIAS, INTERVAL, LATEST_S, POSE, REQUEST, PX4Stage, now_s
from tests.support.virtual_time import run_virtual

HIGHRES, SCALED, SCALED2, SCALED3, RAW = 105, 26, 116, 129, 27
MILLI_G = STANDARD_GRAVITY_M_S2 / 1000.0
BIG_ACCEL = np.array([30.0, -30.0, 30.0]) * MG


def gyro_of(messages: list[Any]) -> np.ndarray:
    return np.array([[m.xgyro, m.ygyro, m.zgyro] for m in messages], dtype=float)


def accel_of(messages: list[Any]) -> np.ndarray:
    return np.array([[m.xacc, m.yacc, m.zacc] for m in messages], dtype=float)


async def stream(stage: PX4Stage, message_id: int, rate_hz: float, over_s: float, kind: type[Any]) -> list[Any]:
    assert await stage.companion.command(INTERVAL, message_id, 1e6 / rate_hz) == 0
    since_s = now_s()
    await asyncio.sleep(over_s)
    heard: list[Any] = stage.companion.all(kind, since_s=since_s)
    return heard


def test_scaled_imu_is_the_corrected_sensor_truncated_toward_zero() -> None:
    async def main() -> None:
        parameters = {"CAL_GYRO0_XOFF": 0.0123, "CAL_ACC0_YOFF": -0.2}
        async with PX4Stage(parameters=parameters) as stage:
            await asyncio.sleep(30.0)  # whatever the estimator has learned does not matter
            heard = await stream(stage, SCALED, 50, 1.0, mavlink.MAVLink_scaled_imu_message)
            truth = stage.aircraft.truth_at(0.0)
            rate = (truth.rate_rad_s + GYRO_BIAS - [0.0123, 0.0, 0.0]) * 1000.0
            force = (truth.force_m_s2 + ACCEL_BIAS + [0.0, 0.2, 0.0]) / MILLI_G
            assert np.all(gyro_of(heard) == np.trunc(rate))
            assert np.all(accel_of(heard) == np.trunc(force))
            assert gyro_of(heard)[0].tolist() == [-11.0, 0.0, 0.0]  # -11.77, -0.32, 0.78

    run_virtual(main())


def test_scaled_imu_tells_the_imus_temperature_and_never_zero() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            heard = await stream(stage, SCALED, 50, 0.1, mavlink.MAVLink_scaled_imu_message)
            assert heard[0].temperature == 2500
        stage.aircraft._temperature = 0.0
        async with PX4Stage(aircraft=stage.aircraft) as cold:
            heard = await stream(cold, SCALED, 50, 0.1, mavlink.MAVLink_scaled_imu_message)
            assert heard[0].temperature == 1

    run_virtual(main())


def test_noise_of_the_outputs_is_that_of_a_mean_over_the_interval_and_independent() -> None:
    async def main() -> None:
        async with PX4Stage(spec="white_only") as stage:
            heard = await stream(stage, HIGHRES, 250, 20.0, mavlink.MAVLink_highres_imu_message)
            values = np.hstack((gyro_of(heard), accel_of(heard)))[1500:]
            expected = stage.double.imus[0].white / math.sqrt(1.0 / 250.0)
            assert values.std(axis=0) == pytest.approx(expected, rel=0.06)
            centred = values - values.mean(axis=0)
            correlation = (centred[1:] * centred[:-1]).mean(axis=0) / centred.var(axis=0)
            assert np.abs(correlation).max() < 0.06

    run_virtual(main())


def test_highres_and_scaled_imu_show_the_same_samples() -> None:
    async def main() -> None:
        async with PX4Stage(spec="white_only", parameters={"CAL_GYRO0_XOFF": 0.4}) as stage:
            await stage.companion.command(INTERVAL, HIGHRES, 4000)
            await stage.companion.command(INTERVAL, SCALED, 4000)
            await asyncio.sleep(8.0)
            # SCALED_IMU has the time at which a sample was published, 0.8 ms later.
            fine = {
                (m.time_usec + 800) // 1000: m.zacc for m in stage.companion.all(mavlink.MAVLink_highres_imu_message)
            }
            pairs = [
                (m.zacc, fine[m.time_boot_ms])
                for m in stage.companion.all(mavlink.MAVLink_scaled_imu_message)[-500:]
                if m.time_boot_ms in fine
            ]
            assert len(pairs) > 400
            whole, exact = np.array(pairs).T
            learned = stage.double.vehicle_imus[0].estimator.published[5]
            assert np.abs(whole - np.trunc((exact + learned) / MILLI_G)).max() <= 1.0

    run_virtual(main())


def test_highres_imu_gyro_tends_to_the_true_rate_whatever_the_calibration() -> None:
    async def main() -> None:
        async with PX4Stage(parameters={"CAL_GYRO0_XOFF": -0.05}) as stage:
            heard = await stream(stage, HIGHRES, 50, 10.0, mavlink.MAVLink_highres_imu_message)
            earth = stage.aircraft.truth_at(0.0).rate_rad_s
            assert gyro_of(heard[-50:]).mean(axis=0) == pytest.approx(earth, abs=4.0 * DEG_H)  # it wanders
            assert heard[-1].id == 0

    run_virtual(main())


def test_highres_imu_absorbs_a_vertical_accelerometer_offset_within_5_s_and_only_a_part_of_a_horizontal_one() -> None:
    async def main() -> None:
        async with PX4Stage(accel_bias=(0.0, 0.0, 0.0), gyro_bias=(0.0, 0.0, 0.0)) as stage:
            assert await stage.companion.command(INTERVAL, HIGHRES, 20000) == 0
            await asyncio.sleep(1.0)
            truth = stage.aircraft.truth_at(0.0).force_m_s2
            await stage.set("CAL_ACC0_ZOFF", -0.3)
            begun_s = now_s()
            await asyncio.sleep(10.0)
            heard = stage.companion.timed(mavlink.MAVLink_highres_imu_message, since_s=begun_s)
            early = np.mean([m.zacc for t, m in heard if t < begun_s + 5.0]) - truth[2]
            late = np.mean([m.zacc for t, m in heard if t >= begun_s + 5.0]) - truth[2]
            assert early == pytest.approx(0.063, abs=0.01)  # -9.737 of -9.800 in the real one
            assert late == pytest.approx(0.0, abs=0.003)
            await stage.set("CAL_ACC0_XOFF", -0.3)
            await asyncio.sleep(10.0)
            last = stage.companion.all(mavlink.MAVLink_highres_imu_message)[-1]
            assert 0.06 < last.xacc - truth[0] < 0.16  # 0.14 of 0.3 in the real one, soon after its start

    run_virtual(main())


def test_scaled_imu_2_and_3_are_acknowledged_but_never_arrive_with_one_imu() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stream(stage, SCALED2, 50, 1.0, mavlink.MAVLink_scaled_imu2_message) == []
            assert await stream(stage, SCALED3, 50, 1.0, mavlink.MAVLink_scaled_imu3_message) == []
        async with PX4Stage(imus=3) as stage:
            assert len(await stream(stage, SCALED2, 50, 1.0, mavlink.MAVLink_scaled_imu2_message)) > 40
            assert len(await stream(stage, SCALED3, 50, 1.0, mavlink.MAVLink_scaled_imu3_message)) > 40

    run_virtual(main())


def test_raw_imu_does_not_exist_and_heartbeats_cannot_be_had_faster() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(INTERVAL, RAW, 20000) == 4
            assert await stage.companion.command(INTERVAL, 0, 200000) == 4
            assert await stage.companion.command(INTERVAL, SCALED, 20000, 1.0) == 4
            begun = len(stage.companion.all(mavlink.MAVLink_heartbeat_message))
            await asyncio.sleep(10.0)
            assert len(stage.companion.all(mavlink.MAVLink_heartbeat_message)) - begun == pytest.approx(10, abs=1)

    run_virtual(main())


@pytest.mark.parametrize(
    ("asked_hz", "seen_hz"), [(50, 50), (100, 100), (200, 125), (250, 250), (400, 250), (1000, 250)]
)
def test_rates_are_quantised_by_the_250_hz_of_the_sensor(asked_hz: int, seen_hz: int) -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            heard = await stream(stage, SCALED, asked_hz, 10.0, mavlink.MAVLink_scaled_imu_message)
            assert len(heard) / 10.0 == pytest.approx(seen_hz, rel=0.02)
            times = [m.time_boot_ms for m in heard]
            assert len(set(times)) == len(times)

    run_virtual(main())


def test_streams_are_scaled_down_together_to_the_data_rate_but_not_the_heartbeat() -> None:
    async def main() -> None:
        async with PX4Stage(default_streams=True, data_rate=2880.0) as stage:  # half of 57600 baud
            await stage.companion.command(INTERVAL, SCALED, 20000)
            begun = len(stage.companion.heard)
            sizes: list[int] = []
            await asyncio.sleep(10.0)
            for _, message in stage.companion.heard[begun:]:
                sizes.append(len(message.get_msgbuf()))
            assert 1500.0 < sum(sizes) / 10.0 < 2900.0
            beats = [m for _, m in stage.companion.heard[begun:] if m.get_type() == "HEARTBEAT"]
            assert len(beats) >= 9

    run_virtual(main())


def test_the_companions_port_has_onboard_streams_and_the_other_one_normal() -> None:
    async def main() -> None:
        async with PX4Stage(default_streams=True) as stage:
            await asyncio.sleep(10.0)
            counts = {
                (name, who): len([1 for _, m in station.heard if m.get_type() == name]) / 10.0
                for name in ("HIGHRES_IMU", "ATTITUDE", "TIMESYNC", "EXTENDED_SYS_STATE", "HOME_POSITION", "SCALED_IMU")
                for who, station in (("companion", stage.companion), ("ground", stage.ground))
            }
            assert counts["HIGHRES_IMU", "companion"] == pytest.approx(50.0, rel=0.05)
            assert counts["ATTITUDE", "companion"] == pytest.approx(100.0, rel=0.05)
            assert counts["ATTITUDE", "ground"] == pytest.approx(15.0, rel=0.05)
            assert counts["TIMESYNC", "companion"] == pytest.approx(10.0, rel=0.05)
            assert counts["HIGHRES_IMU", "ground"] == counts["SCALED_IMU", "companion"] == 0.0
            assert counts["HOME_POSITION", "companion"] > 0.3
            (state, *_) = stage.companion.all(mavlink.MAVLink_extended_sys_state_message)
            assert state.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
            assert stage.companion.all(mavlink.MAVLink_gps_raw_int_message)[0].fix_type == 3
            assert stage.companion.all(mavlink.MAVLink_global_position_int_message)[0].lat == 400000000
            assert stage.companion.all(mavlink.MAVLink_system_time_message)[0].time_unix_usec > 1_795_000_000_000_000
            # A stream can be stopped, and set back to its default.
            await stage.companion.command(INTERVAL, HIGHRES, -1)
            quiet_s = now_s()
            await asyncio.sleep(1.0)
            assert stage.companion.all(mavlink.MAVLink_highres_imu_message, since_s=quiet_s) == []
            await stage.companion.command(INTERVAL, HIGHRES, 0)
            await asyncio.sleep(1.0)
            assert len(stage.companion.all(mavlink.MAVLink_highres_imu_message, since_s=quiet_s)) > 40

    run_virtual(main())


def test_timesync_goes_both_ways() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.companion.send(mavlink.MAVLink_timesync_message(0, 123456789))
            await asyncio.sleep(0.5)
            heard = stage.companion.all(mavlink.MAVLink_timesync_message)
            answers = [m for m in heard if m.tc1 != 0]
            assert [m.ts1 for m in answers] == [123456789]
            assert answers[0].tc1 / 1e9 == pytest.approx(30.05, abs=0.01)
            request = next(m for m in heard if m.tc1 == 0)
            stage.companion.send(mavlink.MAVLink_timesync_message(42, request.ts1))
            await asyncio.sleep(0.1)
            assert stage.double.timesync_answers == 1

    run_virtual(main())


def test_the_attitude_has_swallowed_the_horizontal_accelerometer_bias_and_keeps_it_after_a_write_until_a_reboot() -> (
    None
):
    async def main() -> None:
        async with PX4Stage(accel_bias=BIG_ACCEL, gyro_bias=(0.0, 0.0, 0.0)) as stage:

            async def errors_deg() -> tuple[float, float]:
                assert await stage.companion.command(REQUEST, 30) == 0
                last = stage.companion.all(mavlink.MAVLink_attitude_message)[-1]
                return math.degrees(last.pitch) - POSE.pitch_deg, math.degrees(last.roll) - POSE.roll_deg

            await asyncio.sleep(60.0)
            before = await errors_deg()
            assert before == pytest.approx((1.72, 1.72), abs=0.01)  # 30 mg in rad: the real one had 1.91 and 1.66
            x, y, z = BIG_ACCEL
            await stage.set_vector(0, "ACC", (0.05, 0.05, 0.05), settle=False)
            await asyncio.sleep(2.5)
            await stage.set_vector(0, "ACC", (x, y, z))
            await asyncio.sleep(170.0)
            late = await errors_deg()
            assert 0.6 < late[0] / before[0] < 0.95  # 1.51 of 1.91
            assert 0.6 < late[1] / before[1] < 0.95  # 1.31 of 1.66
            assert stage.double.residual(1, now_s()).accel_m_s2 == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
            stage.double.reboot(1.0)
            await asyncio.sleep(2.0)
            assert await errors_deg() == pytest.approx((0.0, 0.0), abs=0.001)

    run_virtual(main())


def test_a_gyro_offset_that_is_taken_clears_the_estimators_bias_and_one_that_is_not_does_not() -> None:
    async def main() -> None:
        async with PX4Stage(gyro_bias=(0.006, 0.0, 0.0)) as stage:
            await asyncio.sleep(20.0)
            estimator = stage.double.vehicle_imus[0].estimator
            stage.double.update_estimators(now_s())
            assert estimator.gyro_bias_rad_s[0] == pytest.approx(0.006, rel=0.01)
            await stage.set("CAL_GYRO0_XOFF", 0.006)
            await asyncio.sleep(LATEST_S)
            assert estimator.gyro_bias_rad_s[0] == pytest.approx(0.006, rel=0.01)
            await stage.set("CAL_GYRO0_XOFF", 0.016)
            assert abs(estimator.gyro_bias_rad_s[0]) < 0.001

    run_virtual(main())


def test_the_heartbeat_says_px4_armed_and_whether_the_checks_pass() -> None:
    async def main() -> None:
        async with PX4Stage(parameters={"COM_ARMABLE": 0}) as stage:

            async def beat() -> mavlink.MAVLink_heartbeat_message:
                assert await stage.companion.command(REQUEST, 0) == 0
                return stage.companion.all(mavlink.MAVLink_heartbeat_message)[-1]

            assert (await beat()).autopilot == mavlink.MAV_AUTOPILOT_PX4
            assert (await beat()).system_status == mavlink.MAV_STATE_UNINIT
            await stage.set("COM_ARMABLE", 1)
            assert (await beat()).system_status == mavlink.MAV_STATE_STANDBY
            assert not (await beat()).base_mode & 128
            stage.double.arm()
            assert (await beat()).system_status == mavlink.MAV_STATE_ACTIVE
            assert (await beat()).base_mode & 128

    run_virtual(main())


def test_the_health_bit_follows_the_checks() -> None:
    async def main() -> None:
        async with PX4Stage(imus=2) as stage:

            async def healthy() -> bool:
                assert await stage.companion.command(REQUEST, 1) == 0
                last = stage.companion.all(mavlink.MAVLink_sys_status_message)[-1]
                return bool(last.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK)

            assert await healthy()
            await stage.set_vector(1, "ACC", (0.8, 0.0, 0.0))
            assert stage.double.prearm_failures(now_s()) == ["Accel 1 inconsistent - check cal"]
            assert not await healthy()

    run_virtual(main())


def test_a_requested_message_that_there_is_not_is_denied() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(REQUEST, SCALED2) == 2
            assert await stage.companion.command(REQUEST, RAW) == 2
            assert await stage.companion.command(REQUEST, SCALED) == 0

    run_virtual(main())


def test_telemetry_faults() -> None:
    async def main() -> None:
        async with PX4Stage(spec="white_only") as stage:
            stage.double.faults.frozen_imu = True
            heard = await stream(stage, HIGHRES, 50, 1.0, mavlink.MAVLink_highres_imu_message)
            assert len({m.time_usec for m in heard}) == 1
            stage.double.faults.telemetry_off = stage.double.faults.heartbeat_off = True
            quiet_s = now_s() + 0.01
            await asyncio.sleep(3.0)
            assert [m for t_s, m in stage.companion.heard if t_s > quiet_s] == []

    run_virtual(main())
