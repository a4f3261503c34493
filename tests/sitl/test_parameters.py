"""Effect of written offsets in the firmwares, row by row (autopilots 1, 4.2, 4.3, 9.1, 9.2, 9.3)."""

from __future__ import annotations

import ast
import asyncio
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion import autopilot as autopilots
from companion.autopilot.firmware.firmwares import firmware_named
from sim.earth import Array
from sim.firmware.messages import SCALED_IMU
from sim.imu_model import DEG_H, MG
from sim.sitl.ground import Firmware
from sim.sitl.residuals import truncated_mean
from tests.sitl.craft import Autopilot, Craft, DoubleAutopilot, hush

HIGHRES = mavlink.MAVLink_highres_imu_message
AHRS = mavlink.MAVLink_ahrs_message
PX4_GYRO = ("CAL_GYRO1_XOFF", "CAL_GYRO1_YOFF", "CAL_GYRO1_ZOFF")
PX4_ACCEL = ("CAL_ACC1_XOFF", "CAL_ACC1_YOFF", "CAL_ACC1_ZOFF")
FIRST_GYRO = {"ardupilot": "INS_GYROFFS_X", "px4": "CAL_GYRO1_XOFF"}
FIRST_ACCEL = {"ardupilot": "INS_ACCOFFS_X", "px4": "CAL_ACC1_XOFF"}
APPLIED_S = 2.5
"""PX4's consumers look at most once a second."""


