"""Place of the aircraft, with gravity and the Earth's rotation there, and their sigmas.

Missing data widens the sigmas and adds a warning; no default replaces it silently.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
from typing import Final

import numpy as np

from companion.estimation.records.record import SiteRecord
from companion.messages import message
from companion.physics import earth
from companion.physics.frames import Array, Matrix

# Gravity anomaly of 30 mGal, the error of Somigliana's formula (method.md section 2.1).
GRAVITY_MODEL_SIGMA_M_S2: Final = 3.0e-4
GRAVITY_BY_HEIGHT_1_S2: Final = 3.086e-6
UNKNOWN_HEIGHT_SIGMA_M: Final = 1000.0
# Sigma without a position: declination over the inhabited Earth stays within some 20 degrees.
UNKNOWN_DECLINATION_SIGMA_DEG: Final = 12.0

# Averages over the sphere, for an unknown latitude: sin L is uniform in [-1, 1], E cos L = pi / 4.
_MEAN_COS: Final = math.pi / 4
_VARIANCE_COS: Final = 2 / 3 - math.pi**2 / 16
_VARIANCE_SIN: Final = 1 / 3
_MEAN_GRAVITY_M_S2: Final = 9.7976
_GRAVITY_SIGMA_M_S2: Final = 0.0155


@dataclasses.dataclass(frozen=True, slots=True)
class Remedies:
    """Texts that advise how to supply missing data: by configuration keys (default), or by options of a command."""

    latitude: str = "set vehicle.latitude_deg or wait for GPS"
    height: str = "set vehicle.height_m or wait for GPS"
    no_heading: str = "no compass"
    part: str = "name its part (profile), or learn it (companion log profile)"
    mounting: str = "mounting = \"{}\" (autopilot's IMU: board orientation) fits, if the gradienter's is right"
    any_bias: str = "calibration.any_bias = true accepts it"


IN_CONFIGURATION: Final = Remedies()


@dataclasses.dataclass(frozen=True, slots=True)
class Whereabouts:
    """Place and date of a calibration, and the source of the place ("configuration", "autopilot", ...)."""

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_m: float | None = None
    source: str | None = None
    date: datetime.date | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class LocalEarth:
    """Gravity, Earth's rotation (NED) and declination at a place, with one sigma each, and warnings on missing data."""

    site: SiteRecord
    gravity_m_s2: float
    gravity_sigma_m_s2: float
    rate_ned_rad_s: Array
    rate_ned_covariance: Matrix
    declination_deg: float
    declination_sigma_deg: float
    warnings: tuple[str, ...]
    field: earth.MagneticField | None = None  # Magnetic field of the Earth by the model; None without position and date
    remedies: Remedies = IN_CONFIGURATION

    def rate_in_body(self, body_from_ned: Matrix, *, heading_known: bool) -> tuple[Array, Matrix]:
        """Return the Earth's rotation in body axes and its covariance; without a heading, the horizontal part is 0."""
        mean, covariance = self.rate_ned_rad_s, self.rate_ned_covariance
        if not heading_known:
            mean_square_north = mean[0] ** 2 + covariance[0, 0]
            mean = np.array([0.0, 0.0, mean[2]])
            covariance = np.diag([mean_square_north / 2, mean_square_north / 2, covariance[2, 2]])
        return body_from_ned @ mean, body_from_ned @ covariance @ body_from_ned.T


def unknown(what: str, effect: str, remedy: str) -> str:
    return message("input_unknown", what=what, effect=effect, remedy=remedy)


def local_earth(where: Whereabouts, remedies: Remedies = IN_CONFIGURATION) -> LocalEarth:
    warnings: list[str] = []
    covariance, gravity, field = np.zeros((3, 3)), None, None
    if where.latitude_deg is None:
        warnings.append(unknown("latitude", "Earth rate and gravity uncertain", remedies.latitude))
        rate = np.array([earth.EARTH_RATE_RAD_S * _MEAN_COS, 0.0, 0.0])
        covariance = earth.EARTH_RATE_RAD_S**2 * np.diag([_VARIANCE_COS, 0.0, _VARIANCE_SIN])
        gravity_sigma = _GRAVITY_SIGMA_M_S2
    else:
        rate = earth.earth_rate_ned_rad_s(where.latitude_deg)
        gravity = earth.gravity_m_s2(where.latitude_deg, where.height_m or 0.0)
        gravity_sigma = GRAVITY_MODEL_SIGMA_M_S2
        if where.height_m is None:
            warnings.append(unknown("height", "gravity uncertain by 0.3 mg", remedies.height))
            gravity_sigma = math.hypot(gravity_sigma, UNKNOWN_HEIGHT_SIGMA_M * GRAVITY_BY_HEIGHT_1_S2)
        if where.longitude_deg is not None and where.date is not None:
            first, last = earth.WMM_VALID_YEARS
            if not first <= where.date.year < last:
                date, years = where.date.isoformat(), f"magnetic model: {first:.0f} to {last:.0f}"
                warnings.append(unknown(f"declination of {date}", "nearest year used", years))
            field = earth.magnetic_field(where.latitude_deg, where.longitude_deg, where.height_m or 0.0, where.date)
    declination_deg = None if field is None else field.declination_deg
    return LocalEarth(
        site=SiteRecord(
            latitude_deg=where.latitude_deg,
            height_m=where.height_m,
            gravity_m_s2=gravity,
            declination_deg=declination_deg,
            source=where.source,
        ),
        gravity_m_s2=_MEAN_GRAVITY_M_S2 if gravity is None else gravity,
        gravity_sigma_m_s2=gravity_sigma,
        rate_ned_rad_s=rate,
        rate_ned_covariance=covariance,
        declination_deg=declination_deg or 0.0,
        declination_sigma_deg=UNKNOWN_DECLINATION_SIGMA_DEG if field is None else field.declination_sigma_deg,
        warnings=tuple(warnings),
        field=field,
        remedies=remedies,
    )
