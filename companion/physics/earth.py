"""Gravity, the Earth's rotation, and the magnetic declination at a place."""

from __future__ import annotations

import datetime
import functools
import math
from typing import Final

import numpy as np
from pygeomag.geomag import GeoMag

from companion.physics.frames import Array
from companion.physics.units import DEG

EARTH_RATE_RAD_S: Final = 7.292115e-5

# WGS 84: semi-major axis, flattening, and m = omega^2 a^2 b / GM.
_SEMI_MAJOR_M: Final = 6378137.0
_FLATTENING: Final = 1 / 298.257223563
_M: Final = 0.00344978650684

WMM_VALID_YEARS: Final = (2025.0, 2030.0)
"""The years for which the world magnetic model WMM2025 is made."""


def gravity_m_s2(latitude_deg: float, height_m: float) -> float:
    """Normal gravity by Somigliana's formula, with height (WGS 84; method section 3, "gravity").

    Args:
        latitude_deg: geodetic.
        height_m: above the ellipsoid; sea level serves (its 100 m at most are 31 micro-g).
    """
    s2 = math.sin(latitude_deg * DEG) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(1 - 0.00669437999014 * s2)
    ratio = height_m / _SEMI_MAJOR_M
    return surface * (1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * s2) * ratio + 3 * ratio**2)


def earth_rate_ned_rad_s(latitude_deg: float) -> Array:
    """The Earth's rotation in NED, shape (3,): (W cos L, 0, -W sin L)."""
    latitude_rad = latitude_deg * DEG
    return np.array([EARTH_RATE_RAD_S * math.cos(latitude_rad), 0.0, -EARTH_RATE_RAD_S * math.sin(latitude_rad)])


def declination_deg(latitude_deg: float, longitude_deg: float, height_m: float, date: datetime.date) -> float:
    """Magnetic declination, east positive: true heading = magnetic heading + declination (WMM2025).

    The paper takes the compass heading as true; the omission costs W cos L sin D (method section 1.3). Outside
    the years of the model its nearest year is used: the secular change is a few tenths of a degree a year, so an
    old model beats none; `WMM_VALID_YEARS` lets the caller say so.
    """
    start = datetime.date(date.year, 1, 1)
    year = date.year + (date - start).days / 365.25
    first, last = WMM_VALID_YEARS
    result = _world_magnetic_model().calculate(
        glat=latitude_deg, glon=longitude_deg, alt=height_m / 1000.0, time=min(max(year, first), last)
    )
    return float(result.d)


@functools.cache
def _world_magnetic_model() -> GeoMag:
    return GeoMag(coefficients_file="wmm/WMM_2025.COF")
