"""PX4's thermal compensation: what its parameters take off, and the double's arithmetic (autopilots 10.2)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.autopilot.firmware.px4 import polynomial_of
from sim.aircraft import VirtualAircraft
from sim.imu_model import DEG_H, ImuModel
from sim.px4.defaults import SIMULATED_IDS
from sim.px4.double import PX4Double
from sim.px4.thermal import Module

LINE, BEND, TURN = ((20.0, -12.0, 8.0), (0.5, 0.4, -0.3), (0.02, -0.015, 0.01))
"""deg/h a kelvin, square kelvin, cubic kelvin, about 25 degC."""
AT_30 = (215.0, -51.875, 33.75)
"""By hand, with a constant of 100, 0, 0 deg/h; a real PX4 took off 217, -29, 49, in looks that scatter by 5 to 20."""


def values_of(sensor: int, device_id: int) -> dict[str, float]:
    """The parameters of that curve, by PX4's names."""
    own = f"TC_G{sensor}_"
    head = {f"{own}ID": device_id, f"{own}TREF": 25.0, f"{own}TMIN": 12.3, f"{own}TMAX": 41.9}
    powers = ((100.0, 0.0, 0.0), LINE, BEND, TURN)
    return head | {
        f"{own}X{power}_{axis}": term * DEG_H for power, terms in enumerate(powers) for axis, term in enumerate(terms)
    }


@pytest.mark.parametrize(("degc", "clipped"), [(30.0, 30.0), (12.3, 12.3), (5.0, 12.3), (60.0, 41.9)])
def test_the_parameters_tell_what_is_taken_off(degc: float, clipped: float) -> None:
    found = polynomial_of(2, values_of(2, 1310988)).at(degc) / DEG_H
    d = clipped - 25.0
    right = [
        c0 + c1 * d + c2 * d**2 + c3 * d**3 for c0, c1, c2, c3 in zip((100.0, 0.0, 0.0), LINE, BEND, TURN, strict=True)
    ]
    np.testing.assert_allclose(found, right, atol=1e-6)


def double(module: Module, enable: int = 1) -> tuple[PX4Double, list[float]]:
    degc = [30.0]
    aircraft = VirtualAircraft(temperature_degc=lambda _t_s: degc[0])
    values = {} if module == "absent" else {"TC_G_ENABLE": enable, **values_of(1, SIMULATED_IDS[0])}
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
