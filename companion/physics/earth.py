"""Gravity, rotation and magnetic field of the Earth at a place."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from typing import Final, Literal

import numpy as np
from pygeomag.geomag import GeoMag

from companion.physics.frames import Array
from companion.physics.units import DEG

EARTH_RATE_RAD_S: Final = 7.292115e-5

# WGS 84: semi-major axis, flattening, and m = omega^2 a^2 b / GM.
_SEMI_MAJOR_M: Final = 6378137.0
_FLATTENING: Final = 1 / 298.257223563
_M: Final = 0.00344978650684

WMM_VALID_YEARS: Final = (2025.0, 2030.0)  # Years in which the world magnetic model WMM2025 is valid

GAUSS_PER_NT: Final = 1e-5
CompassUse = Literal["good", "poor", "none"]


def gravity_m_s2(latitude_deg: float, height_m: float) -> float:
    """Return normal gravity by Somigliana's formula (WGS 84; method.md section 3.6).

    The height is above the ellipsoid. Height above sea level also serves: it differs by at most 100 m, or 31 micro-g.
    """
    s2 = math.sin(latitude_deg * DEG) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(1 - 0.00669437999014 * s2)
    ratio = height_m / _SEMI_MAJOR_M
    return surface * (1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * s2) * ratio + 3 * ratio**2)


def earth_rate_ned_rad_s(latitude_deg: float) -> Array:
    """Return the Earth's rotation rate in NED axes, (3,)."""
    latitude_rad = latitude_deg * DEG
    return np.array([EARTH_RATE_RAD_S * math.cos(latitude_rad), 0.0, -EARTH_RATE_RAD_S * math.sin(latitude_rad)])


@dataclasses.dataclass(frozen=True, slots=True)
class MagneticField:
    """Magnetic field of the Earth at a place by WMM2025; the model's own sigmas include effects of crust and sun."""

    declination_deg: float  # East positive: true heading = magnetic heading + declination
    inclination_deg: float  # Down positive: 90 at the north magnetic pole, -90 at the south
    strength_gauss: float
    declination_sigma_deg: float
    inclination_sigma_deg: float
    strength_sigma_gauss: float
    compass_use: CompassUse  # The model's warning zones: "none" below 2000 nT of horizontal field, "poor" below 6000 nT

    @property
    def horizontal_gauss(self) -> float:
        return self.strength_gauss * math.cos(self.inclination_deg * DEG)

    @property
    def down_gauss(self) -> float:
        return self.strength_gauss * math.sin(self.inclination_deg * DEG)


def magnetic_field(latitude_deg: float, longitude_deg: float, height_m: float, date: datetime.date) -> MagneticField:
    """Compute the Earth's magnetic field at a place by the world magnetic model WMM2025.

    Outside the model's years, the nearest year is used: the field changes by a few tenths of a degree a year, so an old
    model is better than none. The caller can warn by `WMM_VALID_YEARS`.
    """
    start = datetime.date(date.year, 1, 1)
    year = date.year + (date - start).days / 365.25
    first, last = WMM_VALID_YEARS
    result = _world_magnetic_model().calculate(
        glat=latitude_deg, glon=longitude_deg, alt=height_m / 1000.0, time=min(max(year, first), last)
    )
    # At the pole itself the declination's error is infinite.
    result.h = max(result.h, 1.0)
    errors = result.calculate_uncertainty()
    return MagneticField(
        declination_deg=float(result.d),
        inclination_deg=float(result.i),
        strength_gauss=float(result.f) * GAUSS_PER_NT,
        declination_sigma_deg=min(float(errors.d), 180.0),
        inclination_sigma_deg=float(errors.i),
        strength_sigma_gauss=float(errors.f) * GAUSS_PER_NT,
        compass_use="none" if result.in_blackout_zone else "poor" if result.in_caution_zone else "good",
    )


@functools.cache
def _world_magnetic_model() -> GeoMag:
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
