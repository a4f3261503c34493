"""The paper's equations (4) to (6) with any of their errors in print, to see what each costs (method 1.3).

Body axes right, forward, up, which the paper calls E, N, U; angles theta, gamma and the compass' psi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sim.aircraft import Pose, Site
from sim.earth import Array, earth_rate_ned_rad_s

Erratum = Literal["4N", "4E", "4U", "5T11,T12", "5row2", "6sign", "psi"]
ERRATA: Final[dict[Erratum, str]] = {
    "4N": "(4) north: -mean + g sin theta",
    "4E": "(4) east: cos theta cos gamma for -cos theta sin gamma",
    "4U": "(4) up: mean + g cos cos",
    "5T11,T12": "(5) T11, T12: minus in the second terms",
    "5row2": "(5) second row: cosine of the latitude for that of theta",
    "6sign": "(6) -mean - T Omega",
    "psi": "the compass' heading for the true one",
}
ALL: Final = frozenset(ERRATA)
NONE: Final[frozenset[Erratum]] = frozenset()

RFU_FROM_FRD: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Its own inverse."""


@dataclass(frozen=True, slots=True)
class Still:
    """How and where it stands, as far as the equations need it."""

    pose: Pose
    site: Site


def biases(still: Still, mean: Array, errata: frozenset[Erratum]) -> Array:
    """Gyro and accelerometer bias (6) of mean readings (6) of rate and specific force; vehicle FRD, SI units."""
    rate, force = RFU_FROM_FRD @ mean[:3], RFU_FROM_FRD @ mean[3:]
    return np.concatenate(
        [RFU_FROM_FRD @ _gyro(still, rate, errata), RFU_FROM_FRD @ _accel(still, force, errata)]
    )  # fmt: skip


def _angles(still: Still) -> tuple[float, float, float]:
    pose = still.pose
    return math.radians(pose.pitch_deg), math.radians(pose.roll_deg), math.radians(pose.heading_deg)


def _accel(still: Still, mean: Array, errata: frozenset[Erratum]) -> Array:
    theta, gamma, _ = _angles(still)
    g = still.site.gravity_m_s2
    level = g * math.cos(theta) * math.cos(gamma)
    e, n, u = mean
    return np.array(
        [
            e - level if "4E" in errata else e + g * math.cos(theta) * math.sin(gamma),
            -n + g * math.sin(theta) if "4N" in errata else n - g * math.sin(theta),
            u + level if "4U" in errata else u - level,
        ]
    )


def _gyro(still: Still, mean: Array, errata: frozenset[Erratum]) -> Array:
    theta, gamma, psi = _angles(still)
    if "psi" in errata:
        psi -= math.radians(still.site.declination_deg)
    st, ct, sg, cg, sp, cp = (f(angle) for angle in (theta, gamma, psi) for f in (math.sin, math.cos))
    second = -1.0 if "5T11,T12" in errata else 1.0
    across = math.cos(math.radians(still.site.latitude_deg)) if "5row2" in errata else ct
    matrix = np.array(
        [
            [cg * cp + second * sg * st * sp, -cg * sp + second * sg * st * cp, -sg * ct],
            [across * sp, across * cp, st],
            [sg * cp - cg * st * sp, -sg * sp - cg * st * cp, cg * ct],
        ]
    )
    north, _, down = earth_rate_ned_rad_s(still.site.latitude_deg)
    earth = matrix @ np.array([0.0, north, -down])
    return np.asarray(-mean - earth if "6sign" in errata else mean - earth)
