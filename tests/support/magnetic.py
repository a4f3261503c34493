"""Windows of a compass that gives its field, standing in a disturbed field that is known."""

from __future__ import annotations

import datetime
import math

import msgspec
import numpy as np

from companion.estimation.means.pose import (
    CompassModel,
    FieldHeading,
    FieldUnit,
    FieldWindow,
    GradienterModel,
    HeadingWindow,
)
from companion.estimation.means.windows import Window
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.samples import MagSample, TiltSample
from tests.support.windows import Array, ideal_window, ned_from_body

DATE = datetime.date(2026, 11, 21)
COUNTS_PER_GAUSS = 4000.0
PLACES = {
    "Beijing": (40.0, 116.0),
    "Munich": (48.1, 11.6),
    "Perth": (-31.9, 115.9),
    "Santiago": (-33.4, -70.7),
    "Hobart": (-42.9, 147.3),
    "Quito": (-0.2, -78.5),
    "Bangkok": (13.7, 100.5),
    "Tromso": (69.6, 18.9),
    "Resolute": (74.7, -94.8),
}


def local(place: str) -> LocalEarth:
    latitude, longitude = PLACES[place]
    return local_earth(
        Whereabouts(latitude_deg=latitude, longitude_deg=longitude, height_m=50.0, source="test", date=DATE)
    )


def gradienter(sigma_deg: float = 0.05) -> GradienterModel:
    return GradienterModel("euler", np.eye(3), (0.0, 0.0), sigma_deg)


def compass(
    *, sigma_deg: float = 0.5, mounting: Array | None = None, counts_per_gauss: float | None = None
) -> CompassModel:
    return CompassModel(True, np.eye(3) if mounting is None else mounting, 0.0, sigma_deg, counts_per_gauss)


def earth_field_ned(where: LocalEarth) -> Array:
    """The undisturbed field in gauss, put together again from its three elements."""
    assert where.field is not None
    f, i, d = where.field.strength_gauss, where.field.inclination_deg, where.field.declination_deg
    i, d = math.radians(i), math.radians(d)
    return f * np.array([math.cos(i) * math.cos(d), math.cos(i) * math.sin(d), math.sin(i)])


def window(
    where: LocalEarth,
    pose_deg: tuple[float, float, float],
    disturbance_ned: Array,
    model: CompassModel,
    *,
    tilt_error_deg: tuple[float, float] = (0.0, 0.0),
    noise: Array | None = None,
    unit: FieldUnit = "gauss",
    device_heading_deg: float | None = None,
) -> Window:
    """Pitch, roll, heading; the field as the sensor in its own axes measures it; the heading that we make of it."""
    ned_body = ned_from_body(*pose_deg)
    assert where.site.latitude_deg is not None
    found = ideal_window(
        ned_body=ned_body,
        body_gradienter=np.eye(3),
        law="euler",
        latitude_deg=where.site.latitude_deg,
        gravity_m_s2=where.gravity_m_s2,
        heading_deg=0.0,
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
    )
    assert found.tilt is not None
    tilt = msgspec.structs.replace(
        found.tilt, x_deg=found.tilt.x_deg + tilt_error_deg[0], y_deg=found.tilt.y_deg + tilt_error_deg[1]
    )
    field = model.vehicle_from_sensor.T @ ned_body.T @ (earth_field_ned(where) + disturbance_ned)
    field = field + (np.zeros(3) if noise is None else noise)
    if unit == "counts":
        field = np.rint(field * COUNTS_PER_GAUSS)
    x, y, z = field.tolist()
    if device_heading_deg is None:
        maker = FieldHeading(model, gradienter(), 10)
        maker.take_tilt(TiltSample(0.0, tilt.x_deg, tilt.y_deg))
        maker.add(MagSample(0.0, (x, y, z)))
        maker.take_tilt(TiltSample(10.0, tilt.x_deg, tilt.y_deg))
        made = maker.add(MagSample(10.0, (x, y, z)))
        assert made is not None, maker.hint
        heading = HeadingWindow(heading_deg=made.heading_deg, sigma_deg=0.0, from_field=True)
    else:
        heading = HeadingWindow(heading_deg=device_heading_deg % 360.0, sigma_deg=0.0)
    return msgspec.structs.replace(
        found,
        tilt=tilt,
        heading=heading,
        field=FieldWindow(field=(x, y, z), sigma=(0.0, 0.0, 0.0), unit=unit),
    )
