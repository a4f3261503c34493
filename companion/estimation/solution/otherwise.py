"""Attitude without a gradienter or a compass.

Accelerometers whose bias, scale and shear are known from all sides (`alignment.faces`) show which way is up by
themselves: f = (I + S)^-1 (read - b), and whether they still are what they were by the length of f. It is their own
tilt; how the board sits in the aircraft is not in it. The autopilot's yaw is a heading, as good as its compass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.config.sections import AllanModel
from companion.estimation.alignment.align_model import response
from companion.estimation.alignment.faces import BIAS, FIGURES, SCALE, SHEAR, Sides
from companion.estimation.means.windows import ImuWindow
from companion.estimation.noise.allan import floor_variance
from companion.estimation.solution.site import LocalEarth
from companion.estimation.temperature.curve import CATALOGUE_PER_K, CATALOGUE_SCATTER
from companion.physics.frames import Array, Matrix, symmetric_by
from companion.physics.units import DEG, MG

UNKNOWN_K: Final = 5.0
"""Assumed change of an unknown temperature."""
_MEAN_S: Final = 12.0
_SOON_S: Final = 180.0
LENGTH_SIGMAS: Final = 4.0
"""Largest error of the length of gravity; beyond it the figures of the sides are outdated."""


def aged_m_s2(noise: AllanModel, gap_s: float | None, kelvin: float | None) -> float:
    """Estimate one sigma of the change of the accelerometers' biases since all sides were measured.

    `gap_s`: time since then, None: perhaps another power-up. `kelvin`: change of the temperature.
    """
    if gap_s is None:
        wander = CATALOGUE_SCATTER["accel"] ** 2
    else:
        # The sigma of the stands themselves holds what comes within minutes.
        late, soon = (
            floor_variance(noise.flicker, noise.walk, _MEAN_S, 2.0 * each) for each in (max(gap_s, _SOON_S), _SOON_S)
        )
        wander = float(late - soon)
    if kelvin is None:
        kelvin = 0.0 if gap_s is not None and gap_s <= _SOON_S else UNKNOWN_K
    return math.sqrt(wander + (CATALOGUE_PER_K["accel"] * kelvin) ** 2)


class OwnHeading(msgspec.Struct, frozen=True):
    """The autopilot's yaw, clockwise from true north."""

    heading_deg: float
    sigma_deg: float


class Otherwise(msgspec.Struct, frozen=True, kw_only=True):
    """Fallbacks for a missing gradienter or compass."""

    sides: dict[str, Sides] = {}
    """Figures of the accelerometers from all sides, by IMU."""
    heading: OwnHeading | None = None


NOTHING: Final = Otherwise()


class Up(NamedTuple):
    """Up by one IMU's accelerometers alone: a unit vector in the vehicle's axes, and its covariance."""

    up: Array
    covariance: Matrix
    imu: str


def up_by_sides(imus: Sequence[ImuWindow], otherwise: Otherwise, local: LocalEarth, warnings: list[str]) -> Up | None:
    """Estimate up by the first IMU that was measured on all sides and still agrees with gravity.

    Two IMUs are not averaged: their boards may sit differently, and the first one is what the autopilot flies by.
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
            warnings.append(
                f"imu {imu.name} reads {off / MG:+.1f} mg of gravity more than it did on all sides: no tilt from it;"
                " companion align faces measures it again"
            )
            continue
        across = (np.eye(3) - np.outer(up, up)) / length
        return Up(up, across @ covariance @ across.T, imu.name)
    return None


def tilt_in_words(found: Up) -> str:
    """Say the tilt's origin for the record."""
    sigma_deg = float(np.sqrt(np.linalg.eigvalsh(found.covariance)[-1])) / DEG
    return f"no gradienter: tilt by the accelerometers of imu {found.imu}, known from all sides, to {sigma_deg:.2g} deg"


def _force(imu: ImuWindow, known: Sides) -> tuple[Array, Matrix]:
    """Give the specific force in the vehicle's axes, (3,), and its covariance, (3, 3)."""
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
