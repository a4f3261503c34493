"""Estimation of biases and covariances from the means of one motionless window.

A bias is the mean reading minus the true value, which follows from attitude, gravity and the Earth's rate. The bias is
the effective one at this attitude: a scale error times 1 g on the vertical axis looks like a bias (method.md section
2.3). The autopilot's offset has to correct this apparent bias, too; sigma does not include it.

The equations are those of the paper with its errata corrected (method.md section 1.3). An accelerometer's bias is
mean - g * up, a gyro's is mean - C_n^b w_ie^n. Axes are FRD and NED; `up` is the unit vector of specific force at rest.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from companion.config.sections import Platform
from companion.errors import CalibrationRefusedError
from companion.estimation.machine import What
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.warming import Warming
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.records.record import Effective, Magnetic, Pose, PoseSigma, Prior, SiteRecord, WhenWarm
from companion.estimation.solution.site import LocalEarth, Remedies
from companion.estimation.solution.truth import NOTHING, FallbackPose, Truth, truth_of
from companion.estimation.stillness.plausible import implausible
from companion.estimation.turning.turn import Turn
from companion.messages import message
from companion.physics.frames import Array, Matrix, roll_pitch_from_up, skew
from companion.physics.units import DEG
from companion.samples import Triad

if TYPE_CHECKING:
    from companion.estimation.solution.doubt import Inconsistency

Pair = tuple[Array | None, Array | None]
"""Biases of gyro and accelerometer, (3,) each, in rad/s and m/s^2; None: unknown."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImuSolution:
    """Estimated bias in one IMU's output after the autopilot's offsets, in vehicle axes (FRD), with its sigmas.

    A bias is the mean minus the true value, (3,); None: not requested or unknown. `whole` adds the offsets
    `subtracted` by the autopilot. `covariance` (6x6: gyro rad/s, accelerometer m/s^2) holds for the next minutes,
    without a warm-up, which affects old and new offsets equally. `sigma_stat` (6,) is the noise after averaging.
    `temperature_degc` and its rate hold at the window's end. `drifting`: texts on drift, or on biases when warm.
    """

    name: str
    samples: int
    temperature_degc: float | None
    gyro_rad_s: Array | None
    accel_m_s2: Array | None
    sigma_stat: Array
    covariance: Matrix
    warnings: tuple[str, ...]
    subtracted: Array | None = None
    """Offsets that the autopilot subtracts, (6,), in the covariance's order; None: it subtracts none in this output."""
    drifting: tuple[str, ...] = ()
    warm_up_variance: Array = dataclasses.field(default_factory=lambda: np.zeros(6))
    k_s: float = 0.0
    warming: Warming | None = None
    when_warm: WhenWarm | None = None
    prior: Prior | None = None
    effective: Effective | None = None

    @property
    def biases(self) -> Pair:
        return self.gyro_rad_s, self.accel_m_s2

    @property
    def whole(self) -> Pair:
        return self.biases if self.subtracted is None else _moved(self.biases, self.subtracted)

    def shifted(self, by: Array) -> ImuSolution:
        gyro, accel = _moved(self.biases, by)
        return dataclasses.replace(self, gyro_rad_s=gyro, accel_m_s2=accel)

    def own_variance(self, shared: Shared) -> Array:
        return np.maximum(np.diag(self.covariance) - np.diag(shared.covariance), 0.0)

    @property
    def gyro_sigma_use_rad_s(self) -> Array:
        """Stated sigma of the gyro bias for the next minutes, including a possible warm-up, (3,)."""
        return np.sqrt(np.diag(self.use_covariance)[:3])

    @property
    def accel_sigma_use_m_s2(self) -> Array:
        """Stated sigma of the accelerometer bias for the next minutes, including a possible warm-up, (3,)."""
        return np.sqrt(np.diag(self.use_covariance)[3:])

    @property
    def mean_degc(self) -> float | None:
        path = None if self.warming is None else self.warming.path
        return self.temperature_degc if path is None else path.mean_degc

    @property
    def use_covariance(self) -> Matrix:
        """Covariance of the biases (6x6), including a possible warm-up; sigma_use is the root of its diagonal."""
        return self.covariance + np.diag(self.warm_up_variance)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """Bias errors common to all IMUs of one window, because they use the same attitude, gravity and Earth's rate.

    `covariance` (6x6: gyro rad/s, accelerometer m/s^2) is part of each IMU's covariance, and couples any two IMUs.
    """

    up: Array
    gravity_m_s2: float
    covariance: Matrix
    by_reading: Matrix | None
    """Derivative of accelerometer biases by the gradienter's readings, per radian, (3, 2); None: no gradienter."""
    reading_sigma_rad: tuple[float, float]
    zero_sigma_rad: float  # One sigma of the gradienter's zero, the same in every calibration

    @property
    def by_zero(self) -> Matrix:
        """Return the accelerometer bias errors from one sigma of the gradienter's zero on each of its axes, (3, 2)."""
        return self.tilted(self.zero_sigma_rad)

    def tilted(self, sigma_rad: float | Array) -> Matrix:
        """Return the accelerometer bias errors from an error `sigma_rad` of each gradienter reading, (3, 2)."""
        return np.zeros((3, 2)) if self.by_reading is None else self.by_reading * sigma_rad


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Solution:
    pose: Pose
    site: SiteRecord
    imus: tuple[ImuSolution, ...]
    warnings: tuple[str, ...]
    shared: Shared
    unknown: tuple[tuple[str, Triad], ...] = ()
    """Pairs of IMU and triad that were requested but have no result; the IMU's warnings give the reason."""
    magnetic: Magnetic | None = None
    turn: Turn = dataclasses.field(default_factory=Turn)
    platform: Platform = "ground"
    doubts: tuple[Inconsistency, ...] = ()  # Contradictions to earlier calibrations

    @property
    def doubted(self) -> dict[tuple[str, Triad], Inconsistency]:
        """Contradictions by IMU and triad; one that is common to all IMUs is listed for every IMU."""
        return {
            (name, doubt.triad): doubt
            for doubt in reversed(self.doubts)
            for name in ([imu.name for imu in self.imus] if doubt.of_all else doubt.names)
        }


