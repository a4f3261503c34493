"""What several flights together say, against aircraft whose motors move their biases by what is known."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from companion.estimation.records.flight_evidence import Moved, moved, surely_moved
from companion.estimation.records.flight_record import AXES, Flight
from companion.physics.units import DEG_H, MG
from tests.support.flights import SIGMA, UNITS, imu_flight, kept_flight

GYRO_ID, ACCEL_ID = 2752772, 2753028


def flight(*step: float, **more: int | None) -> Flight:
    found = kept_flight("1", imu_flight(step=step or (0.0, 0.0, 0.0, 0.0))).flight
    return msgspec.structs.replace(found, **more)


def of(flights: list[Flight]) -> list[Moved]:
    return moved(flights, 1, 1, GYRO_ID, ACCEL_ID)


@pytest.mark.parametrize(("scatter", "least", "most"), [(1.0, 0.93, 0.98), (3.0, 0.85, 0.98)])
def test_the_mean_is_within_its_sigma_also_where_flights_scatter_more_than_theirs(
    scatter: float, least: float, most: float
) -> None:
    rng = np.random.default_rng(3)
    errors, within = [], []
    for _ in range(200):
        truth = rng.normal(0.0, 5.0, 4) * SIGMA
        flights = [flight(*(truth + scatter * rng.normal(size=4) * SIGMA)) for _ in range(6)]
        for k, one in enumerate(of(flights)):
            assert (one.axis, one.flights) == (AXES[k], 6)
            error, sigma = one.moves.value / UNITS[k] - truth[k], one.moves.sigma / UNITS[k]
            if k < 3:
                errors.append(error / SIGMA[k])
                within.append(abs(error) < 2.0 * sigma)
    assert least < np.mean(within) < most
    assert np.std(errors) == pytest.approx(scatter / np.sqrt(6.0), rel=0.1)


def test_what_all_flights_have_wrong_alike_is_not_averaged_away() -> None:
    (*_, accel) = of([flight()] * 100)
    assert accel.moves.sigma / MG == pytest.approx(np.hypot(0.06, 0.2))


def test_other_vehicles_other_sensors_and_other_imus_say_nothing_of_it() -> None:
    own, other = flight(), flight(100.0, 100.0, 100.0, 10.0)
    imu = other.imus[0]
    changed = [
        msgspec.structs.replace(other, system_id=2),
        msgspec.structs.replace(other, imus=(msgspec.structs.replace(imu, imu=2),)),
        msgspec.structs.replace(other, imus=(msgspec.structs.replace(imu, gyro_id=None, accel_id=7),)),
    ]
    assert of([own, *changed]) == of([own])
    assert moved([other], 1, 1, None, None) == []
    # Another gyro beside the same accelerometer: that one counts.
    half = msgspec.structs.replace(other, imus=(msgspec.structs.replace(imu, gyro_id=7),))
    assert [one.flights for one in of([own, half])] == [1, 1, 1, 2]
    # A log without parameters does not say whose it is.
    assert [one.flights for one in of([own, msgspec.structs.replace(other, system_id=None)])] == [2] * 4


def test_only_what_is_there_and_worth_it_is_said() -> None:
    shaken = flight(0.0, 25.0, 90.0, 1.0)
    assert surely_moved([shaken], shaken) == []
    (gyro_z,) = surely_moved([shaken] * 9, shaken)
    assert gyro_z.words == "9 flights: motors move IMU 1 gyro z by +90 ± 4 deg/h"
    assert gyro_z.moves.value == pytest.approx(90.0 * DEG_H)
