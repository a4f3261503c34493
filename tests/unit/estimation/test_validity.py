"""When a calibration no longer counts (method 2.2 and 3.2)."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from companion.config.sections import AllanModel, Calibration
from companion.estimation.noise.allan import PROFILES, predicted_sigma
from companion.estimation.records.validity import DRIFT_SIGMAS, Held, Present, Why, age_limit_s, judge, worth_writing
from companion.physics.units import DEG_H
from companion.samples import Vector
from tests.support.histories import imu_record

GYRO = PROFILES["icm42688p"].gyro
LIMITS = Calibration(max_age_min=30.0, max_temperature_change_degc=3.0)
SIGMA = (5.0 * DEG_H,) * 3
HELD = Held(
    calibrated_s=0.0,
    confirmed_s=0.0,
    temperature_degc=25.0,
    sigma_use=SIGMA,
    sigma=SIGMA,
    expected=(0.0, 0.0, 0.0),
    seen=True,
    averaged_s=30.0,
)
OWN = msgspec.structs.replace(HELD, expected=(100.0 * DEG_H, 0.0, 0.0))
"""An IMU that nobody corrects: its whole bias is expected."""


def whys(
    held: Held = HELD,
    now_s: float = 10.0,
    temperature_degc: float | None = 25.0,
    present: Present | None = None,
    drift: tuple[Vector, Vector] | None = None,
) -> set[Why]:
    found = judge(
        ("fc", "gyro"), held, GYRO, LIMITS, now_s=now_s, temperature_degc=temperature_degc, present=present, drift=drift
    )
    return {objection.why for objection in found}


def output(x_deg_h: float) -> Present:
    return Present(residual=(x_deg_h * DEG_H, 0.0, 0.0), sigma_use=SIGMA, sigma=SIGMA)


@pytest.mark.parametrize(
    ("seen", "found"),
    [
        ({}, set()),
        ({"now_s": 1799.0}, set()),
        ({"now_s": 1801.0}, {Why.OLD}),
        ({"temperature_degc": 27.9}, set()),
        ({"temperature_degc": 28.1}, {Why.TEMPERATURE}),
        ({"temperature_degc": 21.9}, {Why.TEMPERATURE}),
        ({"temperature_degc": None}, set()),
        # sqrt(5^2 + 5^2) deg/h times three is 21.2 deg/h.
        ({"present": output(21.0)}, set()),
        ({"present": output(-21.4)}, {Why.RESIDUAL}),
        ({"held": OWN, "present": output(101.0)}, set()),
        ({"held": OWN, "present": output(0.0)}, {Why.RESIDUAL}),
        ({"held": msgspec.structs.replace(HELD, seen=False)}, {Why.UNSEEN}),
    ],
)
def test_age_temperature_residual_and_effect_are_judged(seen: dict[str, Any], found: set[Why]) -> None:
    assert whys(**seen) == found


def test_where_the_curve_over_temperature_is_known_it_says_how_far_the_bias_is_off() -> None:
    def by(mean_deg_h: float, sigma_deg_h: float) -> set[Why]:
        mean, variance = mean_deg_h * DEG_H, (sigma_deg_h * DEG_H) ** 2
        return whys(temperature_degc=35.0, drift=((0.0, mean, 0.0), (variance,) * 3))

    # sigma is 5 deg/h: twice that may be missing.
    assert by(8.0, 4.0) == set()
    assert by(-9.0, 5.0) == {Why.TEMPERATURE}
    assert by(0.0, 11.0) == {Why.TEMPERATURE}
    drift = (90.0 * DEG_H, 0.0, 0.0), (0.0,) * 3
    (objection,) = judge(("fc", "gyro"), HELD, GYRO, LIMITS, now_s=10.0, temperature_degc=20.0, drift=drift)
    assert objection.words == "gyro fc: about 90 deg/h off, 5 K colder since calibration"


@pytest.mark.parametrize("profile", PROFILES.values(), ids=lambda profile: profile.name)
def test_the_age_limit_is_where_the_expected_wandering_reaches_two_sigma(profile: object) -> None:
    gyro = profile.gyro  # type: ignore[attr-defined]
    sigma = predicted_sigma(gyro, 30.0, 180.0)
    limit_s = age_limit_s(gyro, (sigma,) * 3, 30.0)
    wandering = predicted_sigma(AllanModel(0.0, gyro.flicker, gyro.walk), 30.0, limit_s)
    assert wandering == pytest.approx(DRIFT_SIGMAS * sigma, rel=0.02)
    assert limit_s > 180.0  # what was promised for the next 180 s must hold so long


def test_a_write_is_worth_it_beyond_two_sigma_and_beyond_the_floor() -> None:
    assert not worth_writing(output(9.9), None, 0.0)
    assert worth_writing(output(10.1), None, 0.0)
    assert not worth_writing(output(10.1), None, 12.0 * DEG_H)
    # What is in force was not known any better: sqrt(5^2 + 5^2) deg/h times two is 14.1.
    assert not worth_writing(output(14.0), HELD, 0.0)
    assert worth_writing(output(-14.3), HELD, 0.0)
    assert not worth_writing(output(100.0), OWN, 0.0)


def test_a_warm_up_to_come_is_in_the_promise_and_in_no_comparison() -> None:
    wide = (200.0 * DEG_H,) * 3
    young = msgspec.structs.replace(HELD, sigma_use=wide)
    assert whys(young) == whys(HELD)
    off = msgspec.structs.replace(output(60.0), sigma_use=wide)
    assert whys(young, present=off) == {Why.RESIDUAL}
    assert worth_writing(off, young, 0.0)
    assert worth_writing(off, None, 0.0)
    assert age_limit_s(GYRO, young.sigma, 30.0) == age_limit_s(GYRO, HELD.sigma, 30.0)


@pytest.mark.parametrize("coarse_deg_h", [5.0, 12.0, 30.0])
def test_offsets_left_unchanged_keep_the_sigma_of_the_better_measurement(coarse_deg_h: float) -> None:
    """Offsets known to 12 deg/h are measured again: drawn errors stay within the sigma that is stated."""
    fine, random = 12.0, np.random.default_rng(11)
    before = msgspec.structs.replace(imu_record(), gyro_sigma_use_rad_s=(fine * DEG_H,) * 3)
    error = random.normal(0.0, fine, (3000, 3))
    residual = error + random.normal(0.0, coarse_deg_h, error.shape)
    said = []
    for row in residual * DEG_H:
        again = msgspec.structs.replace(
            before,
            gyro_sigma_stat_rad_s=(coarse_deg_h * DEG_H,) * 3,
            gyro_sigma_use_rad_s=(coarse_deg_h * DEG_H,) * 3,
            residual_gyro_rad_s=(row[0], row[1], row[2]),
            unchanged=("gyro",),
        )
        said.append(again.confirming(before).sigma_in_force("gyro") or ())
    sigma = np.array(said) / DEG_H
    assert 0.95 < np.mean(np.abs(error) < 2.0 * sigma) < 0.995
    assert np.sqrt(np.mean(np.square(sigma))) < 1.3 * fine
