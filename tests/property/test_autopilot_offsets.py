"""The offsets algebra against an independent simulation of what ArduPilot does to a sample (autopilots 1.2)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.autopilot.firmware.imu_calibration import (
    FAR_GYRO_RAD_S,
    ImuCalibration,
    accel_offset_after,
    changes_for,
    gyro_offset_after,
    output_step,
    vector_changes,
)
from companion.physics.frames import Array, Matrix
from companion.samples import Vector
from tests.support.scripted_autopilot import f32

G = 9.80665


def offsets_after(
    calibration: ImuCalibration, gyro: tuple[float, float, float], accel: tuple[float, float, float]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return gyro_offset_after(calibration, gyro), accel_offset_after(calibration, accel)


def from_euler_deg(roll: float, pitch: float, yaw: float) -> Matrix:
    """Product of three elementary rotations: x first, then y, then z."""
    r, p, y = map(math.radians, (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    about_y = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    about_z = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x  # type: ignore[no-any-return]


class Firmware:
    """Arithmetic of the autopilot, in 32 bit floats, on a sensor with a bias in the board's axes."""

    def __init__(self, rotation: Matrix, scale: Vector, gyro_bias: Vector, accel_bias: Vector) -> None:
        self.rotation, self.scale = rotation, np.array(scale)
        self.gyro_bias, self.accel_bias = np.array(gyro_bias), np.array(accel_bias)

    def output(self, rate: Array, force: Array, gyro_offset: Vector, accel_offset: Vector) -> tuple[Array, Array]:
        # The scale parameter undoes the sensor's own scale error: raw = force / scale + bias.
        raw_rate = self.rotation.T @ rate + self.gyro_bias
        raw_force = self.rotation.T @ force / self.scale + self.accel_bias
        gyro = self.rotation @ (raw_rate - np.array(gyro_offset))
        accel = self.rotation @ (self.scale * (raw_force - np.array(accel_offset)))
        return gyro, accel


def vectors(limit: float) -> st.SearchStrategy[Vector]:
    number = st.floats(-limit, limit).map(f32)
    return st.tuples(number, number, number)


angles = st.floats(-180, 180)
scales = st.floats(0.8, 1.2).map(f32)


@settings(max_examples=150)
@given(
    mounting=st.tuples(angles, angles, angles),
    tilt=st.tuples(angles, angles, angles),
    scale=st.tuples(scales, scales, scales),
    gyro_bias=vectors(0.04),
    accel_bias=vectors(0.4),
    gyro_offset=vectors(0.04),
    accel_offset=vectors(0.35),
)
def test_after_the_write_the_output_is_the_truth(
    mounting: Vector,
    tilt: Vector,
    scale: Vector,
    gyro_bias: Vector,
    accel_bias: Vector,
    gyro_offset: Vector,
    accel_offset: Vector,
) -> None:
    rotation = from_euler_deg(*mounting)
    firmware = Firmware(rotation, scale, gyro_bias, accel_bias)
    force = from_euler_deg(*tilt).T @ np.array([0.0, 0.0, -G])
    rate = from_euler_deg(*tilt).T @ np.array([5e-5, 0.0, -4e-5])
    gyro, accel = firmware.output(rate, force, gyro_offset, accel_offset)
    gyro_residual, accel_residual = gyro - rate, accel - force
    if np.max(np.abs(gyro_residual)) > 0.085 or np.max(np.abs(accel_residual)) > 0.98:
        return
    residuals = tuple(map(float, gyro_residual)), tuple(map(float, accel_residual))
    calibration = ImuCalibration(
        instance=2,
        parameters=ArduPilotParameters(2),
        gyro_offset_rad_s=gyro_offset,
        accel_offset_m_s2=accel_offset,
        accel_scale=scale,
        gyro_id=1,
        accel_id=1,
        orientation=rotation,
        zero_is_uncalibrated=True,
    )
    new_gyro, new_accel = offsets_after(calibration, *residuals)  # type: ignore[arg-type]
    gyro_then, accel_then = firmware.output(rate, force, new_gyro, new_accel)
    # What remains is the rounding of the offsets to 32 bits, and the micro-offset that stands for zero.
    np.testing.assert_allclose(gyro_then, rate, atol=1e-8)
    np.testing.assert_allclose(accel_then, force, atol=2e-6)

    changes = changes_for(calibration, *residuals)  # type: ignore[arg-type]
    gyro_step, accel_step = output_step(calibration, changes)
    np.testing.assert_allclose(gyro + gyro_step, gyro_then, atol=1e-8)
    np.testing.assert_allclose(accel + accel_step, accel_then, atol=1e-6)

    # The whole bias: the output without any offset, minus truth.
    bare_gyro, bare_accel = firmware.output(rate, force, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    bias_gyro, bias_accel = np.array(residuals) + np.split(calibration.subtracted(None), 2)
    np.testing.assert_allclose(bias_gyro, bare_gyro - rate, atol=1e-12)
    np.testing.assert_allclose(bias_accel, bare_accel - force, atol=1e-12)


@settings(max_examples=200)
@given(
    before=vectors(0.3),
    change=vectors(0.05),
    far_axis=st.sampled_from(range(3)),
    looks=st.lists(st.booleans(), min_size=2, max_size=2),
    in_use=vectors(0.0057),
    back=st.booleans(),
)
def test_by_way_of_one_far_value_no_vector_stays_mixed_whatever_the_firmware_reads_in_between(
    *, before: Vector, change: Vector, far_axis: int, looks: list[bool], in_use: Vector, back: bool
) -> None:
    after = tuple(f32(b + c) for b, c in zip(before, change, strict=True))
    names = ("X", "Y", "Z")
    changes = vector_changes(names, before, after, far_axis, FAR_GYRO_RAD_S)  # type: ignore[arg-type]
    if all(c.before == c.after for c in changes):
        return
    goal = [c.before if back else c.after for c in changes]
    stored = [c.after if back else c.before for c in changes]
    # What PX4 uses may differ from what it stores by as much as it ignores (here up to 0.0099 in all).
    used = np.array(stored) + np.array(in_use)
    looks = iter(looks)  # type: ignore[assignment]

    def write(axis: int, value: float | None, *, last: bool) -> None:
        nonlocal used
        assert value is not None
        stored[axis] = value
        # It looks when it looks, but surely some time after the last write of each step.
        if last or next(looks):  # type: ignore[call-overload]
            wanted = np.array(stored)
            if np.linalg.norm(wanted - used) > 0.01:
                used = wanted

    write(far_axis, changes[far_axis].via, last=True)
    for axis in range(3):
        if axis != far_axis:
            write(axis, goal[axis], last=False)
    write(far_axis, goal[far_axis], last=True)
    assert used.tolist() == goal
