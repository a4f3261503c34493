"""Physics against documented vectors, closed forms and independent constructions."""

from __future__ import annotations

import datetime
import json
import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from companion.estimation.solution.solve import accelerometer_bias, gyro_bias
from companion.physics import earth
from companion.physics.frames import body_from_ned, roll_pitch_from_up, rotation_matrix, skew
from companion.physics.gradienter import Law, attitude_from_readings, readings_from_up, up_in_sensor, up_jacobian
from companion.physics.units import DEG, DEG_H, MG
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
    accel = accelerometer_bias(
        np.array(case["mean_accel_frd_m_s2"]), up_in_sensor(law, case["qx_deg"], case["qy_deg"]), gravity
    )
    rate = body_from_ned(gamma, theta, case["heading_true_deg"] * DEG) @ earth.earth_rate_ned_rad_s(
        case["latitude_deg"]
    )
    gyro = gyro_bias(np.array(case["mean_gyro_frd_rad_s"]), rate)
    np.testing.assert_allclose(accel, case["bias_accel_frd_m_s2"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(gyro, case["bias_gyro_frd_rad_s"], rtol=0, atol=1e-15)


def test_there_are_vectors_of_both_laws_that_they_tell_apart() -> None:
    assert {case["gradienter_law"] for case in CASES} == {"axis", "slope"}
    assert len(CASES) == 60


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


def test_gravity_falls_by_31_5_micro_g_per_100_m() -> None:
    fall = earth.gravity_m_s2(45.0, 0.0) - earth.gravity_m_s2(45.0, 100.0)
    assert fall / MG * 1000 == pytest.approx(31.5, abs=0.1)


def test_declination_is_noaas_test_value() -> None:
    assert earth.magnetic_field(80.0, 0.0, 0.0, datetime.date(2025, 1, 1)).declination_deg == pytest.approx(
        1.28, abs=0.005
    )


def test_declination_outside_the_models_years_uses_the_nearest() -> None:
    late = earth.magnetic_field(40.0, 116.0, 0.0, datetime.date(2041, 1, 1)).declination_deg
    last = earth.magnetic_field(40.0, 116.0, 0.0, datetime.date(2029, 12, 31)).declination_deg
    assert late == pytest.approx(last, abs=0.01)


def test_earth_rate_on_the_tilted_example() -> None:
    # autopilots 9.3: pitch +5, roll -3, heading 40 deg at 40 N gives +9.64, -6.93, -9.24 deg/h.
    rate = body_from_ned(-3 * DEG, 5 * DEG, 40 * DEG) @ earth.earth_rate_ned_rad_s(40.0)
    np.testing.assert_allclose(rate / DEG_H, [9.64, -6.93, -9.24], atol=0.005)


def test_slope_law_by_the_liquids_surface() -> None:
    # The surface's slope along an axis is the ratio of that axis' gravity component to the one along z.
    for theta_deg, gamma_deg in ((10.0, 20.0), (-25.0, 5.0), (3.0, -29.0)):
        up = body_from_ned(gamma_deg * DEG, theta_deg * DEG, 0.0) @ np.array([0.0, 0.0, -1.0])
        x_deg, y_deg = math.atan2(-up[1], -up[2]) / DEG, math.atan2(up[0], -up[2]) / DEG
        theta, gamma = attitude_from_readings("slope", x_deg, y_deg)
        assert (theta / DEG, gamma / DEG) == pytest.approx((theta_deg, gamma_deg), abs=1e-12)


def test_the_wrong_law_costs_what_the_method_says() -> None:
    # sensors 2.6: the axis formula on a slope device turns (10, 20) deg into (10.63, 20.36).
    y_deg = math.atan(math.tan(10 * DEG) / math.cos(20 * DEG)) / DEG
    theta, gamma = attitude_from_readings("axis", 20.0, y_deg)
    assert (theta / DEG, gamma / DEG) == pytest.approx((10.63, 20.36), abs=0.005)


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


def test_skew_is_the_cross_product() -> None:
    a, b = np.array([1.0, -2.0, 0.5]), np.array([0.3, 4.0, -1.0])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))


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


def test_yaw_90_mounting_puts_the_sensors_front_to_the_right() -> None:
    np.testing.assert_array_equal(rotation_matrix("ROTATION_YAW_90") @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


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
