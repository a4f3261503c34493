"""A real IMU moved by hand in front of cameras (BROAD): the optical attitude stands in for gradienter and compass.

At rest before the movement it says how the sensor stands, so the biases can be found as in the field; during the
movement it is the judge. Method 2.3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from companion.attitude.estimator import AttitudeEstimator, AttitudeSettings
from companion.attitude.quaternion import Quaternion, from_matrix
from companion.attitude.strapdown import Strapdown
from companion.estimation.noise.allan import noise_profile
from companion.physics.units import DEG_H
from companion.samples import ImuSample
from tests.support.recordings import shared

Floats = NDArray[np.float64]

GRAVITY = 9.81
FLIP = np.array([1.0, -1.0, -1.0])
"""Forward-left-up and east-north-up into forward-right-down and a frame with its third axis down."""


class RecordingTrial(NamedTuple):
    t_s: Floats
    rate: Floats
    force: Floats
    attitude: Floats
    """Matrices from body FRD into the frame with its third axis down (n, 3, 3)."""
    judged: NDArray[np.int64]
    """Samples of the movement with an optical attitude."""
    gyro_bias: Floats
    accel_bias: Floats
    start: int


@pytest.fixture(scope="module")
def trial() -> RecordingTrial:
    h5py = pytest.importorskip("h5py", reason="h5py reads this recording")
    with h5py.File(shared("broad/02_undisturbed_slow_rotation_B.hdf5")) as file:
        rate, force = file["imu_gyr"][:] * FLIP, file["imu_acc"][:] * FLIP
        optical, movement = file["opt_quat"][:], file["movement"][:].ravel().astype(bool)
        step_s = float(1.0 / file.attrs["sampling_rate"])
    seen = np.isfinite(optical).all(axis=1)
    turns = Rotation.from_quat(np.where(seen[:, None], optical, [1.0, 0.0, 0.0, 0.0])[:, [1, 2, 3, 0]]).as_matrix()
    attitude = np.einsum("i,nij,j->nij", FLIP, turns, FLIP)
    moving = np.flatnonzero(movement)
    rest = np.flatnonzero(seen[: moving[0]])
    rest = rest[(rest * step_s > 1.0) & (rest * step_s < moving[0] * step_s - 1.0)]
    assert len(rest) * step_s > 20.0
    up = attitude[rest].transpose(0, 2, 1) @ np.array([0.0, 0.0, -GRAVITY])
    start = int(moving[0] - 0.5 / step_s)
    assert seen[start]
    return RecordingTrial(
        np.arange(len(rate), dtype=np.float64) * step_s,
        rate,
        force,
        attitude,
        moving[seen[moving]],
        rate[rest].mean(axis=0),
        (force[rest] - up).mean(axis=0),
        start,
    )


def samples(trial: RecordingTrial) -> list[ImuSample]:
    last = int(trial.judged[-1])
    rows = zip(
        trial.t_s[trial.start + 1 : last + 1].tolist(),
        trial.rate[trial.start + 1 : last + 1].tolist(),
        trial.force[trial.start + 1 : last + 1].tolist(),
        strict=True,
    )
    return [ImuSample(t_s, (a, b, c), (d, e, f)) for t_s, (a, b, c), (d, e, f) in rows]


def judge(trial: RecordingTrial, found: list[Quaternion]) -> tuple[float, float]:
    """Rms of the whole error and of the inclination, degrees."""
    estimated = Rotation.from_quat(np.array(found)[trial.judged - trial.start - 1][:, [1, 2, 3, 0]])
    truth = Rotation.from_matrix(trial.attitude[trial.judged])
    down = [turn.inv().apply([0.0, 0.0, 1.0]) for turn in (estimated, truth)]
    leaning = np.degrees(np.arccos(np.clip(np.sum(down[0] * down[1], axis=1), -1.0, 1.0)))
    whole = np.degrees((estimated * truth.inv()).magnitude())
    return float(np.sqrt(np.mean(whole**2))), float(np.sqrt(np.mean(leaning**2)))


def gyros_only(trial: RecordingTrial, bias: Floats) -> float:
    strapdown = Strapdown()
    x, y, z = bias.tolist()
    strapdown.bias_rad_s = (x, y, z)
    strapdown.restart(from_matrix(trial.attitude[trial.start]), float(trial.t_s[trial.start]))
    found = []
    for sample in samples(trial):
        strapdown.integrate([sample])
        found.append(strapdown.orientation)
    return judge(trial, found)[0]


def test_rates_alone_hold_three_times_better_after_a_calibration_at_rest(trial: RecordingTrial) -> None:
    calibrated, raw = gyros_only(trial, trial.gyro_bias), gyros_only(trial, np.zeros(3))
    assert raw > 10.0
    assert calibrated < raw / 3.0


def test_levelled_it_leans_by_less_than_a_degree_as_vqf_does(trial: RecordingTrial) -> None:
    gx, gy, gz = trial.gyro_bias.tolist()
    ax, ay, az = trial.accel_bias.tolist()
    estimator = AttitudeEstimator(
        AttitudeSettings(
            vehicle_from_sensor=np.eye(3),
            gravity_m_s2=GRAVITY,
            latitude_deg=None,  # the cameras' north is that of a magnetometer
            gyro_noise=noise_profile(None).gyro,
            gyro_bias_rad_s=(gx, gy, gz),
            gyro_covariance=np.eye(3) * (20.0 * DEG_H) ** 2,
            accel_bias_m_s2=(ax, ay, az),
            accel_sigma_m_s2=(0.01,) * 3,
        )
    )
    estimator.align(float(trial.t_s[trial.start]), trial.attitude[trial.start].T, np.eye(3) * 1e-4)
    found = []
    for sample in samples(trial):
        # Turned in place by hand: the accelerations of the ground, not those of flight.
        estimator.update([sample], phase="ground")
        attitude = estimator.attitude()
        assert attitude is not None
        found.append(attitude.quaternion)
    whole, leaning = judge(trial, found)
    assert leaning < 1.0
    assert whole < 3.0
    vqf = pytest.importorskip("vqf", reason="vqf is compared with")
    filter_ = vqf.VQF(float(trial.t_s[1] - trial.t_s[0]))
    flipped = filter_.updateBatch(np.ascontiguousarray(trial.rate * FLIP), np.ascontiguousarray(trial.force * FLIP))
    turns = Rotation.from_quat(flipped["quat6D"][:, [1, 2, 3, 0]]).as_matrix()
    theirs = [from_matrix(turn) for turn in np.einsum("i,nij,j->nij", FLIP, turns, FLIP)[trial.start + 1 :]]
    _, vqf_leaning = judge(trial, theirs)
    assert leaning < 1.5 * vqf_leaning
