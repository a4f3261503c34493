"""ArduPilot's temperature correction, against figures worked out by hand and numpy's own polynomials."""

from __future__ import annotations

import numpy as np
import pytest

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import MeasuredBias, Point, PowerUp
from companion.estimation.solution.curve import Polynomial, of_curve
from companion.estimation.solution.prior import curve_of
from tests.unit.autopilot.test_ardupilot import IMU1, read

ON: dict[str, float] = dict.fromkeys(ArduPilotParameters(1).tcal, 0.0) | {
    "INS_TCAL1_ENABLE": 1.0,
    "INS_TCAL1_TMIN": 10.0,
    "INS_TCAL1_TMAX": 45.0,
    "INS_TCAL1_GYR1_X": 100.0,
    "INS_TCAL1_GYR2_X": 2.0,
    "INS_TCAL1_GYR3_Y": 0.5,
    "INS_TCAL1_ACC1_Z": 1000.0,
    "INS_GYR1_CALTEMP": 25.0,
    "INS_ACC1_CALTEMP": -300.0,
}


@pytest.mark.parametrize(
    ("degc", "gyro", "accel"),
    [
        # 100e-6 d + 2e-6 d^2 and 0.5e-6 d^3, d = 5 less d = -10; 1e-3 d, d = 5 less d = -25, for -300 is held at 10.
        (40.0, (550e-6 + 800e-6, 62.5e-6 + 500e-6, 0.0), (0.0, 0.0, 30e-3)),
        (25.0, (0.0, 0.0, 0.0), (0.0, 0.0, 15e-3)),
        (60.0, (1200e-6 + 800e-6, 500e-6 + 500e-6, 0.0), (0.0, 0.0, 35e-3)),
        (-20.0, (-1250e-6 + 800e-6, -7812.5e-6 + 500e-6, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_what_is_taken_off_at_a_temperature(
    degc: float, gyro: tuple[float, float, float], accel: tuple[float, float, float]
) -> None:
    calibration = read(IMU1 | ON | {"AHRS_ORIENTATION": 2, "INS_ACCSCAL_Z": 1.1})
    found = calibration.thermal.taken_off(degc)
    np.testing.assert_allclose(found[0], gyro, atol=1e-9)
    np.testing.assert_allclose(found[1], accel, atol=1e-7)
    # Nothing left in the output: the whole is what is taken off. Board x is the vehicle's y; scales come last.
    x, y, z, *force = calibration.subtracted(degc)
    assert (y, -x, z) == pytest.approx((0.001 + gyro[0], 0.002 + gyro[1], 0.003 + gyro[2]), abs=1e-9)
    assert force[2] == pytest.approx(1.1 * (0.3 + accel[2]), abs=1e-6)
    # Without a thermometer it is that at CALTEMP.
    assert calibration.subtracted(None)[:3] == pytest.approx((-0.002, 0.001, 0.003))


def test_switched_off_it_takes_nothing_off_whatever_the_rest_says() -> None:
    thermal = read(IMU1 | ON | {"INS_TCAL1_ENABLE": 0}).thermal
    assert not thermal.enabled_by
    assert not np.any(thermal.taken_off(40.0))


def test_somebody_who_sets_one_of_them_contradicts_what_is_known() -> None:
    calibration = read(IMU1 | ON)
    assert calibration.contradicts({"INS_TCAL1_GYR2_Z": 1.0})
    assert not calibration.contradicts({"INS_TCAL1_GYR2_Z": 0.0, "INS_TCAL2_GYR2_Z": 1.0})
    assert read(IMU1).contradicts({"INS_TCAL1_ENABLE": 1.0})


def test_names_from_the_fourth_instance_on_are_others_and_all_fit_into_a_message() -> None:
    four = ArduPilotParameters(4)
    assert (four.tcal_enable, four.gyro_caltemp, four.tcal_gyro[2][1]) == (
        "INS4_TCAL_ENABLE",
        "INS4_GYR_CALTEMP",
        "INS4_TCAL_GYR3_Y",
    )
    assert (ArduPilotParameters(2).accel_caltemp, ArduPilotParameters(2).tcal_accel[0][0]) == (
        "INS_ACC2_CALTEMP",
        "INS_TCAL2_ACC1_X",
    )
    assert max(len(name) for n in (1, 2, 3, 4, 5) for name in ArduPilotParameters(n).tcal) == 16


def test_a_polynomial_is_held_at_the_ends_of_its_span_and_can_be_nothing_anywhere() -> None:
    terms = ((1.0, 2.0, 3.0), (0.5, 0.0, -1.0), (0.25, 0.0, 0.0), (0.0, 0.125, 0.0))
    found = Polynomial(coefficients=terms, reference_degc=30.0, low_degc=20.0, high_degc=32.0)
    for degc in (-10.0, 20.0, 27.5, 32.0, 90.0):
        d = min(max(degc, 20.0), 32.0) - 30.0
        np.testing.assert_allclose(found.at(degc), [np.polyval([row[k] for row in terms[::-1]], d) for k in range(3)])
        np.testing.assert_allclose(found.zero_at(25.0).at(degc), found.at(degc) - found.at(25.0))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_curve_becomes_the_same_curve_in_the_sensors_axes(order: int) -> None:
    """Points of a known cubic through the fit: whatever that keeps its terms as, what comes out follows the truth."""
    slopes = np.array([[1e-5, -2e-5, 3e-5], [3e-7, 2e-7, -4e-7], [1e-8, -2e-8, 1e-8]])[:order]
    yaw_90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def truth(degc: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.asarray(sum(row * (degc - 22.0) ** (n + 1) for n, row in enumerate(slopes)))

    points = [
        Point(
            started_at="",
            unix_s=86400.0 * day,
            power_up=PowerUp(host=str(day), since_unix_s=None),
            temperature_degc=degc,
            up=(0.0, 0.0, -1.0),
            gyro=MeasuredBias(
                bias=(float(x), float(y), float(z)),
                sigma_stat=(1e-7,) * 3,
                sigma_use=(1e-7,) * 3,
                sigma_shared=(0.0,) * 3,
            ),
        )
        for day, start in enumerate(np.linspace(8.0, 40.0, 12).tolist())
        for degc in (start, start + 4.0, start + 8.0)
        for x, y, z in [0.01 + truth(degc)]
    ]
    curve = curve_of(points, "gyro", noise_profile("icm42688p").gyro)
    assert curve is not None
    found = of_curve(curve, yaw_90)
    assert (found.low_degc, found.high_degc) == (8.0, 48.0)
    for degc in (8.0, 20.0, 35.0, 48.0):
        np.testing.assert_allclose(found.at(degc) - found.at(30.0), yaw_90.T @ (truth(degc) - truth(30.0)), atol=1.5e-5)
    np.testing.assert_allclose(found.at(90.0), found.at(48.0))
    # Before a scale it is as much smaller.
    scale = (2.0, 1.0, 0.5)
    np.testing.assert_allclose(of_curve(curve, yaw_90, scale).at(20.0), found.at(20.0) / scale)
