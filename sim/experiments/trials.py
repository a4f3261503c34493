"""One trial: stand, calibrate through the wire formats, align, move, and compare the attitude with the truth.

The same samples go to whoever wants to be compared, so that a difference is one of method and not of luck.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from companion.attitude.estimator import AttitudeEstimator, AttitudeSettings
from companion.attitude.quaternion import Quaternion
from companion.calibration.noise.allan import noise_profile
from companion.physics.frames import body_from_ned
from companion.physics.units import DEG
from companion.samples import CompassSample, ImuSample
from sim.aircraft import Pose, Site
from sim.devices import HMR3300, Gradienter, VectorNavBinary
from sim.earth import Array
from sim.experiments.still import Still, Wire, calibrate
from sim.flight import MovingAircraft, Route
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import Vibration
from sim.scenario import site_at

STILL_S: Final = 60.0
BEGIN_S: Final = STILL_S + 4.0
"""Start of the route: what the collector needs to close its last second, and to say so."""
LOOK_S: Final = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """What is tried. Errors are drawn anew for every seed, one sigma as given."""

    name: str
    route: Callable[[float], Route]
    """Made with the aircraft time at which it begins."""
    seconds: float
    pose: Pose
    part: str
    rate_hz: float
    gyro_bias_deg_h: float = 100.0
    accel_bias_mg: float = 1.5
    scale: float = 1e-3
    """Scale errors and misalignments of both triads."""
    tilt_sigma_deg: float = 0.01
    compass_sigma_deg: float = 1.0
    compass_in_motion: bool = True
    vibration_m_s2: float = 0.0
    site: Site = field(default_factory=lambda: site_at(40.0, 116.0, 50.0))


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one seed gave; times from the start of the route, errors in degrees."""

    times_s: Array
    errors_deg: dict[str, Array]
    """By method: roll, pitch, heading (n, 3)."""
    tilt_deg: dict[str, Array]
    """By method: angle between true and estimated vertical (n)."""
    sigma_deg: Array
    """What ours says of itself (n, 3)."""


Follower = Callable[[Setup, Still, Quaternion, list[ImuSample]], list[Quaternion]]
"""A method from a package of others: start attitude body to NED and samples to one attitude a sample, likewise."""


def run(setup: Setup, seed: int, others: dict[str, Follower] | None = None) -> Trial:
    """Run one seed.

    Args:
        setup: what.
        seed: of all errors.
        others: methods to compare with.
    """
    random = np.random.default_rng([seed, 9])
    aircraft = _aircraft(setup)
    imu = ImuModel(
        aircraft,
        setup.part,
        seed=seed,
        gyro_bias_rad_s=_drawn(random, setup.gyro_bias_deg_h * DEG_H),
        accel_bias_m_s2=_drawn(random, setup.accel_bias_mg * MG),
        gyro_scale=_drawn(random, setup.scale),
        accel_scale=_drawn(random, setup.scale),
        gyro_misalignment_rad=_drawn(random, setup.scale),
        accel_misalignment_rad=_drawn(random, setup.scale),
    )
    offset = random.normal(size=2) * setup.tilt_sigma_deg
    wires = (
        Wire("imu", VectorNavBinary(imu, rate_hz=setup.rate_hz)),
        Wire("gradienter", Gradienter(aircraft, seed=seed, offset_deg=(float(offset[0]), float(offset[1])))),
        Wire("compass", HMR3300(aircraft, seed=seed, heading_error_deg=random.normal() * setup.compass_sigma_deg)),
    )
    still = calibrate(
        *wires,
        setup.site,
        seconds=STILL_S,
        profile=setup.part,
        law="axis",
        tilt_sigma_deg=setup.tilt_sigma_deg,
        heading_sigma_deg=setup.compass_sigma_deg,
    )
    return _move(setup, aircraft, wires[0], wires[2], still, others or {})


def _drawn(random: np.random.Generator, sigma: float) -> tuple[float, float, float]:
    x, y, z = (random.normal(size=3) * sigma).tolist()
    return x, y, z


_AIRCRAFT: dict[str, MovingAircraft] = {}


def _aircraft(setup: Setup) -> MovingAircraft:
    """One a setup and process: what it remembers of its truth serves all seeds."""
    if setup.name not in _AIRCRAFT:
        aircraft = MovingAircraft(setup.route(BEGIN_S), setup.pose, setup.site)
        if setup.vibration_m_s2:
            aircraft.add(
                Vibration(start_s=BEGIN_S, duration_s=setup.seconds, amplitude_m_s2=setup.vibration_m_s2)
            )  # fmt: skip
        _AIRCRAFT[setup.name] = aircraft
    return _AIRCRAFT[setup.name]


