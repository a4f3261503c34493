"""What the flying bench holds against `companion flight`: truth from what a log says that the sensor was told."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim.flying.injected import OFFSETS, Row, Told, recovered, rows_of, serial_rows, truth_of
from sim.imu_model import DEG_H, MG, Bias

STAGES = {"armed_s": 100.0, "motors_s": 100.5, "take_off_s": 107.0, "landing_s": None, "disarmed_s": None}


def said(**terms: float) -> dict[str, Any]:
    """A flight in which these terms were found, on every axis."""
    names = ("turn_on", "in_flight", "temperature", "motors", "vibration", "trend")
    axis = {name: {"value": terms[name], "sigma": 1.0} if name in terms else None for name in names}
    return {
        "stages": STAGES,
        "imus": [{"axes": [{"axis": f"gyro {k}", **axis} for k in "xyz"] + [{"axis": "accel z", **axis}]}],
    }


def test_a_step_at_the_motors_is_told_from_what_was_there_before() -> None:
    parameters = [
        (0.0, "SIM_GYR1_BIAS_Z", 50.0 * DEG_H),
        (0.0, "INS_GYROFFS_Z", 40.0 * DEG_H),
        (0.0, "SIM_ACC1_BIAS_Z", MG),
    ]
    parameters += [(104.0, "SIM_GYR1_BIAS_Z", 20.0 * DEG_H), (104.0, "SIM_ACC1_BIAS_Z", -4.0 * MG)]
    flown = Told("ardupilot", parameters, np.zeros((0, 2)))
    true = truth_of(flown, said(turn_on=0.0, in_flight=0.0, motors=0.0, trend=0.0), 180.0)
    assert true["gyro z"] == pytest.approx(
        {"turn_on": 10.0 * DEG_H, "in_flight": -20.0 * DEG_H, "motors": -30.0 * DEG_H, "trend": 0.0}, abs=1e-9
    )
    assert true["accel z"]["motors"] == pytest.approx(-5.0 * MG)
    assert true["gyro x"]["motors"] == 0.0


def test_warming_is_temperature_where_it_is_known_and_motors_where_not() -> None:
    """1 deg/h a kelvin, 30 degC that go to 40 at 60 s: the exponential by hand."""
    parameters = [(0.0, "SIM_IMUT1_GYR1_X", 1e6 * DEG_H), (0.0, "SIM_IMUT1_TMAX", 70.0), (0.0, "SIM_IMUT_TCONST", 60.0)]
    parameters += [(0.0, "SIM_IMUT_START", 30.0), (0.0, "SIM_IMUT_END", 40.0)]
    flown = Told("ardupilot", parameters, np.zeros((0, 2)))

    def degc(a: float, b: float) -> float:
        """Its mean."""
        return float(40.0 - 10.0 * 60.0 * (np.exp(-a / 60.0) - np.exp(-b / 60.0)) / (b - a))

    step = (degc(110.0, 170.0) - degc(70.0, 100.0)) * DEG_H
    known = truth_of(flown, said(turn_on=0.0, temperature=0.0, motors=0.0), 180.0)["gyro x"]
    assert known["temperature"] == pytest.approx(step, rel=1e-2)
    assert known["motors"] == pytest.approx(0.0, abs=1e-12)
    assert known["turn_on"] == pytest.approx((degc(70.0, 100.0) - 35.0) * DEG_H, rel=1e-2)
    assert truth_of(flown, said(motors=0.0), 180.0)["gyro x"]["motors"] == pytest.approx(step, rel=1e-2)


def test_a_slope_against_the_measured_level() -> None:
    parameters, levels = [], []
    for k in range(7):
        level, at_s = 2.0 + k % 3, 110.0 + 10.0 * k
        levels += [(at_s, level), (at_s + 9.999, level)]
        parameters.append((at_s, "SIM_ACC1_BIAS_Z", 0.5 * MG * level))
    flown = Told("ardupilot", parameters, np.array(levels))
    true = truth_of(flown, said(vibration=0.0, trend=0.0), 183.0)["accel z"]
    assert true == pytest.approx({"vibration": 0.5 * MG, "trend": 0.0}, abs=1e-3 * MG)


def test_px4_has_what_its_offsets_lack_and_leaves_small_changes_aside() -> None:
    gyro, accel = OFFSETS["px4"][:3], OFFSETS["px4"][3:]
    parameters = [(0.0, gyro[0], -0.002), (0.0, accel[2], 0.004), (104.0, accel[2], -0.03), (104.0, gyro[0], 0.006)]
    flown = Told("px4", parameters, np.zeros((0, 2)))
    left, _ = flown.left(np.array([50.0, 150.0]), 100.0)
    # The first gyro offset is taken, a change of it by 0.008 rad/s is not, nor 4 mm/s^2 at the start.
    assert left[:, 0] == pytest.approx([0.002, 0.002])
    assert left[:, 5] == pytest.approx([0.0, 0.03])


def test_the_table_counts_what_lies_within_two_sigma() -> None:
    true = {"gyro x": {"turn_on": 10.0 * DEG_H}, "gyro y": {}, "gyro z": {}, "accel z": {"turn_on": 3.0 * MG}}
    flight = said(turn_on=0.0)
    for axis, value, sigma in ((0, 13.0 * DEG_H, 2.0 * DEG_H), (3, 5.1 * MG, 1.0 * MG)):
        flight["imus"][0]["axes"][axis]["turn_on"] = {"value": value, "sigma": sigma}
    rows = rows_of(flight, true)
    assert [row[:2] for row in rows] == [("gyro x", "turn_on"), ("accel z", "turn_on")]
    assert np.array([row[2:] for row in rows]) == pytest.approx(np.array([[10.0, 13.0, 2.0], [3.0, 5.1, 1.0]]))
    lines = recovered(rows)
    assert lines[1].split() == ["turn-on,", "gyro", "x", "deg/h", "1", "10.00", "3.00", "2.00", "1", "of", "1", "1.5"]
    assert lines[-1] == "all: 1 of 2 (50.0%)"


def test_the_companions_own_imu_is_held_against_what_it_had() -> None:
    own = {
        "name": "own",
        "gyro_bias_rad_s": [110.0 * DEG_H, 0.0, 0.0], "gyro_sigma_use_rad_s": [20.0 * DEG_H] * 3,
        "accel_bias_m_s2": [9.0, 9.0, 2.0 * MG], "accel_sigma_use_m_s2": [0.3 * MG] * 3,
    }  # fmt: skip
    true = Bias(np.array([100.0, -30.0, 0.0]) * DEG_H, np.array([0.0, 0.0, 1.5]) * MG)
    rows = serial_rows({"imus": [{"name": "fc"}, own]}, true)
    x, y, z, vertical = (Row(row.axis, row.term, *np.round(row[2:], 9)) for row in rows)
    assert x == ("gyro x", "own_imu", 100.0, 110.0, 20.0)
    assert y == ("gyro y", "own_imu", -30.0, 0.0, 20.0)
    assert z == ("gyro z", "own_imu", 0.0, 0.0, 20.0)
    assert vertical == ("accel z", "own_imu", 1.5, 2.0, 0.3)
