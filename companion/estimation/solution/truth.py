"""Attitude of the aircraft from all sensors except its gyros, as the reference for every sensor.

A gradienter measures the tilt, a compass the heading. Without a gradienter, accelerometers give the tilt if a
six-position calibration measured their bias b, scale and shear S (module `alignment.faces`): f = (I + S)^-1 (read - b).
The length of f must equal gravity. The tilt from f includes the tilt of the board in the aircraft. Without a compass,
the autopilot's yaw is the heading.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import AllanModel
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align_model import response
from companion.estimation.alignment.faces import BIAS, FIGURES, SCALE, SHEAR, Sides
from companion.estimation.means.pose import CompassModel, GradienterModel, TiltWindow, up_in_vehicle
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.noise.allan import floor_variance
from companion.estimation.records.record import HeadingFrom, Magnetic, TiltFrom
from companion.estimation.solution import magnetic
from companion.estimation.solution.curve import CATALOGUE_PER_K, CATALOGUE_SCATTER
from companion.estimation.solution.site import LocalEarth, unknown
from companion.messages import message
from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up, symmetric_by
from companion.physics.gradienter import up_jacobian
from companion.physics.units import DEG, MG

# Without a gradienter the accelerometers level the Earth's rate; a 50 mg bias tilts it by 3 degrees (0.8 deg/h).
LEVEL_BY_ACCELEROMETER_SIGMA_DEG: Final = 3.0
UNKNOWN_K: Final = 5.0  # Assumed change of the temperature if it is unknown
_MEAN_S: Final = 12.0
_SOON_S: Final = 180.0
LENGTH_SIGMAS: Final = 4.0
"""Largest error of gravity's measured size, in sigmas; a larger one shows an outdated six-position calibration."""


class OwnHeading(msgspec.Struct, frozen=True):
    """Yaw estimated by the autopilot, clockwise from true north, with one sigma."""

    heading_deg: float
    sigma_deg: float


class FallbackPose(msgspec.Struct, frozen=True, kw_only=True):
    """Fallbacks for a missing gradienter (tilt sensor) or compass."""

    sides: dict[str, Sides] = {}  # Six-position calibrations of the accelerometers, by IMU
    heading: OwnHeading | None = None


NOTHING: Final = FallbackPose()


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Attitude that serves as reference: up vector, heading and attitude covariance, in vehicle axes (FRD).

    `tilt_from` is None if the tilt is from accelerometers of unknown bias. `reading_sigma_rad` is one sigma of the
    gradienter's two mean readings, without the error of the zero.
    """

    up: Array
    up_covariance: Matrix
    attitude_covariance_rad2: Matrix  # (3, 3) in vehicle FRD
    up_by_reading: Matrix | None
    """Derivative of the up vector by the gradienter's two readings, per radian, (3, 2); None without a gradienter."""
    reading_sigma_rad: tuple[float, float]
    tilt_from: TiltFrom | None
    heading_rad: float | None = None
    heading_sigma_rad: float | None = None
    heading_from: HeadingFrom | None = None
    magnetic: Magnetic | None = None
    """Quality of the compass heading, by its field and steadiness; None without a compass."""

    @property
    def body_from_ned(self) -> Matrix:
        gamma, theta = roll_pitch_from_up(self.up)
        return body_from_ned(gamma, theta, self.heading_rad or 0.0)

    def earth_rate(self, local: LocalEarth) -> tuple[Array, Matrix]:
        return local.rate_in_body(self.body_from_ned, heading_known=self.heading_rad is not None)


def attitude_error_jacobian(up: Array) -> Matrix:
    """Return the derivative (3, 3) of the attitude error by an error of the up vector, at a fixed heading.

    Roll gamma turns about the body's x axis, pitch about the horizontal axis (0, cos gamma, -sin gamma).
    """
    gamma, theta = roll_pitch_from_up(up)
    horizontal = np.hypot(up[1], up[2])
    by_gamma = np.array([0.0, up[2], -up[1]]) / horizontal**2
    by_theta = np.array([1.0 / np.cos(theta), 0.0, 0.0])
    return np.outer([1.0, 0.0, 0.0], by_gamma) + np.outer([0.0, np.cos(gamma), -np.sin(gamma)], by_theta)


