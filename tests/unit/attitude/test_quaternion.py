"""Quaternions against scipy's rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    conjugate,
    from_matrix,
    from_roll_pitch_yaw,
    from_rotation_vector,
    multiply,
    roll_pitch_yaw,
    rotate,
    shortest_arc,
    to_matrix,
)

angles = st.floats(-math.pi, math.pi)
components = st.floats(-10.0, 10.0)
vectors = st.tuples(components, components, components)


def scipy_of(q: Quaternion) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def same_rotation(a: Quaternion, b: Rotation) -> bool:
    return float((scipy_of(a) * b.inv()).magnitude()) < 1e-7


@given(vectors, vectors)
def test_products_and_rotations(a: Triple, b: Triple) -> None:
    p, q = from_rotation_vector(a), from_rotation_vector(b)
    left, right = Rotation.from_rotvec(a), Rotation.from_rotvec(b)
    assert same_rotation(p, left)
    assert same_rotation(multiply(p, q), left * right)
    assert same_rotation(conjugate(p), left.inv())
    assert rotate(p, b) == pytest.approx(left.apply(b), abs=1e-12)
    assert to_matrix(p) == pytest.approx(left.as_matrix(), abs=1e-12)


@given(vectors)
def test_matrices_of_every_shape(a: Triple) -> None:
    turn = Rotation.from_rotvec(a)
    assert same_rotation(from_matrix(turn.as_matrix()), turn)


@given(angles, st.floats(-1.55, 1.55), angles)
def test_aerospace_angles(roll: float, pitch: float, yaw: float) -> None:
    q = from_roll_pitch_yaw(roll, pitch, yaw)
    assert same_rotation(q, Rotation.from_euler("ZYX", [yaw, pitch, roll]))
    assert same_rotation(from_roll_pitch_yaw(*roll_pitch_yaw(q)), Rotation.from_euler("ZYX", [yaw, pitch, roll]))


@given(angles, angles, st.sampled_from([-0.5 * math.pi, 0.5 * math.pi]))
def test_straight_up_and_down_the_angles_still_name_the_attitude(roll: float, yaw: float, pitch: float) -> None:
    q = from_roll_pitch_yaw(roll, pitch, yaw)
    found = roll_pitch_yaw(q)
    assert all(map(math.isfinite, found))
    assert found[1] == pytest.approx(pitch, abs=1e-6)
    assert float((scipy_of(from_roll_pitch_yaw(*found)) * scipy_of(q).inv()).magnitude()) < 1e-5


@given(vectors, vectors)
def test_the_shortest_arc_takes_one_direction_to_the_other(a: Triple, b: Triple) -> None:
    q = shortest_arc(a, b)
    assert math.hypot(*q) == pytest.approx(1.0)
    if min(math.hypot(*a), math.hypot(*b)) < 1e-3:
        return
    there, wanted = np.array(rotate(q, a)) / math.hypot(*a), np.array(b) / math.hypot(*b)
    assert there == pytest.approx(wanted, abs=1e-4)


def test_opposite_directions_and_none() -> None:
    assert rotate(shortest_arc((0, 0, 1), (0, 0, -1)), (0, 0, 1)) == pytest.approx((0, 0, -1))
    assert rotate(shortest_arc((2, 0, 0), (-1, 0, 0)), (1, 0, 0)) == pytest.approx((-1, 0, 0))
    assert shortest_arc((0, 0, 0), (0, 0, 1)) == IDENTITY
