"""PX4's thermal compensation: our curves as its parameters, and the double's arithmetic (autopilots 10.2)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.autopilot.firmware.px4_thermal import NOT_STORED, polynomial_of, stored, values_of
from companion.calibration.temperature.polynomial import Polynomial
from sim.aircraft import VirtualAircraft
from sim.imu_model import DEG_H, ImuModel
from sim.px4.defaults import SIMULATED_IDS
from sim.px4.double import PX4Double
from sim.px4.thermal import Module

LINE, BEND, TURN = ((20.0, -12.0, 8.0), (0.5, 0.4, -0.3), (0.02, -0.015, 0.01))
"""deg/h a kelvin, square kelvin, cubic kelvin, about 25 degC."""
AT_30 = (215.0, -51.875, 33.75)
"""By hand, with a constant of 100, 0, 0 deg/h; a real PX4 took off 217, -29, 49, in looks that scatter by 5 to 20."""


def curve(cubes: tuple[float, float, float] = TURN) -> Polynomial:
    terms = [tuple(value * DEG_H for value in each) for each in ((100.0, 0.0, 0.0), LINE, BEND, cubes)]
    zero, one, two, three = ((x, y, z) for x, y, z in terms)
    return Polynomial(coefficients=(zero, one, two, three), reference_degc=25.0, low_degc=12.3, high_degc=41.9)


@pytest.mark.parametrize("zero_degc", [5.0, 20.0, 30.0])
def test_what_is_stored_follows_the_curve_over_its_span_and_is_nothing_where_it_was_wanted(zero_degc: float) -> None:
    # Cubes that PX4 keeps as they are: above 2^-23 rad/s.
    wanted = curve((0.05, -0.04, 0.03))
    found = stored(wanted, zero_degc)
    assert (found.low_degc, found.high_degc) == (float(np.float32(12.3)), float(np.float32(41.9)))
    np.testing.assert_allclose(found.at(zero_degc), 0.0, atol=0.03 * DEG_H)
    for degc in (0.0, 12.3, 18.0, 30.0, 41.9, 60.0):
        d, z = (min(max(t, 12.3), 41.9) - 25.0 for t in (degc, zero_degc))
        right = [
            a * (d - z) + b * (d**2 - z**2) + c * (d**3 - z**3)
            for a, b, c in zip(LINE, BEND, (0.05, -0.04, 0.03), strict=True)
        ]
        np.testing.assert_allclose(found.at(degc) / DEG_H, right, atol=0.1)


def test_coefficients_that_px4_would_lose_at_a_start_are_taken_over_by_the_lower_ones() -> None:
    # 0.0123 deg/h is half of what is lost: over half a span of 14.8 K a quarter of its cube, 10 deg/h to both sides.
    wanted = curve((0.0123, 0.002, 0.0))
    found = stored(wanted, 25.0)
    terms = np.ravel(found.coefficients)
    assert all(term == 0.0 or abs(term) > NOT_STORED for term in terms)
    assert all(float(np.float32(term)) == term for term in terms)
    off = np.array([found.at(t) - wanted.at(t) + wanted.at(25.0) for t in np.linspace(12.3, 41.9, 100)]) / DEG_H
    assert np.ptp(off, axis=0).max() < 0.0124 * 14.8**3 / 2.0 + 1.0
    without = np.array([0.0123 * (t - 27.1) ** 3 for t in np.linspace(12.3, 41.9, 100)])
    assert np.ptp(off[:, 0]) < 0.3 * np.ptp(without)


def test_the_parameters_tell_the_curve_again() -> None:
    found = stored(curve(), 20.0)
    values = values_of(2, 1310988, found)
    assert len(values) == 16
    assert (values["TC_G2_ID"], values["TC_G2_X1_2"]) == (1310988, found.coefficients[1][2])
    assert polynomial_of(2, values) == found


def double(module: Module, enable: int = 1) -> tuple[PX4Double, list[float]]:
    degc = [30.0]
    aircraft = VirtualAircraft(temperature_degc=lambda _t_s: degc[0])
    values = {} if module == "absent" else {"TC_G_ENABLE": enable, **values_of(1, SIMULATED_IDS[0], curve())}
    return PX4Double(aircraft, [ImuModel(aircraft, "perfect")], thermal=module, parameters=values), degc


def taken_deg_h(of: PX4Double) -> list[float]:
    of.thermal.poll(0.0)
    found: list[float] = (of.vehicle_imus[0].gyro.thermal / DEG_H).tolist()
    return found


def test_the_double_takes_off_what_the_firmware_takes_off() -> None:
    px4, degc = double("started")
    assert taken_deg_h(px4) == pytest.approx(AT_30, abs=1e-3)
    degc[0] = 30.9  # within a kelvin of what was published
    assert taken_deg_h(px4) == pytest.approx(AT_30, abs=1e-3)
    degc[0] = 31.1
    assert taken_deg_h(px4)[0] == pytest.approx(100.0 + 20.0 * 6.1 + 0.5 * 6.1**2 + 0.02 * 6.1**3, abs=1e-3)
    degc[0] = 80.0
    assert taken_deg_h(px4)[0] == pytest.approx(100.0 + 20.0 * 16.9 + 0.5 * 16.9**2 + 0.02 * 16.9**3, abs=1e-2)
    # Switched off, what was published last stays, until a boot.
    px4.parameters.set("TC_G_ENABLE", 0)
    degc[0] = 20.0
    assert taken_deg_h(px4)[0] > 600.0


@pytest.mark.parametrize(("module", "enable"), [("absent", 0), ("idle", 1), ("started", 0)])
def test_without_the_module_or_switched_off_it_takes_off_nothing(module: Module, enable: int) -> None:
    px4, _ = double(module, enable)
    assert taken_deg_h(px4) == [0.0, 0.0, 0.0]


def test_the_double_forgets_at_a_boot_what_hardly_differs_from_its_default() -> None:
    px4, _ = double("started")
    px4.parameters.set("TC_G1_X3_0", 1.1e-7)
    px4.parameters.set("TC_G1_X3_1", 1.3e-7)
    px4.parameters.save()
    px4.parameters.load()
    assert px4.parameters["TC_G1_X3_0"] == 0.0
    assert px4.parameters["TC_G1_X3_1"] == pytest.approx(1.3e-7)
    assert not math.isnan(px4.parameters["TC_G1_TREF"])