def truth_of(
    window: Window,
    gradienter: GradienterModel | None,
    compass: CompassModel | None,
    local: LocalEarth,
    warnings: list[str],
    otherwise: FallbackPose = NOTHING,
) -> Truth:
    """Estimate the attitude from all sensors except the gyros; add lines to `warnings` on fallbacks and doubts.

    Raises:
        CalibrationRefusedError: the readings are inconsistent, or the nose points up or down.
    """
    by_reading: Matrix | None = None
    reading_sigma = (0.0, 0.0)
    tilt_from: TiltFrom | None = None
    if gradienter is not None and window.tilt is not None:
        up, by_reading, up_covariance = _up_by_gradienter(window.tilt, gradienter)
        reading_sigma, tilt_from = (window.tilt.x_sigma_deg * DEG, window.tilt.y_sigma_deg * DEG), "gradienter"
    elif (by_sides := up_by_sides(window.imus, otherwise, local, warnings)) is not None:
        (up, up_covariance), tilt_from = by_sides, "accelerometers"
    else:
        mean = np.mean([imu.accel_m_s2 for imu in window.imus], axis=0)
        up = mean / np.linalg.norm(mean)
        up_covariance = (np.eye(3) - np.outer(up, up)) * (LEVEL_BY_ACCELEROMETER_SIGMA_DEG * DEG) ** 2
    if math.hypot(up[1], up[2]) < 0.1:
        raise CalibrationRefusedError(message("nose_or_tail"))
    jacobian = attitude_error_jacobian(up)
    without = Truth(up, up_covariance, jacobian @ up_covariance @ jacobian.T, by_reading, reading_sigma, tilt_from)
    if compass is None or window.heading is None:
        if (own := otherwise.heading) is None:
            return without
        angle, sigma = f"heading {own.heading_deg:.0f} deg by the autopilot", f"{own.sigma_deg:.0f}"
        warnings.append(message("angle_without_sensor", sensor="compass", angle=angle, sigma_deg=sigma))
        return dataclasses.replace(
            without,
            attitude_covariance_rad2=without.attitude_covariance_rad2 + np.outer(up, up) * (own.sigma_deg * DEG) ** 2,
            heading_rad=own.heading_deg * DEG,
            heading_from="autopilot",
            heading_sigma_rad=own.sigma_deg * DEG,
        )
    tilt_covariance = None if tilt_from is None else up_covariance
    may_turn_deg = window.turn.at_most_rad_s / DEG * (window.end_s - window.start_s)
    found = magnetic.assess(window.heading, window.field, compass, local, up, tilt_covariance, may_turn_deg)
    warnings += found.warnings
    if not found.is_usable:
        return dataclasses.replace(without, magnetic=found.magnetic)
    if compass.magnetic and local.site.declination_deg is None:
        warnings.append(unknown("declination", "magnetic heading used, sigma widened", "no position or date"))
    # A heading from the field depends on the tilt: one tilt error changes all three angles.
    turned = jacobian - np.outer(up, found.heading_by_up)
    return dataclasses.replace(
        without,
        attitude_covariance_rad2=turned @ up_covariance @ turned.T + np.outer(up, up) * found.sigma_rad**2,
        heading_rad=found.heading_rad,
        heading_from="compass",
        heading_sigma_rad=math.sqrt(found.sigma_rad**2 + found.heading_by_up @ up_covariance @ found.heading_by_up),
        magnetic=found.magnetic,
    )


