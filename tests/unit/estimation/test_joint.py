"""All IMUs and what was known of them as one estimate: against a stacked least squares, under turns and exchanges."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg

from companion.estimation.records.history import PowerUp
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.prior import Expectation, ExpectedImu, Prediction
from companion.estimation.solution.results import points
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.estimation.turning.turn import Turn
from companion.samples import Triad
from tests.prior_study import BY_READING, DEG, DEG_H, MG, G, imu_solution, shared_errors, solution

Array = NDArray[np.float64]
ZERO_RAD = 0.1 * DEG


def expected(value: Array, sigma: float, **others: Any) -> Prediction:
    x, y, z = (float(one) for one in value)
    known = {"limit": 4.5, "power_ups": 8, "weighs": True, **others}
    return Prediction(value=(x, y, z), variance=(sigma**2,) * 3, **known)


def imus(
    accels: Sequence[Array], shared: Shared, *, gyros: Sequence[Array] | None = None, own: float = 0.05 * MG
) -> list[ImuSolution]:
    """Solutions with white noise only, so that the best weights are those of the plain equations."""
    stat = np.array([20.0 * DEG_H] * 3 + [own] * 3)
    return [
        imu_solution(
            f"imu{k}",
            np.zeros(3) if gyros is None else gyros[k],
            accel,
            stat,
            shared.covariance + np.diag(np.square(stat)),
        )
        for k, accel in enumerate(accels)
    ]


def weighed(of: Solution, known: Sequence[ExpectedImu]) -> Solution:
    return weigh(of, Expectation(imus=tuple(known), zero_is_known=True))


def accel_of(imu: ImuSolution) -> Array:
    assert imu.accel_m_s2 is not None
    return imu.accel_m_s2


def accel_prior(imu: ImuSolution) -> dict[str, Any]:
    assert imu.prior is not None
    found = imu.prior["accel"]
    assert found is not None
    return found


def gyro_of(imu: ImuSolution) -> Array:
    assert imu.gyro_rad_s is not None
    return imu.gyro_rad_s


# --- the algebra


@pytest.mark.parametrize("same", [0.0, 0.3, 1.0])
def test_it_is_the_least_squares_solution_of_the_stacked_system(same: float) -> None:
    random = np.random.default_rng(5)
    shared = shared_errors(ZERO_RAD)
    tilt = BY_READING @ random.normal(0, ZERO_RAD, 2)
    accels = [random.normal(0, 2 * MG, 3) for _ in range(3)]
    priors = [accel + same * tilt + random.normal(0, 0.3 * MG, 3) for accel in accels]
    other_rad, sigma, own = 0.02 * DEG, 0.4 * MG, 0.05 * MG
    of = solution(imus([accel + tilt for accel in accels], shared), shared)
    known = [
        ExpectedImu(name=f"imu{k}", earlier={"accel": expected(prior, sigma, same_zero=same, other_zero_rad=other_rad)})
        for k, prior in enumerate(priors)
    ]
    found = weighed(of, known)
    assert found.doubts == ()
    # Unknowns: three biases, today's zero, the other zeros' error. Every row divided by its sigma.
    rows, right = [], []

    def row(coefficients: dict[int, Array], value: Array, by: float) -> None:
        block = np.zeros((len(value), 13))
        for column, matrix in coefficients.items():
            block[:, column : column + matrix.shape[1]] = matrix
        rows.append(block / by)
        right.append(value / by)

    for k in range(3):
        row({3 * k: np.eye(3), 9: BY_READING}, accel_of(of.imus[k]), own)
        row({3 * k: np.eye(3), 9: same * BY_READING, 11: BY_READING}, priors[k], sigma)
    row({9: np.eye(2)}, np.zeros(2), ZERO_RAD)
    row({11: np.eye(2)}, np.zeros(2), other_rad)
    stacked = np.vstack(rows)
    best = linalg.lstsq(stacked, np.concatenate(right))[0]
    covariance = linalg.inv(stacked.T @ stacked)
    for k, imu in enumerate(found.imus):
        np.testing.assert_allclose(accel_of(imu), best[3 * k : 3 * k + 3], atol=1e-6 * MG)
        np.testing.assert_allclose(
            imu.covariance[3:, 3:], covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], atol=1e-6 * MG**2
        )
        prior = accel_prior(imu)
        assert prior["used"]
        np.testing.assert_allclose(prior["measured_m_s2"], accel_of(of.imus[k]))
    if same == 1.0:
        # What is the same in all of them is not averaged away: the zero's error stays as it was.
        assert found.imus[0].accel_sigma_use_m_s2[0] > 0.95 * G * ZERO_RAD
    if same == 0.0:
        # Three IMUs tell the tilt better than the gradienter does.
        assert found.imus[0].accel_sigma_use_m_s2[0] < 0.4 * G * ZERO_RAD


def test_a_cautious_sigma_of_the_zero_is_no_reason_to_believe_the_past() -> None:
    shared = shared_errors(ZERO_RAD)
    of = solution(imus([np.array([1.5, 0.0, 0.0]) * MG], shared), shared)
    known = (ExpectedImu(name="imu0", earlier={"accel": expected(np.zeros(3), 0.4 * MG, other_zero_rad=0.01 * DEG)}),)
    guessed = weigh(of, Expectation(imus=known, zero_is_known=False))
    vouched = weigh(of, Expectation(imus=known, zero_is_known=True))
    assert accel_of(guessed.imus[0])[0] > 1.49 * MG
    assert accel_of(vouched.imus[0])[0] < 0.2 * MG


def test_what_a_compass_does_not_know_of_a_turn_earlier_power_ups_know_better() -> None:
    random, scatter, turns = np.random.default_rng(8), 70.0 * DEG_H, 70.0 * DEG_H
    shared = shared_errors(ZERO_RAD)
    shared.covariance[2, 2] += turns**2
    errors, sigmas = [], []
    for _ in range(300):
        # Both gyros of an aircraft that turns, or not, by as much as its compass cannot exclude.
        biases, turn = random.normal(0.0, scatter, (2, 3)), np.array([0.0, 0.0, random.normal(0.0, turns)])
        read = [bias + turn + random.normal(0.0, 20.0 * DEG_H, 3) for bias in biases]
        of = solution(imus([np.zeros(3)] * 2, shared, gyros=read), shared)
        of = dataclasses.replace(of, turn=Turn(sigma_rad_s=turns, by="compass"))
        known = [ExpectedImu(name=f"imu{k}", earlier={"gyro": expected(np.zeros(3), scatter)}) for k in range(2)]
        for imu, bias in zip(weighed(of, known).imus, biases, strict=True):
            errors.append((gyro_of(imu) - bias)[2])
            sigmas.append(imu.gyro_sigma_use_rad_s[2])
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert rms == pytest.approx(float(np.mean(sigmas)), rel=0.1)
    # Of two gyros' sums and differences: 1 / (1/70^2 + 1/(2 70^2 + 20^2)), and 1 / (1/70^2 + 1/20^2).
    together, apart = 1 / (1 / 70**2 + 1 / (2 * 70**2 + 20**2)), 1 / (1 / 70**2 + 1 / 20**2)
    assert float(np.mean(sigmas)) / DEG_H == pytest.approx(np.sqrt((together + apart) / 2.0), rel=0.01)


# --- whose fault a contradiction is


def doubted(
    shifts: Sequence[Array], *, triad: Triad = "accel", sigmas: Sequence[float] | None = None, **others: Any
) -> Solution:
    """IMUs whose readings differ by these shifts (mg, or deg/h) from what was known of each."""
    unit = MG if triad == "accel" else DEG_H
    shared = shared_errors(0.05 * DEG, gravity_sigma=0.03 * MG)
    moved = [np.asarray(shift) * unit for shift in shifts]
    nothing = [np.zeros(3)] * len(shifts)
    accels, gyros = (moved, nothing) if triad == "accel" else (nothing, moved)
    of = solution(imus(accels, shared, gyros=gyros), shared)
    usual = [0.3 if triad == "accel" else 60.0] * len(shifts) if sigmas is None else sigmas
    known = []
    for k, sigma in enumerate(usual):
        one = expected(np.zeros(3), sigma * unit, **{"same_zero": 1.0 if triad == "accel" else 0.0, **others})
        known.append(ExpectedImu(name=f"imu{k}", earlier={triad: one}))
    return weighed(of, known)


def tilted(x_deg: float, y_deg: float) -> Array:
    return np.asarray(BY_READING @ np.array([x_deg, y_deg]) * DEG / MG)


def test_nothing_is_doubted_while_all_is_usual() -> None:
    assert doubted([np.array([0.3, -0.5, 0.2]), np.array([-0.4, 0.1, 0.0])]).doubts == ()


def test_all_accelerometers_off_by_one_tilt_are_the_gradienters_fault() -> None:
    found = doubted([tilted(0.2, -0.25) + 0.2, tilted(0.2, -0.25) - 0.1, tilted(0.2, -0.25)])
    (doubt,) = found.doubts
    assert doubt.cause == "gradienter"
    assert doubt.names == ("imu0", "imu1", "imu2")
    assert "moved by 0.3" in doubt.words
    assert "x +0.2" in doubt.words
    assert "y -0.2" in doubt.words
    assert "align zero" in doubt.words
    assert doubt.words in found.warnings
    assert not any(accel_prior(imu)["used"] for imu in found.imus)


def test_one_accelerometer_off_while_the_others_agree_is_that_one() -> None:
    found = doubted([tilted(0.2, -0.25), np.zeros(3), np.full(3, 0.1)])
    (doubt,) = found.doubts
    assert (doubt.cause, doubt.names) == ("imu", ("imu0",))
    assert "imu1, imu2 agrees" in doubt.words
    assert doubt.words in found.imus[0].warnings
    assert found.imus[1].warnings == ()
    # Of two, too: the other one knows that the tilt has not changed.
    (doubt,) = doubted([np.zeros(3), tilted(0.3, 0.0)]).doubts
    assert (doubt.cause, doubt.names) == ("imu", ("imu1",))


def test_what_is_unusual_and_no_contradiction_yet_takes_no_part() -> None:
    usual, unusual = doubted([np.full(3, 80.0)], triad="gyro"), doubted([np.full(3, 160.0)], triad="gyro")
    assert usual.doubts == unusual.doubts == ()
    priors = [imu.prior["gyro"] for found in (usual, unusual) for imu in found.imus if imu.prior]
    assert [prior["used"] for prior in priors if prior] == [True, False]


def test_where_the_others_cannot_tell_both_are_said() -> None:
    (doubt,) = doubted([tilted(0.2, -0.25), tilted(0.1, 0.0)], sigmas=[0.3, 20.0]).doubts
    assert (doubt.cause, doubt.names) == ("unclear", ("imu0",))
    assert "or the gradienter has moved" in doubt.words
    causes = [doubted([shift]).doubts[0].cause for shift in (tilted(0.2, -0.25), np.array([3.0, 0.0, 4.0]))]
    assert causes == ["unclear", "imu"], "no tilt makes the second"


def test_all_verticals_off_alike_are_the_places_fault() -> None:
    found = doubted([np.array([0.0, 0.0, -2.5]), np.array([0.1, 0.0, -2.6])])
    (doubt,) = found.doubts
    assert doubt.cause == "gravity"
    assert "height and latitude" in doubt.words
    # Up is -z: the readings have grown.
    assert "+2.5 mg" in doubt.words or "+2.6 mg" in doubt.words


def test_all_gyros_off_alike_turn() -> None:
    turn = np.array([100.0, -200.0, 600.0])
    (doubt,) = doubted([turn, turn + 20.0], triad="gyro").doubts
    assert doubt.cause == "turn"
    (doubt,) = doubted([turn, np.zeros(3)], triad="gyro").doubts
    assert (doubt.cause, doubt.names) == ("imu", ("imu0",))


# --- what later calibrations know


def test_what_is_remembered_is_what_was_measured_not_what_became_of_it() -> None:
    shared = shared_errors(ZERO_RAD, gravity_sigma=0.3 * MG)
    of = solution(imus([np.ones(3) * MG], shared), shared)
    known = [ExpectedImu(name="imu0", earlier={"accel": expected(np.zeros(3), 0.3 * MG)})]
    found = weighed(of, known)
    assert abs(accel_of(found.imus[0])[0]) < 0.9 * MG
    kept = points(
        of,
        found.doubts,
        started_at="now",
        unix_s=1.0,
        power_ups={"imu0": PowerUp(host="here", since_unix_s=None)},
        zero="zero",
    )["imu0"]
    assert kept.accel is not None
    np.testing.assert_allclose(kept.accel.bias, MG)
    assert kept.accel.sigma_use == (0.000490333,) * 3  # 0.05 mg, in 9 decimals
    np.testing.assert_allclose(kept.accel.sigma_shared, [0.0, 0.0, 0.3 * MG], atol=1e-9)
    assert kept.zero_sigma_rad == ZERO_RAD


# --- what a solution says of the errors in common