def _moved(biases: Pair, shift: Array) -> Pair:
    gyro, accel = (
        None if bias is None else bias + part for bias, part in zip(biases, (shift[:3], shift[3:]), strict=True)
    )
    return gyro, accel


def solve(
    window: Window,
    local: LocalEarth,
    gradienter: GradienterModel | None,
    compass: CompassModel | None,
    what: What,
    platform: Platform = "ground",
    *,
    any_bias: bool = False,
    otherwise: FallbackPose = NOTHING,
) -> Solution:
    """Estimate the biases of every IMU from one motionless window; `any_bias` allows implausibly large ones.

    `otherwise` supplies the tilt if there is no gradienter, and the heading if there is no compass.

    Raises:
        CalibrationRefusedError: no requested bias can be determined, or the readings are inconsistent.
    """
    warnings = list(local.warnings)
    gradienter = gradienter if window.tilt is not None else None
    compass = compass if window.heading is not None else None
    missing = message("sensor_missing", sensor="gradienter", sensors="accelerometers")
    if what is What.ACCELEROMETERS and gradienter is None:
        raise CalibrationRefusedError(missing)
    if platform == "deck":
        # The deck turns, and the time at which the yaw was valid is unknown.
        otherwise = msgspec.structs.replace(otherwise, heading=None)
    truth = truth_of(window, gradienter, compass, local, warnings, otherwise)
    if what.accelerometers and truth.tilt_from is None:
        warnings.append(missing)
    unknown_heading = None
    if compass is None and truth.heading_rad is None:
        _, unknown_heading = local.rate_in_body(np.eye(3), heading_known=False)
    warnings += wide_gyros(window.imus, unknown_heading, local.remedies)
    believed = window.imus if any_bias else tuple(believable(imu, truth.up, local) for imu in window.imus)
    sailing = np.zeros(3) if window.turn_rad_s is None else np.array(window.turn_rad_s)
    shared = _shared(truth, local, window.turn, 0.0 if gradienter is None else gradienter.sigma_deg * DEG, sailing)
    # A deck may turn, and only the heading shows a steady turn.
    turn_unseen = platform == "deck" and what.gyros and truth.heading_rad is None
    if turn_unseen:
        missing = message("sensor_missing", sensor="compass on a deck", sensors="gyros")
        if what is What.GYROS or gradienter is None:
            raise CalibrationRefusedError(missing)
        warnings.append(missing)
    wanted: dict[Triad, bool] = {
        "gyro": what.gyros and not turn_unseen,
        "accel": what.accelerometers and gradienter is not None,
    }
    asked = [triad for triad, is_wanted in wanted.items() if is_wanted]
    tipped = _tipped(window, gradienter, truth, sailing)
    imus = tuple(
        _estimate(imu, truth, local, shared, asked, tipped, window.powered_s.get(imu.name, 0.0)) for imu in believed
    )
    refusals = dict.fromkeys(words for imu in believed for triad, words in imu.hidden.items() if triad in asked)
    if refusals and all(bias is None for imu in imus for bias in imu.biases):
        raise CalibrationRefusedError("; ".join(refusals))
    unknown = [(imu.name, triad) for triad in asked for imu in believed if imu.refused(triad)]
    if turn_unseen:
        unknown += [(imu.name, "gyro") for imu in window.imus]
    return Solution(
        pose=_pose(truth),
        site=local.site,
        imus=imus,
        warnings=tuple(warnings),
        unknown=tuple(unknown),
        magnetic=truth.magnetic,
        shared=shared,
        turn=window.turn,
        platform=platform,
    )


