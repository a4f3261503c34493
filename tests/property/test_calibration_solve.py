"""Window to biases: symmetries for every pose, law and mounting, and the covariance."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.errors import CalibrationRefusedError
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import Window
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.estimation.solution.solve import ImuSolution, Solution, solve
from companion.physics.frames import Array
from companion.physics.units import DEG, DEG_H, MG
from tests.support.windows import about, ideal_window, ned_from_body

Law = Literal["axis", "slope", "euler"]
laws = st.sampled_from(["axis", "slope", "euler"])
tilts = st.floats(-30, 30)
headings = st.floats(0, 360)
latitudes = st.floats(-80, 80)
gyros = st.tuples(*[st.floats(-0.02, 0.02)] * 3).map(np.array)
accels = st.tuples(*[st.floats(-0.5, 0.5)] * 3).map(np.array)
turns = st.sampled_from(
    [np.eye(3), *(about(2, k * math.pi / 2) for k in (1, 2, 3)), about(2, 0.5) @ about(1, 0.2) @ about(0, -0.15)]
)

PLAIN = Whereabouts(latitude_deg=40.0, longitude_deg=116.0, height_m=50.0, source="test")


def _local(latitude_deg: float) -> LocalEarth:
    return local_earth(Whereabouts(latitude_deg=latitude_deg, longitude_deg=0.0, height_m=0.0, source="test"))


def _gradienter(law: Law, mounting: Array | None = None, sigma_deg: float = 0.01) -> GradienterModel:
    return GradienterModel(law, np.eye(3) if mounting is None else mounting, (0.0, 0.0), sigma_deg)


def _compass(mounting: Array | None = None, *, magnetic: bool = False) -> CompassModel:
    return CompassModel(magnetic, np.eye(3) if mounting is None else mounting, 0.0, 1.0)


def _only(solution: Solution) -> ImuSolution:
    (imu,) = solution.imus
    return imu


def _vectors(imu: ImuSolution) -> tuple[Array, Array]:
    assert imu.gyro_rad_s is not None
    assert imu.accel_m_s2 is not None
    return imu.gyro_rad_s, imu.accel_m_s2


@settings(max_examples=150)
@given(laws, tilts, tilts, headings, latitudes, gyros, accels, turns)
def test_ideal_sensors_give_the_true_biases_for_every_pose_law_and_mounting(
    law: Law, pitch: float, roll: float, heading: float, latitude: float, gyro: Array, accel: Array, mounting: Array
) -> None:
    local = _local(latitude)
    window = ideal_window(
        ned_body=ned_from_body(pitch, roll, heading),
        body_gradienter=mounting,
        law=law,
        latitude_deg=latitude,
        gravity_m_s2=local.gravity_m_s2,
        heading_deg=heading,
        gyro_bias=gyro,
        accel_bias=accel,
    )
    solution = solve(window, local, _gradienter(law, mounting), _compass(), What.BOTH)
    found_gyro, found_accel = _vectors(_only(solution))
    np.testing.assert_allclose(found_gyro, gyro, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found_accel, accel, rtol=0, atol=1e-9)
    assert solution.pose.theta_deg == pytest.approx(pitch, abs=1e-9)
    assert solution.pose.gamma_deg == pytest.approx(roll, abs=1e-9)


def _window(
    ned_body: Array | None = None, *, heading_deg: float = 40.0, latitude_deg: float = 40.0, gyro_bias: float = 0.0
) -> tuple[Window, LocalEarth]:
    local = local_earth(PLAIN) if latitude_deg == 40.0 else _local(latitude_deg)
    window = ideal_window(
        ned_body=ned_from_body(5.0, -3.0, 40.0) if ned_body is None else ned_body,
        body_gradienter=np.eye(3),
        law="slope",
        latitude_deg=latitude_deg,
        gravity_m_s2=local.gravity_m_s2,
        heading_deg=heading_deg,
        gyro_bias=np.full(3, gyro_bias),
        accel_bias=np.zeros(3),
    )
    return window, local


def test_covariance_is_that_of_a_monte_carlo() -> None:
    window, local = _window()
    assert window.tilt is not None
    assert window.heading is not None
    local = dataclasses.replace(local, gravity_sigma_m_s2=2e-3)
    claimed = _only(solve(window, local, _gradienter("slope", sigma_deg=0.05), _compass(), What.BOTH)).covariance
    random = np.random.default_rng(1)
    draws = []
    for _ in range(4000):
        x, y, h = random.standard_normal(3) * (0.05, 0.05, 1.0)
        moved = msgspec.structs.replace(
            window,
            tilt=msgspec.structs.replace(window.tilt, x_deg=window.tilt.x_deg + x, y_deg=window.tilt.y_deg + y),
            heading=msgspec.structs.replace(window.heading, heading_deg=window.heading.heading_deg + h),
        )
        other = dataclasses.replace(local, gravity_m_s2=local.gravity_m_s2 + random.standard_normal() * 2e-3)
        draws.append(np.concatenate(_vectors(_only(solve(moved, other, _gradienter("slope"), _compass(), What.BOTH)))))
    seen = np.cov(np.array(draws).T)
    # Scale to a correlation matrix, so that rad/s and m/s^2 weigh the same.
    scale = np.sqrt(np.diag(claimed))
    np.testing.assert_allclose(seen / np.outer(scale, scale), claimed / np.outer(scale, scale), atol=0.08)
    cross = claimed[:3, 3:] / np.outer(scale[:3], scale[3:])
    assert np.abs(cross).max() > 0.05  # one tilt error makes both: the cross terms are not to be forgotten


def test_level_sensitivities_are_the_methods() -> None:
    # Method 2.1: 17.5 micro-g per 0.001 deg of tilt; W cos L = 0.186 deg/h per degree of heading at 45 deg.
    window, local = _window(np.eye(3), heading_deg=0.0, latitude_deg=45.0)
    imu = _only(solve(window, local, _gradienter("slope", sigma_deg=0.001), _compass(), What.BOTH))
    np.testing.assert_allclose(imu.accel_sigma_use_m_s2[:2] / MG * 1000, 17.45, atol=0.03)
    assert imu.gyro_sigma_use_rad_s[1] / DEG_H == pytest.approx(0.186, abs=0.001)


def test_without_a_compass_the_horizontal_earth_rate_is_in_sigma() -> None:
    # Method 2.1: 7.5 deg/h rms per horizontal axis at 45 deg, 5.3 at 60.
    for latitude_deg, expected in ((45.0, 7.5), (60.0, 5.3)):
        window, local = _window(np.eye(3), heading_deg=0.0, latitude_deg=latitude_deg)
        solution = solve(window, local, _gradienter("slope"), None, What.BOTH)
        imu = _only(solution)
        np.testing.assert_allclose(imu.gyro_sigma_use_rad_s[:2] / DEG_H, expected, atol=0.05)
        assert solution.pose.psi_deg is None
        assert any("compass" in warning for warning in solution.warnings)
        # And the claim is true on average: north is anywhere, the mean of it is nothing.
        assert imu.gyro_rad_s is not None
        assert imu.gyro_rad_s[0] / DEG_H == pytest.approx(15.04 * math.cos(latitude_deg * DEG), abs=0.01)


def test_without_a_position_the_sigmas_say_so() -> None:
    window, _ = _window()
    known = _only(solve(window, local_earth(PLAIN), _gradienter("slope"), _compass(), What.BOTH))
    solution = solve(window, local_earth(Whereabouts()), _gradienter("slope"), _compass(magnetic=True), What.BOTH)
    unknown = _only(solution)
    assert solution.site.latitude_deg is None
    assert solution.site.gravity_m_s2 is None
    for imu, other in ((unknown, known),):
        gyro, accel = _vectors(imu)
        assert np.all(np.abs(gyro) <= 3 * imu.gyro_sigma_use_rad_s)
        assert np.all(np.abs(accel) <= 3 * imu.accel_sigma_use_m_s2)
        assert np.all(imu.gyro_sigma_use_rad_s > other.gyro_sigma_use_rad_s)
    assert sum("unknown" in warning for warning in solution.warnings) >= 2


def test_without_a_gradienter_gyros_only() -> None:
    window, local = _window()
    blind = msgspec.structs.replace(window, tilt=None)
    solution = solve(blind, local, None, _compass(), What.BOTH)
    imu = _only(solution)
    assert imu.accel_m_s2 is None
    assert imu.gyro_rad_s is not None
    np.testing.assert_allclose(imu.gyro_rad_s, 0.0, atol=1e-10)  # levelled by the accelerometers, here without bias
    assert solution.pose.theta_deg is None
    assert any("accelerometers not calibrated" in warning for warning in solution.warnings)
    with pytest.raises(CalibrationRefusedError, match="gradienter"):
        solve(blind, local, None, _compass(), What.ACCELEROMETERS)


def test_on_a_deck_no_gyro_is_calibrated_without_a_heading() -> None:
    window, local = _window(ned_from_body(1.0, 2.0, 30.0), heading_deg=30.0, latitude_deg=50.0, gyro_bias=0.001)
    blind = msgspec.structs.replace(window, heading=None)
    level = _gradienter("slope")
    with pytest.raises(CalibrationRefusedError, match="no compass on a deck: gyros not calibrated"):
        solve(blind, local, level, None, What.GYROS, "deck")
    both = solve(blind, local, level, None, What.BOTH, "deck")
    assert _only(both).gyro_rad_s is None
    assert _only(both).accel_m_s2 is not None
    assert both.unknown == (("fc", "gyro"),)
    assert any("deck" in words for words in both.warnings)
    seeing = solve(window, local, level, _compass(), What.BOTH, "deck")
    np.testing.assert_allclose(_vectors(_only(seeing))[0], np.full(3, 0.001), rtol=0, atol=1e-12)


def test_magnetic_heading_gets_the_declination() -> None:
    import datetime

    here = dataclasses.replace(PLAIN, date=datetime.date(2026, 5, 1))
    window, _ = _window(heading_deg=40.0 + 7.47)  # 7.47 degrees west at this place and time, by WMM2025
    solution = solve(window, local_earth(here), _gradienter("slope"), _compass(magnetic=True), What.BOTH)
    assert solution.pose.psi_deg == pytest.approx(40.0, abs=0.05)
    assert solution.site.declination_deg == pytest.approx(-7.47, abs=0.05)