def used_names(firmware: Firmware) -> set[str]:
    """Return the parameters that a write may change, and every text of the firmware code that may be such a name."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in Path(autopilots.__file__).parent.rglob("*.py"))
    texts = {one.value for tree in trees for one in ast.walk(tree) if isinstance(one, ast.Constant)}
    kind = firmware_named(firmware)
    return {*kind.ranges, *kind.heading_names(), *(text for text in texts if isinstance(text, str) and text.isupper())}


async def look(craft: Craft, seconds: float = 3.0) -> Array:
    """Mean of the IMU whose offsets the tests write: ArduPilot's first, PX4's second (autopilots 9.3)."""
    if craft.firmware == "ardupilot":
        mean: Array = (await craft.ground.imu(HIGHRES, seconds)).mean(axis=0)
        return mean
    rows = await craft.ground.imu(SCALED_IMU[1], seconds, rate_hz=250.0)
    step = np.array([1e-3] * 3 + [MG] * 3)
    counts = np.rint(rows / step)
    sigma = [0.386] * 3 + [0.55] * 3  # autopilots 9.3.2
    means = [truncated_mean(counts[:, axis], sigma[axis]) for axis in range(6)]
    result: Array = np.array(means) * step
    return result


@pytest.mark.firmware_watch
def test_an_accelerometer_offset_is_taken_off_the_reading_without_a_reboot(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        name = FIRST_ACCEL[craft.firmware]
        async with craft.ground.restored(name) as before:
            first = await look(craft)
            assert await craft.ground.put(name, before[name] + 0.3) == pytest.approx(before[name] + 0.3)
            await asyncio.sleep(APPLIED_S)
            moved = (await look(craft) - first) / MG
            await asyncio.sleep(1.5)
        np.testing.assert_allclose(moved[3:], [-0.3 / MG, 0.0, 0.0], atol=0.15)

    autopilot.run(main)


@pytest.mark.firmware_watch
def test_a_gyro_offset_is_taken_off_the_reading_without_a_reboot(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        await hush(craft)
        name = FIRST_GYRO[craft.firmware]
        async with craft.ground.restored(name) as before:
            first = await look(craft)
            await craft.ground.put(name, before[name] + 0.05)
            await asyncio.sleep(APPLIED_S)
            moved = await look(craft) - first
            await asyncio.sleep(1.5)
        np.testing.assert_allclose(moved[:3] * 1e3, [-50.0, 0.0, 0.0], atol=0.3)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_ardupilot_answers_a_write_at_once_and_it_shows_within_a_tenth_of_a_second(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        async with ground.restored("INS_ACCOFFS_X") as before:
            await ground.stream(HIGHRES.id, 200.0)
            await asyncio.sleep(0.5)
            level = float(np.mean([m.xacc for m in await ground.collect(HIGHRES, 1.0)]))
            since_s = loop.time()
            ground.send_put("INS_ACCOFFS_X", before["INS_ACCOFFS_X"] - 0.3)
            await ground.wait_message(mavlink.MAVLink_param_value_message, 1.0, since_s=since_s)
            echo_s = loop.time() - since_s
            await asyncio.sleep(0.5)
            moved = [(t_s - since_s, m.xacc - level) for t_s, m in ground.timed(HIGHRES, since_s=since_s)]
        assert echo_s < 0.5  # milliseconds, unless the machine is busy storing
        settled_s = next(t_s for t_s, x in moved if x > 0.95 * 0.3)
        assert settled_s < 0.1
        assert np.mean([x for t_s, x in moved if t_s > 0.2]) == pytest.approx(0.3, abs=0.003)

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.only("ardupilot")
def test_writing_x_of_a_vector_announces_y_and_z_too(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        async with ground.restored("INS_GYROFFS_X") as before:
            since_s = loop.time()
            ground.send_put("INS_GYROFFS_X", before["INS_GYROFFS_X"] + 0.001)
            await asyncio.sleep(0.5)
            seen = [m.param_id for m in ground.all(mavlink.MAVLink_param_value_message, since_s=since_s)]
            indices = [m.param_index for m in ground.all(mavlink.MAVLink_param_value_message, since_s=since_s)]
        assert sorted(seen) == ["INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z"]
        assert set(indices) == {65535}

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.parametrize("name", ["INS_ACC1OFFS_X", "CAL_GYRO9_XOFF"])
def test_an_unknown_name_is_answered_with_param_error_1_and_no_value(autopilot: Autopilot, name: str) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        since_s = loop.time()
        ground.send_put(name, 0.5)
        await asyncio.sleep(1.0)
        assert ground.parameter_errors(name, since_s) == [1]
        assert not [m for m in ground.all(mavlink.MAVLink_param_value_message, since_s=since_s) if m.param_id == name]

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_orientation_101_is_the_first_custom_rotation(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        straight = await look(craft)
        async with ground.restored("AHRS_ORIENTATION", "CUST_ROT_ENABLE"):
            await ground.put("CUST_ROT_ENABLE", 1)
            await asyncio.sleep(0.5)
            await craft.reboot()  # the angles are there from the next boot on
            await ground.put_all({"CUST_ROT1_ROLL": 0, "CUST_ROT1_PITCH": 0, "CUST_ROT1_YAW": 90})
            await ground.put("AHRS_ORIENTATION", 101)
            await asyncio.sleep(1.0)
            await craft.reboot()
            await asyncio.sleep(APPLIED_S)
            turned = await look(craft)
        await craft.reboot()
        expected = [-straight[4], straight[3], straight[5]]
        np.testing.assert_allclose(turned[3:] / MG, np.array(expected) / MG, atol=0.5)

    autopilot.run(main, 240.0)


@pytest.mark.firmware_watch
def test_the_parameters_that_the_companion_uses_have_the_names_of_the_double(
    autopilot: Autopilot, record_property: Callable[[str, object], None]
) -> None:
    async def listed(craft: Craft) -> set[str]:
        return set(await craft.ground.whole_list())

    async def lacks(craft: Craft, name: str) -> bool:
        """Check a name of a group that is switched off, which the list leaves out."""
        try:
            await craft.ground.get(name)
        except KeyError:
            return True
        return False

    async def compare(craft: Craft) -> tuple[list[str], list[str]]:
        found = await listed(craft)
        return [name for name in expected if name not in found and await lacks(craft, name)], sorted(used & found)

    known, used = DoubleAutopilot(autopilot.kind).run(listed), used_names(autopilot.firmware)
    expected = sorted(used & known)
    assert len(expected) > 30
    missing, had = autopilot.run(compare)
    record_property("missing", ", ".join(missing) or "none")
    record_property("new", ", ".join(name for name in had if name not in known) or "none")
    assert missing == []


INTEGER = {"ardupilot": "INS_GYR_CAL", "px4": "IMU_GYRO_CAL_EN"}


@pytest.mark.firmware_watch
def test_an_integer_travels_as_a_number_on_ardupilot_and_as_bytes_on_px4(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        name = INTEGER[craft.firmware]
        async with ground.restored(name):
            await ground.put(name, 1)
            since_s = loop.time()
            assert await ground.get(name) == 1.0
            values = ground.all(mavlink.MAVLink_param_value_message, since_s=since_s)
            sent = next(message for message in values if message.param_id == name)
        as_bytes = struct.unpack("<f", struct.pack("<i", 1))[0]
        assert sent.param_value == (1.0 if craft.firmware == "ardupilot" else as_bytes)
        assert await ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 0
        version = await ground.wait_message(mavlink.MAVLink_autopilot_version_message, 2.0)
        bits = version.capabilities
        assert bits & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT  # so this one distinguishes nothing
        assert not bits & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        bytewise = bool(bits & mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE)
        assert bytewise == (craft.firmware == "px4")

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.only("ardupilot")
def test_4_8_has_the_names_of_4_7_on_and_irregular_ones_for_the_first_imu(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        for name in (
            "MAV_SYSID",
            "MAV1_RAW_SENS",
            "ARMING_SKIPCHK",
            "INS_GYROFFS_X",
            "INS_GYR2OFFS_X",
            "INS_ACC2SCAL_X",
            "INS_GYR_ID",
            "INS_GYR1_CALTEMP",
            "INS_TCAL1_ENABLE",
            "INS_USE",
        ):
            await craft.ground.get(name)
        for name in ("SYSID_THISMAV", "SR0_RAW_SENS", "ARMING_CHECK", "INS_GYR1OFFS_X", "INS_ACC1SCAL_X"):
            with pytest.raises(KeyError):
                await craft.ground.get(name)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_accelerometers_whose_offsets_are_all_zero_count_as_uncalibrated_and_keep_it_from_arming(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        names = [f"INS_ACCOFFS_{axis}" for axis in "XYZ"]
        async with ground.restored(*names):
            await ground.put_all(dict.fromkeys(names, 0.0))
            await asyncio.sleep(1.5)
            since_s = loop.time()
            assert await ground.arm() == mavlink.MAV_RESULT_FAILED
            await asyncio.sleep(0.5)
            assert "3D Accel calibration needed" in ground.texts_since(since_s)
            await ground.put("INS_ACCOFFS_Z", 1e-5)  # a vector of almost zero does
            await asyncio.sleep(1.5)
            since_s = loop.time()
            await ground.arm()
            await asyncio.sleep(0.5)
            assert "3D Accel calibration needed" not in ground.texts_since(since_s)
            await ground.arm(arm=False, force=True)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_offsets_are_taken_off_in_the_boards_axes_before_its_orientation(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        async with ground.restored("AHRS_ORIENTATION", "INS_ACCOFFS_X") as before:
            straight = await look(craft)
            await ground.put("AHRS_ORIENTATION", 2)  # yaw 90 deg: the board's x points to the right
            await asyncio.sleep(APPLIED_S)
            turned = await look(craft)
            expected = [-straight[1], straight[0], straight[2], -straight[4], straight[3], straight[5]]
            np.testing.assert_allclose(turned[3:] / MG, np.array(expected[3:]) / MG, atol=0.5)
            await ground.put("INS_ACCOFFS_X", before["INS_ACCOFFS_X"] + 0.3)
            await asyncio.sleep(APPLIED_S)
            moved = (await look(craft) - turned) / MG
        await asyncio.sleep(APPLIED_S)
        np.testing.assert_allclose(moved[3:], [0.0, -0.3 / MG, 0.0], atol=0.5)

    autopilot.run(main)


@pytest.mark.firmware_watch
@pytest.mark.only("px4")
def test_px4_answers_a_write_of_the_wrong_type_with_param_error_7(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        since_s = loop.time()
        ground.send_put("CAL_ACC1_XOFF", 1, mavlink.MAV_PARAM_TYPE_INT32)
        await asyncio.sleep(1.0)
        assert ground.parameter_errors("CAL_ACC1_XOFF", since_s) == [7]
        assert await ground.get("CAL_ACC1_XOFF") == pytest.approx(0.0, abs=1e-6)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
@pytest.mark.parametrize("gyr_cal", [0, 1])
def test_a_boot_keeps_gyro_offsets_with_ins_gyr_cal_0_and_overwrites_them_with_1(
    autopilot: Autopilot, gyr_cal: int
) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        async with ground.restored("INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z", "INS_GYR_CAL"):
            await ground.put("INS_GYR_CAL", gyr_cal)
            await ground.put("INS_GYROFFS_X", 0.01)
            await asyncio.sleep(1.0)
            await craft.reboot()
            after = await ground.get("INS_GYROFFS_X")
            if gyr_cal == 0:
                assert after == np.float32(0.01)
            else:  # the whole reading, Earth rate included
                async with asyncio.timeout(
                    60.0
                ):  # it answers before its calibration has ended, with zeros while it runs
                    while after in (np.float32(0.01), 0.0):
                        await asyncio.sleep(1.0)
                        after = await ground.get("INS_GYROFFS_X")
                assert after / DEG_H == pytest.approx(craft.expected(1)[0] / DEG_H, abs=60.0)

    autopilot.run(main, 180.0)


@pytest.mark.only("ardupilot")
def test_ahrs_omega_i_is_minus_the_estimators_gyro_bias(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await ground.stream(AHRS.id, 10.0)
        async with ground.restored("INS_GYROFFS_X") as before:
            first = np.mean([m.omegaIx for m in await ground.collect(AHRS, 2.0)])
            await ground.put("INS_GYROFFS_X", before["INS_GYROFFS_X"] - 0.02)  # as if the gyro read 0.02 more
            await asyncio.sleep(30.0)
            last = np.mean([m.omegaIx for m in await ground.collect(AHRS, 2.0)])
        assert -0.025 < last - first < -0.008
        await ground.command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1.0, wait_s=35.0)  # takes the bias out again
        async with ground.restored():
            await ground.put_all({f"INS_GYROFFS_{axis}": 0.0 for axis in "XYZ"})
            await ground.put_all({f"INS_GYR2OFFS_{axis}": 0.0 for axis in "XYZ"})

    autopilot.run(main, 120.0)


@pytest.mark.only("px4")
def test_a_plain_write_below_0_01_rad_s_reads_back_and_does_nothing_and_the_two_step_write_works(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await hush(craft)
        wanted = np.array([300.0, 0.0, 0.0]) * DEG_H
        async with ground.restored(*PX4_GYRO):
            first = await look(craft, 6.0)
            await ground.put("CAL_GYRO1_XOFF", float(wanted[0]))
            await asyncio.sleep(APPLIED_S)
            assert await ground.get("CAL_GYRO1_XOFF") == pytest.approx(float(wanted[0]), rel=1e-6)
            plain = await look(craft, 6.0) - first
            np.testing.assert_allclose(plain[:3] / DEG_H, 0.0, atol=30.0)
            await ground.put_all(dict(zip(PX4_GYRO, (wanted + 0.02).tolist(), strict=True)))
            await asyncio.sleep(APPLIED_S)
            await ground.put_all(dict(zip(PX4_GYRO, wanted.tolist(), strict=True)))
            await asyncio.sleep(APPLIED_S)
            stepped = await look(craft, 6.0) - first
            np.testing.assert_allclose(stepped[:3] / DEG_H, [-300.0, 0.0, 0.0], atol=30.0)
            await far_and_back(craft, PX4_GYRO, 0.02)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_a_plain_write_below_0_01_m_s2_does_nothing_and_the_two_step_write_works(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        wanted = np.array([0.5, 0.0, 0.0]) * MG
        async with ground.restored(*PX4_ACCEL):
            first = await look(craft, 6.0)
            await ground.put("CAL_ACC1_XOFF", float(wanted[0]))
            await asyncio.sleep(APPLIED_S)
            plain = await look(craft, 6.0) - first
            np.testing.assert_allclose(plain[3:] / MG, 0.0, atol=0.12)
            await ground.put_all(dict(zip(PX4_ACCEL, (wanted + 0.05).tolist(), strict=True)))
            await asyncio.sleep(APPLIED_S)
            await ground.put_all(dict(zip(PX4_ACCEL, wanted.tolist(), strict=True)))
            await asyncio.sleep(APPLIED_S)
            stepped = await look(craft, 6.0) - first
            np.testing.assert_allclose(stepped[3:] / MG, [-0.5, 0.0, 0.0], atol=0.12)
            await far_and_back(craft, PX4_ACCEL, 0.05)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_a_small_second_write_of_a_vector_stays_out_and_leaves_it_mixed(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await hush(craft)
        async with ground.restored(*PX4_GYRO):
            first = await look(craft, 4.0)
            await ground.put("CAL_GYRO1_XOFF", 0.015)
            await asyncio.sleep(APPLIED_S)
            await ground.put("CAL_GYRO1_YOFF", 0.005)
            await asyncio.sleep(APPLIED_S)
            mixed = (await look(craft, 4.0) - first)[:3] * 1e3
            await far_and_back(craft, PX4_GYRO, 0.02)
        np.testing.assert_allclose(mixed, [-15.0, 0.0, 0.0], atol=0.3)

    autopilot.run(main)


@pytest.mark.only("px4")
def test_an_accelerometer_vector_below_0_01_m_s2_is_kept_over_a_boot_and_not_applied(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        async with ground.restored(*PX4_ACCEL):
            first = await look(craft, 6.0)
            await ground.put_all(dict(zip(PX4_ACCEL, (0.055, 0.05, 0.05), strict=True)))
            await asyncio.sleep(APPLIED_S)
            await ground.put_all(dict(zip(PX4_ACCEL, (0.005, 0.0, 0.0), strict=True)))
            await asyncio.sleep(APPLIED_S)
            in_use = await look(craft, 6.0) - first
            await craft.reboot()
            assert await ground.get("CAL_ACC1_XOFF") == pytest.approx(0.005)
            await asyncio.sleep(5.0)
            after = await look(craft, 6.0) - first
            await far_and_back(craft, PX4_ACCEL, 0.05)
        assert in_use[3] / MG == pytest.approx(-0.51, abs=0.12)
        assert after[3] / MG == pytest.approx(0.0, abs=0.12)

    autopilot.run(main, 180.0)


async def far_and_back(craft: Craft, names: tuple[str, str, str], far: float) -> None:
    """Leave the sensors with no offsets in use, as the tests after this expect."""
    for value in (far, 0.0):
        await craft.ground.put_all(dict.fromkeys(names, value))
        await asyncio.sleep(APPLIED_S)


@pytest.mark.only("px4")
@pytest.mark.parametrize("switched_off", [False, True])
def test_px4_rewrites_a_gyro_offset_by_itself_when_still_and_disarmed_until_rebooted_without_the_module(
    autopilot: Autopilot, *, switched_off: bool
) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await ground.put("IMU_GYRO_CAL_EN", 1)
        await craft.reboot()  # the module is started at boot only...
        if switched_off:
            await ground.put("IMU_GYRO_CAL_EN", 0)  # ...and does not look at the parameter again
        async with ground.restored(*PX4_GYRO):
            await ground.put("CAL_GYRO1_XOFF", -0.05)
            async with asyncio.timeout(60.0):
                while abs(await ground.get("CAL_GYRO1_XOFF")) > 0.01:
                    await asyncio.sleep(0.5)
            assert await ground.get("CAL_GYRO1_XOFF") == pytest.approx(craft.expected(2)[0], abs=0.002)
        await ground.put("IMU_GYRO_CAL_EN", 1)
        await hush(craft)

    autopilot.run(main, 180.0)