def _pose(truth: Truth) -> Pose:
    up, covariance, heading, sigma = truth.up, truth.up_covariance, truth.heading_rad, truth.heading_sigma_rad
    theta = gamma = of_theta = of_gamma = None
    if truth.tilt_from is not None:
        gamma, theta = (angle / DEG for angle in roll_pitch_from_up(up))
        by_gamma = np.array([0.0, up[2], -up[1]]) / (up[1] ** 2 + up[2] ** 2)
        of_theta = math.sqrt(covariance[0, 0] / (1.0 - up[0] ** 2)) / DEG
        of_gamma = math.sqrt(by_gamma @ covariance @ by_gamma) / DEG
    return Pose(
        tilt_from=truth.tilt_from,
        heading_from=truth.heading_from,
        theta_deg=theta,
        gamma_deg=gamma,
        psi_deg=None if heading is None else (heading / DEG) % 360.0,
        sigma_deg=PoseSigma(theta=of_theta, gamma=of_gamma, psi=None if sigma is None else sigma / DEG),
    )


def _shared(truth: Truth, local: LocalEarth, turn: Turn, zero_sigma_rad: float, turn_rad_s: Array) -> Shared:
    """Return the errors common to all IMUs: of attitude, gravity, Earth's rate and turn (method.md section 2.1).

    An attitude error eps changes accelerometer biases by eps x f, and gyro biases by eps x w = -[w x] eps.
    """
    (rate, of_rate), up = truth.earth_rate(local), truth.up
    jacobian = np.vstack([-skew(rate + turn_rad_s), -skew(local.gravity_m_s2 * up)])
    covariance = jacobian @ truth.attitude_covariance_rad2 @ jacobian.T
    covariance[:3, :3] += of_rate + turn.covariance(up)
    covariance[3:, 3:] += np.outer(up, up) * local.gravity_sigma_m_s2**2
    return Shared(
        up=up,
        gravity_m_s2=local.gravity_m_s2,
        covariance=covariance,
        by_reading=None if truth.up_by_reading is None else -local.gravity_m_s2 * truth.up_by_reading,
        reading_sigma_rad=truth.reading_sigma_rad,
        zero_sigma_rad=zero_sigma_rad,
    )


def _tipped(window: Window, gradienter: GradienterModel | None, truth: Truth, turn_rad_s: Array) -> Array:
    """Return the error (3,) in gyro means because the axis of a deck's turn was computed from the raw tilt."""
    if window.turn_rad_s is None or window.tilt is None or gradienter is None:
        return np.zeros(3)
    said = gradienter.up(window.tilt.x_deg, window.tilt.y_deg)
    return np.cross(np.cross(said, truth.up), turn_rad_s)


