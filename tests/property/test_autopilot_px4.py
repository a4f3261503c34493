"""Any orientation, level offset, scale and slot: what is read and then written takes the residual out of the output."""

from __future__ import annotations

import asyncio
import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import changes_for, output_step
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from companion.samples import Vector
from tests.support.scripted_autopilot import f32, flying_on
from tests.support.scripted_px4 import ICM, ScriptedPx4
from tests.support.virtual_time import run_virtual

CAN = 3 | 5 << 3 | 9 << 8
# MAVLink's angles of some orientations by number: roll, pitch, yaw in degrees.
ORIENTATIONS = {0: (0, 0, 0), 2: (0, 0, 90), 8: (180, 0, 0), 12: (0, 180, 0), 24: (0, 90, 0), 40: (90, 315, 0)}


def matrix(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    r, p, y = map(math.radians, (roll_deg, pitch_deg, yaw_deg))
    about_x = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    about_y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    product: np.ndarray = about_z @ about_y @ about_x
    return product


def vectors(limit: float) -> st.SearchStrategy[Vector]:
    number = st.floats(-limit, limit).map(f32)
    return st.tuples(number, number, number)


@settings(max_examples=40)
@given(
    number=st.sampled_from(sorted(ORIENTATIONS)),
    other=st.sampled_from(sorted(ORIENTATIONS)),
    external=st.booleans(),
    level=vectors(20.0),
    scale=st.tuples(*[st.floats(0.8, 1.2).map(f32)] * 3),
    slots=st.permutations(range(4)),
    gyro_bias=vectors(0.02),
    accel_bias=vectors(0.3),
    gyro_offset=vectors(0.02),
    accel_offset=vectors(0.3),
)
def test_what_is_read_and_written_takes_the_residual_out(
    *,
    number: int,
    other: int,
    external: bool,
    level: Vector,
    scale: Vector,
    slots: list[int],
    gyro_bias: Vector,
    accel_bias: Vector,
    gyro_offset: Vector,
    accel_offset: Vector,
) -> None:
    gyro_slot, accel_slot = slots[:2]
    device = CAN if external else ICM
    parameters: dict[str, float] = {
        "CAL_GYRO0_ID": 0,
        "CAL_ACC0_ID": 0,
        f"CAL_GYRO{gyro_slot}_ID": device,
        f"CAL_ACC{accel_slot}_ID": device,
        f"CAL_GYRO{gyro_slot}_ROT": number if external else -1,
        f"CAL_ACC{accel_slot}_ROT": number if external else -1,
        "SENS_BOARD_ROT": other if external else number,
    }
    parameters |= {f"SENS_BOARD_{axis}_OFF": value for axis, value in zip("XYZ", level, strict=True)}
    parameters |= {f"CAL_GYRO{gyro_slot}_{a}OFF": v for a, v in zip("XYZ", gyro_offset, strict=True)}
    parameters |= {f"CAL_ACC{accel_slot}_{a}OFF": v for a, v in zip("XYZ", accel_offset, strict=True)}
    parameters |= {f"CAL_ACC{accel_slot}_{a}SCALE": v for a, v in zip("XYZ", scale, strict=True)}
    rotation = matrix(*level) @ matrix(*ORIENTATIONS[number])
    px4 = ScriptedPx4(devices=(device,), parameters=parameters)
    rate, force = np.array([5e-5, 0.0, -4e-5]), np.array([0.8, -0.5, -9.7])

    # PX4 starts with 1 and ignores a vector of scales that is within 0.01 of that.
    in_use = np.ones(3) if np.abs(np.array(scale) - 1.0).max() <= 0.01 else np.array(scale)

    def output() -> tuple[np.ndarray, np.ndarray]:
        """PX4's formula, with the offsets that it uses and a sensor whose own scale error the scale undoes."""
        raw_rate = rotation.T @ rate + np.array(gyro_bias)
        raw_force = rotation.T @ force / in_use + np.array(accel_bias)
        gyro = rotation @ (raw_rate - px4.used["GYRO", device])
        return gyro, rotation @ (in_use * (raw_force - px4.used["ACC", device]))

    async def main() -> None:
        link = MavlinkLink()
        vehicle = Vehicle(link)
        client = ParameterClient(link, vehicle)
        async with flying_on(link, px4):
            await vehicle.found.wait()
            await asyncio.sleep(1.0)
            # As after a restart: a small accelerometer vector is not in use, and it is known that it may not be.
            found = await read_calibration(client, 1)
            unused = bool(np.any(px4.used["ACC", device] != np.array(accel_offset)))
            assert found.accel_offset_may_be_unused or not unused
            if unused:
                return
            np.testing.assert_allclose(found.orientation, rotation, atol=1e-6)
            gyro, accel = output()
            changes = changes_for(found, tuple(gyro - rate), tuple(accel - force))
            await ParameterWriter(client, vehicle).apply(changes)
            await asyncio.sleep(1.5)
            gyro_then, accel_then = output()
            np.testing.assert_allclose(gyro_then, rate, atol=1e-8)
            np.testing.assert_allclose(accel_then, force, atol=1e-6)
            gyro_step, accel_step = output_step(found, changes)
            np.testing.assert_allclose(gyro + gyro_step, gyro_then, atol=1e-8)
            np.testing.assert_allclose(accel + accel_step, accel_then, atol=1e-6)
        vehicle.close()

    run_virtual(main())