def _up_by_gradienter(tilt: TiltWindow, model: GradienterModel) -> tuple[Array, Matrix, Matrix]:
    """Return the up vector in vehicle axes, its derivative by the readings (3, 2), and its covariance (3, 3), rad^2."""
    x_deg, y_deg = tilt.x_deg - model.offset_deg[0], tilt.y_deg - model.offset_deg[1]
    try:
        up = up_in_vehicle(model, tilt.x_deg, tilt.y_deg)
        jacobian = model.vehicle_from_sensor @ up_jacobian(model.law, x_deg, y_deg)
    except ValueError as error:
        raise CalibrationRefusedError(str(error)) from None
    variance = [(math.hypot(model.sigma_deg, sigma) * DEG) ** 2 for sigma in (tilt.x_sigma_deg, tilt.y_sigma_deg)]
    return up, jacobian, jacobian @ np.diag(variance) @ jacobian.T


def up_by_sides(
    imus: Sequence[ImuWindow], otherwise: FallbackPose, local: LocalEarth, warnings: list[str]
) -> tuple[Array, Matrix] | None:
    """Estimate the up vector and its covariance by the first IMU with a six-position calibration that fits gravity.

    Two IMUs are not averaged, because their boards may tilt differently; the autopilot flies with the first one.
    """
    for imu in imus:
        known = otherwise.sides.get(imu.name)
        if known is None or imu.refused("accel") is not None:
            continue
        force, covariance = _force(imu, known)
        length = float(np.linalg.norm(force))
        up = force / length
        off = length - local.gravity_m_s2
        sigma = float(np.hypot(np.sqrt(up @ covariance @ up), local.gravity_sigma_m_s2))
        if abs(off) > LENGTH_SIGMAS * sigma:
            warnings.append(message("gravity_off_since_faces", imu=imu.name, excess=f"{off / MG:+.1f}"))
            continue
        across = (np.eye(3) - np.outer(up, up)) / length
        up_covariance = across @ covariance @ across.T
        sigma_deg = float(np.sqrt(np.linalg.eigvalsh(up_covariance)[-1])) / DEG
        angle, sigma_words = (
            f"tilt by the accelerometers of imu {imu.name} after a faces alignment",
            f"{sigma_deg:.2g}",
        )
        warnings.append(message("angle_without_sensor", sensor="gradienter", angle=angle, sigma_deg=sigma_words))
        return up, up_covariance
    return None


def _force(imu: ImuWindow, known: Sides) -> tuple[Array, Matrix]:
    """Return the specific force (3,) in vehicle axes by a six-position calibration, and its covariance, (3, 3)."""
    figures, turn = known.figures, known.vehicle_from_sensor
    inverse = np.linalg.inv(response(figures[SCALE], figures[SHEAR]))
    force = inverse @ (turn.T @ np.array(imu.accel_m_s2) - figures[BIAS])
    by = np.zeros((3, FIGURES))
    by[:, BIAS] = np.eye(3)
    by[:, SCALE] = np.diag(force)
    by[:, SHEAR] = symmetric_by(force)
    mean = turn.T @ np.diag(np.square(imu.accel_sigma_stat_m_s2)) @ turn
    inside = inverse @ (by @ np.diag(np.square(known.sigma)) @ by.T + mean) @ inverse.T
    return turn @ force, turn @ inside @ turn.T


def aged_m_s2(noise: AllanModel, gap_s: float | None, kelvin: float | None) -> float:
    """Estimate one sigma of the accelerometers' bias change since their six-position calibration.

    `gap_s` is the time since that calibration; None: perhaps another power-up. `kelvin`: temperature change, or None.
    """
    if gap_s is None:
        wander = CATALOGUE_SCATTER["accel"] ** 2
    else:
        # The sigma of the six-position calibration already includes the change within minutes.
        late, soon = (
            floor_variance(noise.flicker, noise.walk, _MEAN_S, 2.0 * each) for each in (max(gap_s, _SOON_S), _SOON_S)
        )
        wander = float(late - soon)
    if kelvin is None:
        kelvin = 0.0 if gap_s is not None and gap_s <= _SOON_S else UNKNOWN_K
    return math.sqrt(wander + (CATALOGUE_PER_K["accel"] * kelvin) ** 2)
