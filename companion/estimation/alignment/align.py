"""From several still stands to the gradienter's zero, and to what else they tell (method 3.4).

One still pose cannot tell a zero offset of the gradienter from a bias of the accelerometers; the same spot seen twice,
turned by 180 degrees, can. Further tilts tell bias from scale and how the gradienter sits against each IMU. Everything
is estimated together, by Gauss-Newton with priors, so that what the stands do not determine keeps the sigma of what
was known before: it is widened, never guessed.

Readings that do not fit together are refused: every residual is set against what is left of its own sigma (Baarda's
w-test), which names the stand that is off, and finds a spot that moved before any sum of squares does.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align_model import DOWN, Ground, Model, Part, Priors, Row, Stand, Unknowns
from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up
from companion.physics.gradienter import Law, up_in_sensor
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

MAX_ROUNDS: Final = 30
_CONVERGED: Final = 1e-4
"""Of the prior sigma of each parameter."""
W_LIMIT: Final = 4.5
"""|w| of one residual: passed by chance once in some thousand alignments of a hundred readings."""
SPOT_W_LIMIT: Final = 3.9
"""Of a placement, of which there are few: likewise once in some thousand."""
DETERMINED: Final = 0.2
"""A figure counts as determined where its sigma is below this share of what was known before."""
_LEAST_REDUNDANCY: Final = 1e-3
_NINETY_NINE: Final = 2.326
"""Sigmas that a normal number exceeds in one case of a hundred."""
MOST_TURNED_DEG: Final = 30.0
"""Of an IMU against the base: more is another orientation than the one configured."""
LEVEL: Final = -DOWN


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """Three figures with their sigmas, shape (3,), and whether the stands determine each."""

    value: Array
    sigma: Array
    determined: NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImuAlignment:
    """What was found of one IMU, vehicle FRD; of an autopilot's IMU, of its output as it comes."""

    name: str
    level_bias_m_s2: Array
    """Effective bias when level: what a calibration there would find, scale and misalignment included; (3,)."""
    level_covariance_m2_s4: Matrix
    accel_bias_m_s2: Figures
    """Without scale, shear and misalignment."""
    scale: Figures
    shear: Figures
    """xy, xz, yz."""
    misalignment_rad: Figures
    """Rotation vector from the axes of gradienter and base to this IMU's."""
    gyro_bias_rad_s: Figures


