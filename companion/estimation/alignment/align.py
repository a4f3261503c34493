"""Joint estimate from several poses of a motionless aircraft: the gradienter's zero, and the errors of each IMU.

One pose cannot separate a zero offset of the gradienter from a bias of the accelerometers. Two poses at one place,
turned by 180 degrees, can. Further tilts separate bias from scale and show the misalignment of gradienter and IMUs.
All unknowns are estimated together by Gauss-Newton with priors (method.md section 3.4). An unknown that the poses do
not determine keeps its prior sigma.

Without a gradienter (`turned`), the half turn gives the *effective* bias of the level aircraft: the bias plus the
effect of the board's tilt. In the aircraft's axes, the ground's slope changes its sign after half a turn; a bias does
not. Sigma depends on how exactly the aircraft returns to its marked place (`Priors.placement_deg`). On a slope, a wrong
angle of the half turn adds an error: g sin(slope) / 2 for each wrong radian, 0.76 mg for each wrong degree on a slope
of 5 deg. Quarter turns determine their own angles, because their readings lie on a circle.

Inconsistent readings are refused: every residual is compared with its own sigma (Baarda's w-test). This test names the
wrong pose, and detects a movement of the ground earlier than a sum of squares.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align_model import (
    ACCEL_BIAS,
    GYRO_BIAS,
    LEVEL,
    MISALIGNMENT,
    PART_SCALE,
    PART_SHEAR,
    PRIOR_BIAS_M_S2,
    PRIOR_SCALE,
    PRIOR_SHEAR,
    Ground,
    LeastSquares,
    Model,
    PoseMeans,
    Priors,
    ResidualLabel,
    fit,
)
from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up
from companion.physics.gradienter import Law, up_in_sensor
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

W_LIMIT: Final = 4.5
"""Threshold for a normalised residual (Baarda's |w|). Chance exceeds it in one of 1000 alignments of 100 readings."""
SPOT_W_LIMIT: Final = 3.9
"""Threshold for the normalised residual of a return to the marked place (Baarda's |w|). It is lower than `W_LIMIT`,
because an alignment has few returns: chance exceeds it only once in some thousand alignments."""
DETERMINED: Final = 0.2
"""A value counts as determined by the readings if its sigma is below this share of its prior sigma."""
_LEAST_REDUNDANCY: Final = 1e-3
_NINETY_NINE: Final = 2.326  # Sigmas of the one-sided 1 % point of a normal variable
MOST_TURNED_DEG: Final = 30.0
"""Largest plausible rotation of an IMU against the aircraft's base; a larger one shows a wrong orientation setting."""
ALONE: Final = Priors(scale=PRIOR_SCALE, shear=PRIOR_SHEAR, misalignment_deg=3.0, accel_bias_m_s2=PRIOR_BIAS_M_S2)
"""Priors for an alignment without a gradienter: uncalibrated accelerometers on a board that was mounted by eye."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """Estimate of three values, their sigmas, and flags that are true where the poses determine a value; each (3,)."""

    value: Array
    sigma: Array
    determined: NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImuAlignment:
    """Errors of one IMU that remain after the autopilot has subtracted its offsets; vehicle axes (FRD).

    `accel_bias_m_s2` is the bias without the effects of scale and misalignment. `misalignment_rad`: rotation vector
    from the vehicle's axes, which gradienter and aircraft's base define, to this IMU's axes.
    """

    name: str
    level_bias_m_s2: Array
    """Bias (3,) that a calibration of the level aircraft would measure: includes effects of scale and misalignment."""
    level_covariance_m2_s4: Matrix
    accel_bias_m_s2: Figures
    scale: Figures
    shear: Figures  # xy, xz, yz
    misalignment_rad: Figures
    gyro_bias_rad_s: Figures


class Complaint(NamedTuple):
    """Residual farthest beyond its threshold, in multiples of its sigma and in SI units."""

    label: ResidualLabel
    sigmas: float
    size: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Result of an alignment: zero offset of the gradienter, and the errors of all IMUs.

    `checked`: true if the readings would have shown a movement of the ground between two poses.
    """

    offset_deg: Array  # Zero of the gradienter in addition to the configured offset; (2,)
    offset_covariance_deg2: Matrix
    imus: tuple[ImuAlignment, ...]
    slope_deg: float  # Slope of the ground at the marked place; 0 without a marked place
    attitudes: tuple[Matrix, ...]
    chi_square: float
    freedom: int
    checked: bool
    complaint: Complaint | None

    @property
    def offset_sigma_deg(self) -> Array:
        return np.sqrt(np.diag(self.offset_covariance_deg2))


def align(
    law: Law, vehicle_from_sensor: Matrix, stands: Sequence[PoseMeans], ground: Ground, priors: Priors | None = None
) -> Alignment:
    """Estimate all errors from at least one pose; `vehicle_from_sensor` is the gradienter's mounting.

    Raises:
        CalibrationRefusedError: no solution fits, or an IMU would be rotated by more than `MOST_TURNED_DEG`.
    """
    mounting = law, vehicle_from_sensor
    try:
        first_guess = [_first_attitude(law, vehicle_from_sensor, stand) for stand in stands]
        model = Model(mounting, stands, ground, priors or Priors(), first_guess)
        found = fit(model.residuals, model.start, model.sigma, model.damped)
        for k, name in enumerate(model.names):
            turned_rad = float(np.linalg.norm(found.values[model.imu(k, MISALIGNMENT)]))
            turned_deg = abs(math.remainder(turned_rad / DEG, 360.0))
            if turned_deg > MOST_TURNED_DEG:
                raise ValueError(f"imu {name} would sit turned by {turned_deg:.0f} deg")
    except (ValueError, np.linalg.LinAlgError) as error:
        raise CalibrationRefusedError(
            f"the readings do not belong together ({error}): check the gradienter's law and mounting"
        ) from None
    chi_square = float(found.residual @ found.residual)
    freedom = int((found.residual.size - np.count_nonzero(model.sigma)) - sum(model.sigma[model.damped] > 0.0))
    # A return to the marked place is checked if the other poses predict it: its redundancy is then high.
    checked = any(
        group == "spot" and share > 0.1 for (group, *_), share in zip(model.labels, found.redundancy, strict=True)
    )
    covariance = widened_by(chi_square, freedom) * found.covariance
    return Alignment(
        offset_deg=found.values[model.offset] / DEG,
        offset_covariance_deg2=covariance[model.offset, model.offset] / DEG**2,
        imus=tuple(_imu(model, found.values, covariance, ground, k) for k in range(len(model.names))),
        slope_deg=float(np.hypot(*found.values[model.spot])) / DEG if any(stand.on_spot for stand in stands) else 0.0,
        attitudes=tuple(model.attitudes(found.values)),
        chi_square=chi_square,
        freedom=freedom,
        checked=checked,
        complaint=_worst(found, model),
    )


def turned(stands: Sequence[PoseMeans], ground: Ground) -> Alignment:
    """Estimate biases of the level aircraft, and the ground's slope, from 2 or 4 headings at one place, by IMUs alone.

    Raises:
        CalibrationRefusedError: the readings are inconsistent.
    """
    try:
        return align("slope", np.eye(3), stands, ground, ALONE)
    except CalibrationRefusedError:
        raise CalibrationRefusedError("the readings do not belong together: is the orientation right?") from None


_COMPLAINTS: Final = {
    "spot": "stand {stand} is off by {deg:.2f} deg from the others on this spot ({by}): the spot moved, or the aircraft"
    " was not put back onto its marks; begin again on firm ground",
    "compass": "pose {stand}: the heading is off by {deg:.0f} deg ({by}): iron near by? Begin again",
    "turn": "pose {stand}: it was not turned as the gyros say, off by {deg:.0f} deg ({by}): begin again",
    "zero": "the gradienter's zero would be off by {deg:.1f} deg, more than can be ({by}): does the aircraft stand"
    " level on its base, and are law and mounting right?",
    "gradienter": "pose {stand}: the gradienter is off by {deg:.2f} deg ({by}): check its law and mounting",
    "accelerometer": "pose {stand}: imu {name} and the gradienter differ by {mg:.1f} mg ({by}): check the gradienter's"
    " law and mounting, and that nothing is loose",
    "gyro": "pose {stand}: gyro {name} does not fit the other poses ({by}): still warming up? Begin again",
}
_LOOSE: Final = "pose {stand}: imu {name} is off by {mg:.1f} mg ({by}): is something loose? Begin again"
_UNKNOWN: Final = "the poses contradict the known sensor errors ({by}): begin again"


def in_words(complaint: Complaint, *, gradienter: bool = True) -> str:
    """Explain in one line why the poses are inconsistent, and what to do; `gradienter`: the aircraft has one."""
    (group, stand, name), sigmas, size = complaint
    words = _COMPLAINTS.get(group, _UNKNOWN)
    if group == "accelerometer" and not gradienter:
        words = _LOOSE
    by = f"{sigmas:.0f} sigma"
    return words.format(stand=stand, name=name, by=by, deg=size / DEG, mg=size / MG)


def widened_by(chi_square: float, freedom: int) -> float:
    """Return a covariance factor: actual over predicted variance of residuals, or 1 if chance explains it (99 %)."""
    if freedom <= 0:
        return 1.0
    ratio = chi_square / freedom
    return ratio if ratio > chi_square_ratio(freedom, _NINETY_NINE) else 1.0


def _first_attitude(law: Law, mounting: Matrix, stand: PoseMeans) -> Matrix:
    if stand.tilt_deg is not None:
        up = mounting @ up_in_sensor(law, *stand.tilt_deg)
    else:
        up = np.mean([imu.accel_m_s2 for imu in stand.imus], axis=0)
        up = up / np.linalg.norm(up)
    roll, pitch = roll_pitch_from_up(up)
    return body_from_ned(roll, pitch, stand.heading_rad)


def _worst(found: LeastSquares, model: Model) -> Complaint | None:
    residual, redundancy, labels = found.residual, found.redundancy, model.labels
    usable = redundancy > _LEAST_REDUNDANCY
    w = np.where(usable, residual / np.sqrt(np.where(usable, redundancy, 1.0)), 0.0)
    beyond = np.abs(w) / np.array([SPOT_W_LIMIT if group == "spot" else W_LIMIT for group, *_ in labels])
    k = int(np.argmax(beyond))
    if beyond[k] <= 1.0:
        return None
    # All axes of that reading together: one axis alone depends on how the aircraft is turned.
    alone = labels[k][0] in ("zero", "prior")
    axes = [k] if alone else [j for j, label in enumerate(labels) if label == labels[k] and usable[j]]
    size = float(np.linalg.norm(residual[axes] * model.row_sigma[axes] / redundancy[axes]))
    return Complaint(labels[k], abs(float(w[k])), size)


def _imu(model: Model, at: Array, covariance: Matrix, ground: Ground, k: int) -> ImuAlignment:
    def figures(part: int) -> Figures:
        place = model.imu(k, part)
        sigma = np.sqrt(np.diag(covariance)[place])
        before = model.sigma[place]
        return Figures(at[place].copy(), sigma, (before > 0.0) & (sigma < DETERMINED * before))

    step = 1e-6 * np.maximum(model.sigma, 1e-9)
    level = model.reading(at + np.vstack([np.zeros(len(at)), np.diag(step)]), LEVEL[None])[:, 0, k]
    by = (level[1:] - level[0]).T / step
    return ImuAlignment(
        name=model.names[k],
        # Uses the local gravity, as a calibration does.
        level_bias_m_s2=level[0] - ground.gravity_m_s2 * LEVEL,
        level_covariance_m2_s4=by @ covariance @ by.T,
        accel_bias_m_s2=figures(ACCEL_BIAS),
        scale=figures(PART_SCALE),
        shear=figures(PART_SHEAR),
        misalignment_rad=figures(MISALIGNMENT),
        gyro_bias_rad_s=figures(GYRO_BIAS),
    )