def _estimate(
    imu: ImuWindow,
    truth: Truth,
    local: LocalEarth,
    shared: Shared,
    asked: Collection[Triad],
    tipped: Array,
    powered_s: float,
) -> ImuSolution:
    """Subtract the Earth's rate and gravity from one IMU's means; add up the sensor's and the common covariance."""
    gyro = accel = None
    if "gyro" in asked and imu.refused("gyro") is None:
        gyro = np.array(imu.gyro_rad_s) - _earth_seen(imu, truth, local) - tipped
    if "accel" in asked and imu.refused("accel") is None:
        accel = np.array(imu.accel_m_s2) - local.gravity_m_s2 * truth.up
    own = imu.covariance
    if own is None:
        own = np.diag(np.square([*imu.gyro_sigma_use_rad_s, *imu.accel_sigma_use_m_s2]))
    covariance = shared.covariance + own
    path = None if imu.warming is None else imu.warming.path
    unseen = np.zeros(6) if imu.warming is None else imu.warming.unseen(powered_s)
    wide = "" if imu.warming is None else imu.warming.in_words(imu.name, powered_s, np.diag(covariance))
    return ImuSolution(
        name=imu.name,
        samples=imu.samples,
        temperature_degc=imu.temperature_degc if path is None else path.states[2][0],
        gyro_rad_s=gyro,
        accel_m_s2=accel,
        sigma_stat=np.array([*imu.gyro_sigma_stat_rad_s, *imu.accel_sigma_stat_m_s2]),
        covariance=covariance,
        warm_up_variance=unseen,
        k_s=0.0 if imu.warming is None else imu.warming.rate_k_s,
        warnings=(*imu.warnings, *dict.fromkeys(words for triad, words in imu.hidden.items() if triad in asked)),
        drifting=imu.drifting if gyro is None or not wide else (*imu.drifting, wide),
        warming=imu.warming,
    )


def _earth_seen(imu: ImuWindow, truth: Truth, local: LocalEarth) -> Array:
    """Return the Earth's rate contained in the gyro means, (3,): whole on ground, averaged on a turning deck."""
    if imu.by_earth is None or truth.heading_rad is None:
        return truth.earth_rate(local)[0]
    c, s = math.cos(truth.heading_rad), math.sin(truth.heading_rad)
    north, east, down = local.rate_ned_rad_s.tolist()
    return np.asarray(imu.by_earth @ np.array([c * north + s * east, c * east - s * north, down]))


def believable(imu: ImuWindow, up: Array, local: LocalEarth) -> ImuWindow:
    """Mark triads with impossible means as useless, with cause and remedy as warnings; `up` is in vehicle axes."""
    means = np.array(imu.gyro_rad_s), np.array(imu.accel_m_s2)
    expected, remedies = local.gravity_m_s2 * up, local.remedies
    found = implausible(imu.name, *means, expected, np.array(imu.mounting), remedies.mounting, remedies.any_bias)
    return msgspec.structs.replace(imu, hidden=imu.hidden | found, useless=imu.useless | found.keys())


def wide_gyros(imus: Sequence[ImuWindow], earth_covariance: Matrix | None, remedies: Remedies) -> list[str]:
    """List warnings on a wide gyro sigma: its cause is an unknown heading, or a sensor model that is not configured.

    `earth_covariance` (3, 3) is the uncertainty of the Earth's rate, (rad/s)^2; None: the heading is known.
    """
    earth = 0.0 if earth_covariance is None else float(np.diag(earth_covariance).max())
    by_part = [
        imu.name
        for imu in imus
        # Skip gyros read as coarse integers: these are the cause, and a warning reports them already.
        if not imu.named and "gyro" not in imu.hidden and float(np.square(imu.gyro_sigma_use_rad_s).max()) > earth
    ]
    found = [message("gyro_part_unknown", imu=name, remedy=remedies.part) for name in by_part]
    if earth_covariance is not None and len(by_part) < len(imus):
        found.append(message("no_heading", reason=remedies.no_heading))
    return found