@dataclasses.dataclass(frozen=True, slots=True)
class Complaint:
    """The residual that fits worst: by how many of its own sigmas, and how much that is in SI units."""

    row: Row
    sigmas: float
    size: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The result of `align`."""

    offset_deg: Array
    """What the gradienter shows too much, on top of the configured offset; (2,)."""
    offset_covariance_deg2: Matrix
    imus: tuple[ImuAlignment, ...]
    slope_deg: float
    """Of the spot; 0 without one."""
    attitudes: tuple[Matrix, ...]
    chi_square: float
    freedom: int
    checked: bool
    """Whether a spot that moved between two stands could have been noticed."""
    complaint: Complaint | None

    @property
    def offset_sigma_deg(self) -> Array:
        """One sigma per axis, shape (2,)."""
        return np.sqrt(np.diag(self.offset_covariance_deg2))


def align(
    law: Law, vehicle_from_sensor: Matrix, stands: Sequence[Stand], ground: Ground, priors: Priors | None = None
) -> Alignment:
    """Estimate everything from all stands, at least one, together; `vehicle_from_sensor` is the gradienter's mounting.

    Raises:
        CalibrationRefusedError: the equations cannot be solved: readings that cannot belong together.
    """
    model = Model(law, vehicle_from_sensor, stands, ground, priors or Priors())
    try:
        at = model.begin([_first_attitude(law, vehicle_from_sensor, stand) for stand in stands])
        at, residual, scaled, rows = _solve(model, at)
        for name, imu in zip(model.names, at.imus, strict=True):
            turned_deg = abs(math.remainder(float(np.linalg.norm(imu[Part.MISALIGNMENT])) / DEG, 360.0))
            if turned_deg > MOST_TURNED_DEG:
                raise ValueError(f"imu {name} would sit turned by {turned_deg:.0f} deg")
    except (ValueError, np.linalg.LinAlgError) as error:
        raise CalibrationRefusedError(
            f"the readings do not belong together ({error}): check the gradienter's law and mounting"
        ) from None
    sought = model.sigma > 0.0
    inverse = np.linalg.inv(scaled.T @ scaled)
    chi_square, freedom = float(residual @ residual), len(residual) - int(sought.sum()) - model.damped
    complaint, checked = _worst(residual, scaled @ inverse, scaled, rows, model)
    covariance = np.zeros((model.size, model.size))
    sigma = model.sigma[sought]
    covariance[np.ix_(sought, sought)] = widened_by(chi_square, freedom) * inverse * np.outer(sigma, sigma)
    return Alignment(
        offset_deg=at.values[model.offset] / DEG,
        offset_covariance_deg2=covariance[model.offset, model.offset] / DEG**2,
        imus=tuple(_imu(model, at, covariance, k) for k in range(len(model.names))),
        slope_deg=float(np.hypot(*at.values[model.spot])) / DEG if any(stand.on_spot for stand in stands) else 0.0,
        attitudes=tuple(at.attitudes),
        chi_square=chi_square,
        freedom=freedom,
        checked=checked,
        complaint=complaint,
    )


def in_words(complaint: Complaint, *, gradienter: bool = True) -> str:
    """Why the stands do not fit together, and what to do, in one line; `gradienter`: whether there was one."""
    row, size = complaint.row, complaint.size
    by = f"{complaint.sigmas:.0f} sigma"
    if row.group == "spot":
        return (
            f"stand {row.stand} is off by {size / DEG:.2f} deg from the others on this spot ({by}): the spot moved, or"
            " the aircraft was not put back onto its marks; begin again on firm ground"
        )
    if row.group == "compass":
        return f"stand {row.stand}: the heading is off by {size / DEG:.0f} deg ({by}): iron near by? Begin again"
    if row.group == "turn":
        return f"stand {row.stand}: it was not turned as the gyros say, off by {size / DEG:.0f} deg ({by}): begin again"
    if row.group == "zero":
        return (
            f"the gradienter's zero would be off by {size / DEG:.1f} deg, more than can be ({by}): does the aircraft"
            " stand level on its base, and are law and mounting right?"
        )
    if row.group == "gradienter":
        return f"stand {row.stand}: the gradienter is off by {size / DEG:.2f} deg ({by}): check its law and mounting"
    if row.group == "accelerometer" and not gradienter:
        return f"stand {row.stand}: imu {row.name} is off by {size / MG:.1f} mg ({by}): is something loose? Begin again"
    if row.group == "accelerometer":
        return (
            f"stand {row.stand}: imu {row.name} and the gradienter differ by {size / MG:.1f} mg ({by}): check the"
            " gradienter's law and mounting, and that nothing is loose"
        )
    if row.group == "gyro":
        return f"stand {row.stand}: gyro {row.name} does not fit the other stands ({by}): still warming up? Begin again"
    return f"the stands do not fit what is known of the sensors ({by}): begin again"


def widened_by(chi_square: float, freedom: int) -> float:
    """Give the variance of the residuals over that of their sigmas where it is beyond its 99 % point, else 1."""
    if freedom <= 0:
        return 1.0
    ratio = chi_square / freedom
    return ratio if ratio > chi_square_ratio(freedom, _NINETY_NINE) else 1.0


def _first_attitude(law: Law, mounting: Matrix, stand: Stand) -> Matrix:
    if stand.tilt_deg is not None:
        up = mounting @ up_in_sensor(law, *stand.tilt_deg)
    else:
        up = np.mean([imu.accel_m_s2 for imu in stand.imus], axis=0)
        up = up / np.linalg.norm(up)
    roll, pitch = roll_pitch_from_up(up)
    return body_from_ned(roll, pitch, stand.heading_rad)


def _solve(model: Model, at: Unknowns) -> tuple[Unknowns, Array, Matrix, list[Row]]:
    """Gauss-Newton in units of the prior sigmas: the residuals at the end, and their derivatives in those units."""
    sought = model.sigma > 0.0
    sigma = model.sigma[sought]
    for _ in range(MAX_ROUNDS):
        residual, derivative, rows = model.linearise(at)
        scaled = derivative[:, sought] * sigma
        step = np.linalg.lstsq(scaled, residual, rcond=None)[0]
        whole = np.zeros(model.size)
        whole[sought] = step * sigma
        model.step(at, whole)
        if not np.isfinite(step).all():
            break
        if np.abs(step).max() < _CONVERGED:
            residual, derivative, rows = model.linearise(at)
            return at, residual, derivative[:, sought] * sigma, rows
    raise ValueError("no solution was found")


def _worst(
    residual: Array, by_inverse: Matrix, scaled: Matrix, rows: Sequence[Row], model: Model
) -> tuple[Complaint | None, bool]:
    """The residual that is worst against its own sigma, if it is too bad; and whether the spot is checked at all."""
    redundancy = 1.0 - np.einsum("ij,ij->i", by_inverse, scaled)
    usable = redundancy > _LEAST_REDUNDANCY
    w = np.where(usable, residual / np.sqrt(np.where(usable, redundancy, 1.0)), 0.0)
    # A stand's placement is checked where the other stands foretell it: what they leave of it is its redundancy.
    on_spot = np.array([row.group == "spot" for row in rows])
    checked = bool((redundancy[on_spot] > 0.1).any())
    beyond = np.abs(w) / np.where(on_spot, SPOT_W_LIMIT, W_LIMIT)
    k = int(np.argmax(beyond))
    if beyond[k] <= 1.0:
        return None, checked
    units = _units(model, rows[k])
    # All axes of that reading together: what one axis says depends on how the aircraft is turned.
    alone = rows[k].group in ("zero", "prior")
    axes = [k] if alone else [j for j, row in enumerate(rows) if row == rows[k] and usable[j]]
    size = float(np.linalg.norm(residual[axes] / redundancy[axes])) * units
    return Complaint(rows[k], abs(float(w[k])), size), checked


def _units(model: Model, row: Row) -> float:
    """Sigma of the residuals of that group, by which they were divided."""
    if row.group == "spot":
        return model.priors.placement_deg * DEG
    if row.group == "zero":
        return model.priors.offset_deg * DEG
    if row.stand == 0:
        return 1.0
    stand = model.stands[row.stand - 1]
    if row.group in ("compass", "turn"):
        return stand.heading_sigma_rad
    if row.group == "gradienter":
        return math.hypot(*stand.tilt_sigma_deg) / math.sqrt(2.0) * DEG
    imu = next(imu for imu in stand.imus if imu.name == row.name)
    return float(np.mean(imu.accel_sigma_m_s2 if row.group == "accelerometer" else imu.gyro_sigma_rad_s))


def _imu(model: Model, at: Unknowns, covariance: Matrix, k: int) -> ImuAlignment:
    def figures(part: Part) -> Figures:
        place = model.imu(k, part)
        sigma = np.sqrt(np.diag(covariance)[place])
        before = model.sigma[place]
        return Figures(at.imus[k, part].copy(), sigma, (before > 0.0) & (sigma < DETERMINED * before))

    by = model.reading_by(at, k, LEVEL)
    return ImuAlignment(
        name=model.names[k],
        # Gravity is what the place says, as in a calibration: where it is off, so is that.
        level_bias_m_s2=model.reading(at, k, LEVEL) - model.ground.gravity_m_s2 * LEVEL,
        level_covariance_m2_s4=by @ covariance @ by.T,
        accel_bias_m_s2=figures(Part.ACCEL_BIAS),
        scale=figures(Part.SCALE),
        shear=figures(Part.SHEAR),
        misalignment_rad=figures(Part.MISALIGNMENT),
        gyro_bias_rad_s=figures(Part.GYRO_BIAS),
    )