def _estimators(setup: Setup, still: Still) -> dict[str, AttitudeEstimator]:
    """Ours; ours without the compass; and with nothing calibrated. All begin at the same attitude."""
    pose, found = still.solution.pose, still.imu
    assert found.gyro_rad_s is not None
    assert found.accel_m_s2 is not None
    zero = np.zeros(3)
    estimators = {}
    for name, gyro, accel in (
        ("companion", found.gyro_rad_s, found.accel_m_s2),
        ("companion, no compass", found.gyro_rad_s, found.accel_m_s2),
        ("not calibrated", zero, zero),
    ):
        estimator = estimators[name] = AttitudeEstimator(
            AttitudeSettings(
                vehicle_from_sensor=np.eye(3),
                gravity_m_s2=still.local.gravity_m_s2,
                latitude_deg=setup.site.latitude_deg,
                gyro_noise=noise_profile(setup.part).gyro,
                gyro_bias_rad_s=(float(gyro[0]), float(gyro[1]), float(gyro[2])),
                gyro_covariance=found.use_covariance[:3, :3],
                accel_bias_m_s2=(float(accel[0]), float(accel[1]), float(accel[2])),
                accel_sigma_m_s2=(float(np.max(found.accel_sigma_use_m_s2)),) * 3,
            )
        )
        sigma = pose.sigma_deg
        variances = [(value or 0.0) ** 2 * DEG**2 for value in (sigma.gamma, sigma.theta, sigma.psi)]
        estimator.align(None, _start(still), np.diag(variances))
    return estimators


def _start(still: Still) -> Array:
    pose = still.solution.pose
    assert pose.gamma_deg is not None
    assert pose.theta_deg is not None
    assert pose.psi_deg is not None
    return body_from_ned(pose.gamma_deg * DEG, pose.theta_deg * DEG, pose.psi_deg * DEG)


def _move(
    setup: Setup,
    aircraft: MovingAircraft,
    imu: Wire,
    compass: Wire,
    still: Still,
    others: dict[str, Follower],
) -> Trial:
    estimators = _estimators(setup, still)
    # The calibration has read two seconds past its own end; what follows goes to the attitude.
    stream: list[ImuSample] = []
    ends: list[int] = []
    looks: dict[str, list[Quaternion]] = {name: [] for name in estimators}
    sigmas: list[tuple[float, float, float]] = []
    now_s = BEGIN_S - 1.0
    while now_s < BEGIN_S + setup.seconds - 1e-9:
        now_s += LOOK_S
        batch = [sample for sample in imu.samples_until(now_s) if isinstance(sample, ImuSample)]
        headings = [sample for sample in compass.samples_until(now_s) if isinstance(sample, CompassSample)]
        stream += batch
        ends.append(len(stream) - 1)
        for name, estimator in estimators.items():
            estimator.update(batch, phase="flight")
            for heading in headings if setup.compass_in_motion and name != "companion, no compass" else ():
                true_rad = (heading.heading_deg + still.local.declination_deg) * DEG
                estimator.add_heading(heading.t_s, true_rad, math.hypot(setup.compass_sigma_deg, 0.5) * DEG)
            found = estimator.attitude()
            assert found is not None
            looks[name].append(found.quaternion)
            if name == "companion":
                sigmas.append(found.sigma_rad)
    w, x, y, z = looks["companion"][0]
    for name, follower in others.items():
        followed = follower(setup, still, (w, x, y, z), stream[ends[0] + 1 :])
        looks[name] = [(w, x, y, z), *(followed[end - ends[0] - 1] for end in ends[1:])]
    times = np.array([stream[end].t_s for end in ends])
    truth = aircraft.matrices(times)
    errors, tilts = {}, {}
    for name, quaternions in looks.items():
        errors[name], tilts[name] = _errors(truth, np.array(quaternions))
    return Trial(times - BEGIN_S, errors, tilts, np.array(sigmas) / DEG)


def _errors(truth: Array, quaternions: Array) -> tuple[Array, Array]:
    """Roll, pitch and heading errors (n, 3) and the angle between the verticals (n), degrees."""
    w, x, y, z = quaternions.T
    found = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.moveaxis(found, 2, 0)
    difference = _angles(found) - _angles(truth)
    wrapped = np.degrees(np.mod(difference + np.pi, 2.0 * np.pi) - np.pi)
    down = np.clip(np.einsum("ni,ni->n", found[:, :, 2], truth[:, :, 2]), -1.0, 1.0)
    return wrapped, np.degrees(np.arccos(down))


def _angles(matrices: Array) -> Array:
    """Roll, pitch, heading of matrices NED to body (n, 3, 3)."""
    c = matrices
    return np.column_stack(
        [
            np.arctan2(c[:, 1, 2], c[:, 2, 2]),
            -np.arcsin(np.clip(c[:, 0, 2], -1.0, 1.0)),
            np.arctan2(c[:, 0, 1], c[:, 0, 0]),
        ]
    )


def many(setup: Setup, seeds: range, others: dict[str, Follower] | None = None, jobs: int = 1) -> list[Trial]:
    """All seeds, in `jobs` processes."""
    if jobs == 1:
        return [run(setup, seed, others) for seed in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(run, [setup] * len(seeds), seeds, [others] * len(seeds)))


def rms(values: Array, axis: int | tuple[int, ...] = 0) -> Array:
    """Root of the mean square."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=axis)))
