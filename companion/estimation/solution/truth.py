"""Attitude of the aircraft from everything but its gyros: the reference for every sensor."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.means.pose import CompassModel, GradienterModel, TiltWindow, up_in_vehicle
from companion.estimation.means.windows import Window
from companion.estimation.records.record import HeadingFrom, Magnetic, TiltFrom
from companion.estimation.solution import magnetic
from companion.estimation.solution.otherwise import NOTHING, Otherwise, OwnHeading, tilt_in_words, up_by_sides
from companion.estimation.solution.site import LocalEarth, Uncertain
from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up
from companion.physics.gradienter import up_jacobian
from companion.physics.units import DEG

# Without a gradienter the accelerometers level the Earth's rate; a 50 mg bias tilts it by 3 degrees (0.8 deg/h).
LEVEL_BY_ACCELEROMETER_SIGMA_DEG: Final = 3.0


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Reference for the sensors, from everything but themselves."""

    up: Array
    up_covariance: Matrix
    attitude_covariance_rad2: Matrix
    """(3, 3) in vehicle FRD."""
    up_by_reading: Matrix | None
    """d up / d (gradienter's readings in radian), (3, 2); None without a gradienter."""
    reading_sigma_rad: tuple[float, float]
    """Sigma of the gradienter's two means, without its zero."""
    tilt_from: TiltFrom | None
    """None: the accelerometers' own, of which nothing is known."""
    heading_rad: float | None = None
    heading_sigma_rad: float | None = None
    heading_from: HeadingFrom | None = None
    magnetic: Magnetic | None = None
    """Quality of the heading by the compass' field and steadiness; None without a compass."""

    @property
    def body_from_ned(self) -> Matrix:
        """The attitude; with an unknown heading, that of heading north."""
        gamma, theta = roll_pitch_from_up(self.up)
        return body_from_ned(gamma, theta, self.heading_rad or 0.0)

    def earth_rate(self, local: LocalEarth) -> Uncertain:
        """The Earth's rate in the vehicle's axes."""
        return local.rate_in_body(self.body_from_ned, heading_known=self.heading_rad is not None)


def attitude_error_jacobian(up: Array) -> Matrix:
    """Give the derivative of the attitude by `up`, at a fixed heading: eps = jacobian @ d up, shape (3, 3).

    C_hat = (I - [eps x]) C. Roll turns about the body's x axis, pitch about the horizontal axis
    (0, cos gamma, -sin gamma); with gamma = atan2(-u_y, -u_z) and sin theta = u_x.
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
    otherwise: Otherwise = NOTHING,
) -> Truth:
    """Estimate the attitude from everything but the gyros; `warnings` gets a line for each gap.

    Raises:
        CalibrationRefusedError: the readings cannot be right together.
    """
    by_reading: Matrix | None = None
    reading_sigma = (0.0, 0.0)
    tilt_from: TiltFrom | None = None
    if gradienter is not None and window.tilt is not None:
        up, by_reading, up_covariance = _up(window.tilt, gradienter)
        reading_sigma, tilt_from = (window.tilt.x_sigma_deg * DEG, window.tilt.y_sigma_deg * DEG), "gradienter"
    elif (found_up := up_by_sides(window.imus, otherwise, local, warnings)) is not None:
        up, up_covariance, tilt_from = found_up.up, found_up.covariance, "accelerometers"
        warnings.append(tilt_in_words(found_up))
    else:
        mean = np.mean([imu.accel_m_s2 for imu in window.imus], axis=0)
        up = mean / np.linalg.norm(mean)
        up_covariance = (np.eye(3) - np.outer(up, up)) * (LEVEL_BY_ACCELEROMETER_SIGMA_DEG * DEG) ** 2
    if math.hypot(up[1], up[2]) < 0.1:
        raise CalibrationRefusedError("the aircraft stands on its nose or tail (pitch beyond 84 deg): lay it down")
    jacobian = attitude_error_jacobian(up)
    without = Truth(up, up_covariance, jacobian @ up_covariance @ jacobian.T, by_reading, reading_sigma, tilt_from)
    if compass is None or window.heading is None:
        return without if otherwise.heading is None else _with_own_heading(without, otherwise.heading, warnings)
    tilt_covariance = None if tilt_from is None else up_covariance
    may_turn_deg = window.turn.at_most_rad_s / DEG * (window.end_s - window.start_s)
    found = magnetic.assess(window.heading, window.field, compass, local, up, tilt_covariance, may_turn_deg)
    warnings += found.warnings
    if not found.is_usable:
        return dataclasses.replace(without, magnetic=found.magnetic)
    if compass.magnetic and local.site.declination_deg is None:
        warnings.append("declination unknown (no position or date): magnetic heading used, sigma widened")
    # A heading from the field takes part in the tilt's errors: one wrong tilt turns all three angles.
    turned = jacobian - np.outer(up, found.heading_by_up)
    return dataclasses.replace(
        without,
        attitude_covariance_rad2=turned @ up_covariance @ turned.T + np.outer(up, up) * found.sigma_rad**2,
        heading_rad=found.heading_rad,
        heading_from="compass",
        heading_sigma_rad=math.sqrt(found.sigma_rad**2 + found.heading_by_up @ up_covariance @ found.heading_by_up),
        magnetic=found.magnetic,
    )


def _with_own_heading(without: Truth, own: OwnHeading, warnings: list[str]) -> Truth:
    """Use the autopilot's yaw as the heading."""
    sigma_rad = own.sigma_deg * DEG
    warnings.append(f"no compass: heading {own.heading_deg:.0f} deg by the autopilot, good to {own.sigma_deg:.0f} deg")
    return dataclasses.replace(
        without,
        attitude_covariance_rad2=without.attitude_covariance_rad2 + np.outer(without.up, without.up) * sigma_rad**2,
        heading_rad=own.heading_deg * DEG,
        heading_from="autopilot",
        heading_sigma_rad=sigma_rad,
    )


def _up(tilt: TiltWindow, model: GradienterModel) -> tuple[Array, Matrix, Matrix]:
    """Up in the vehicle's axes, its derivatives by the readings (3x2), and its covariance (3x3, radian squared)."""
    x_deg, y_deg = tilt.x_deg - model.offset_deg[0], tilt.y_deg - model.offset_deg[1]
    try:
        up = up_in_vehicle(model, tilt.x_deg, tilt.y_deg)
        jacobian = model.vehicle_from_sensor @ up_jacobian(model.law, x_deg, y_deg)
    except ValueError as error:
        raise CalibrationRefusedError(str(error)) from None
    variance = [(math.hypot(model.sigma_deg, sigma) * DEG) ** 2 for sigma in (tilt.x_sigma_deg, tilt.y_sigma_deg)]
    return up, jacobian, jacobian @ np.diag(variance) @ jacobian.T
