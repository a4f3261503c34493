"""Physics against documented vectors, closed forms and independent constructions."""

from __future__ import annotations

import datetime
import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from companion.physics import earth
from companion.physics.frames import body_from_ned, roll_pitch_from_up, rotation_matrix
from companion.physics.gradienter import Law, attitude_from_readings, readings_from_up, up_in_sensor, up_jacobian
from companion.physics.units import DEG
from companion.rotations import ROTATION_NAMES
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import Gradienter as SimGradienter
from sim.scenario import site_at

CASES = json.loads((Path(__file__).parents[2] / "vectors" / "method.json").read_text())["cases"]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['gradienter_law']} {case['theta_deg']:.1f}")
def test_known_poses_return_the_documented_biases(case: dict[str, Any]) -> None:
    law = cast("Law", case["gradienter_law"])
    theta, gamma = attitude_from_readings(law, case["qx_deg"], case["qy_deg"])
    assert theta / DEG == pytest.approx(case["theta_deg"], abs=1e-10)
    assert gamma / DEG == pytest.approx(case["gamma_deg"], abs=1e-10)
    gravity = earth.gravity_m_s2(case["latitude_deg"], case["height_m"])
    assert gravity == pytest.approx(case["gravity_m_s2"], abs=1e-12)
    accel = np.array(case["mean_accel_frd_m_s2"]) - gravity * up_in_sensor(law, case["qx_deg"], case["qy_deg"])
    rate = body_from_ned(gamma, theta, case["heading_true_deg"] * DEG) @ earth.earth_rate_ned_rad_s(
        case["latitude_deg"]
    )
    gyro = np.array(case["mean_gyro_frd_rad_s"]) - rate
    np.testing.assert_allclose(accel, case["bias_accel_frd_m_s2"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(gyro, case["bias_gyro_frd_rad_s"], rtol=0, atol=1e-15)


# Its own inverse.
FRD_FROM_RFU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def test_body_matrix_is_the_corrected_equation_5_in_rfu() -> None:
    t, g, p = 0.3, -0.7, 2.1
    st, ct, sg, cg, sp, cp = (f(x) for x in (t, g, p) for f in (math.sin, math.cos))
    rfu = np.array(
        [
            [cg * cp + sg * st * sp, -cg * sp + sg * st * cp, -sg * ct],
            [ct * sp, ct * cp, st],
            [sg * cp - cg * st * sp, -sg * sp - cg * st * cp, cg * ct],
        ]
    )
    np.testing.assert_allclose(FRD_FROM_RFU @ rfu @ FRD_FROM_RFU, body_from_ned(g, t, p), atol=1e-15)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "expected"),
    [(0.0, 0.0, 9.7803253359), (90.0, 0.0, 9.8321849379), (45.0, 0.0, 9.806197769), (40.0, 50.0, 9.801543)],
)
def test_gravity_of_wgs_84(latitude_deg: float, height_m: float, expected: float) -> None:
    assert earth.gravity_m_s2(latitude_deg, height_m) == pytest.approx(expected, abs=1e-6)


def test_declination_outside_the_models_years_uses_the_nearest() -> None:
    late = earth.magnetic_field(40.0, 116.0, 0.0, datetime.date(2041, 1, 1)).declination_deg
    last = earth.magnetic_field(40.0, 116.0, 0.0, datetime.date(2029, 12, 31)).declination_deg
    assert late == pytest.approx(last, abs=0.01)


def test_axis_readings_that_cannot_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot belong together"):
        attitude_from_readings("axis", 60.0, 50.0)


@pytest.mark.parametrize("law", ["axis", "slope", "euler"])
def test_up_jacobian_agrees_with_finite_differences(law: Law) -> None:
    step_deg = 1e-4
    for x_deg, y_deg in ((0.0, 0.0), (5.0, -3.0), (-20.0, 25.0), (29.0, 31.0)):
        numeric = np.column_stack(
            [
                (up_in_sensor(law, x_deg + dx, y_deg + dy) - up_in_sensor(law, x_deg - dx, y_deg - dy))
                / (2 * step_deg * DEG)
                for dx, dy in ((step_deg, 0.0), (0.0, step_deg))
            ]
        )
        np.testing.assert_allclose(up_jacobian(law, x_deg, y_deg), numeric, atol=1e-8)


def test_roll_and_pitch_come_back_from_up() -> None:
    up = body_from_ned(-0.4, 0.6, 1.9) @ np.array([0.0, 0.0, -1.0])
    assert roll_pitch_from_up(up) == pytest.approx((-0.4, 0.6))


def test_named_rotations_are_proper_and_as_the_dialect_describes_them() -> None:
    # An independent construction: rotate about fixed axes, roll first, then pitch, then yaw.
    def about(axis: int, angle_deg: float) -> np.ndarray[Any, np.dtype[np.float64]]:
        c, s = math.cos(angle_deg * DEG), math.sin(angle_deg * DEG)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        m = np.eye(3)
        m[i, i], m[i, j], m[j, i], m[j, j] = c, -s, s, c
        return m

    for name in ROTATION_NAMES:
        words = name.split("_")[1:]
        angle = dict(zip(words[::2], words[1::2], strict=False))
        expected = (
            about(2, {"293": 293.3}.get(angle.get("YAW", "0"), float(angle.get("YAW", 0))))
            @ about(1, {"68": 68.8}.get(angle.get("PITCH", "0"), float(angle.get("PITCH", 0))))
            @ about(0, float(angle.get("ROLL", 0)))
        )
        np.testing.assert_allclose(rotation_matrix(name), expected, atol=1e-12)


def test_rotation_numbers_are_mavlinks() -> None:
    from pymavlink.dialects.v20 import ardupilotmega

    described = ardupilotmega.enums["MAV_SENSOR_ORIENTATION"]
    for number, name in enumerate(ROTATION_NAMES):
        assert described[number].name == name.replace("ROTATION_", "MAV_SENSOR_ROTATION_")


@pytest.mark.parametrize("law", ["axis", "slope", "euler"])
def test_readings_are_those_of_the_simulator_and_lead_back(law: Law) -> None:
    rng = np.random.default_rng(8)
    for pitch, roll in rng.uniform(-35.0, 35.0, (50, 2)):
        aircraft = VirtualAircraft(Pose(pitch, roll, 12.0), site_at(40.0, 116.0, 50.0))
        force = aircraft.truth_at(0.0).force_m_s2
        up = force / aircraft.site.gravity_m_s2
        readings, others = readings_from_up(law, np.array([force, -2.0 * force]))
        assert others == pytest.approx(readings_from_up(law, -up))
        assert readings == pytest.approx(SimGradienter(aircraft, law=law).tilt_deg(np.array([0.0]))[0], abs=1e-9)
        assert up_in_sensor(law, *readings) == pytest.approx(up, abs=1e-12)
