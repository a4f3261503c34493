"""Quality check of a compass heading, by its magnetic field, its steadiness and the Earth's field.

A disturbance of the field has three components. Two are visible, as errors of the strength F and of the inclination I.
The third, across the meridian, turns the heading and is invisible. If all three have the same unknown sigma, the third
exceeds `BOUND_OF_TWO` times the root sum of squares of the visible two in one case of twenty. A disturbance dB turns
the heading by dB / (F cos I). At I = 68 degrees, 1.3 uT turn it by 4 degrees, and a gate of 5 % on the strength misses
them (method.md section 3.5). The uncertainty of the Earth's field model WMM2025 counts as visible disturbance.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np

from companion.estimation.means.pose import CompassModel, FieldWindow, HeadingWindow, vehicle_heading_rad
from companion.estimation.records.record import Magnetic
from companion.estimation.solution.site import LocalEarth, unknown
from companion.messages import message
from companion.physics.earth import MagneticField
from companion.physics.frames import Array, Matrix, wrap_deg
from companion.physics.magnetic import (
    BOUND_OF_ONE,
    BOUND_OF_TWO,
    deflection_bound_deg,
    heading_by_up,
    heading_rad,
    inclination_by_up,
    inclination_rad,
)
from companion.physics.units import DEG

STRENGTH_GATE: Final = 0.02
INCLINATION_GATE_DEG: Final = 1.0
"""Least inclination error that causes a warning; for the field's strength: `STRENGTH_GATE` (method.md section 3.5)."""
UNIT_GATE: Final = 0.5
"""Relative deviation from the Earth's field strength beyond which the compass' unit or scale must be wrong."""
WANDER_WARNING_DEG: Final = 1.5
DEVICE_WARNING_DEG: Final = 3.0
"""Largest difference of a compass' own heading from that of its field without warning: 3 sigma of a level HMR3300."""
USELESS_DEG: Final = 60.0
"""Heading error beyond which a heading is useless for subtracting the Earth's rate from the gyros."""
_NINETY_FIVE: Final = 1.96


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CompassHeading:
    """True heading by a compass, with its sigma, the quality of its field, and warnings."""

    heading_rad: float
    sigma_rad: float  # One sigma at an exact tilt; `heading_by_up` gives the effect of a tilt error
    heading_by_up: Array  # Gradient by up in the vehicle's axes, (3,): zero for a device's own heading
    is_usable: bool
    magnetic: Magnetic
    warnings: tuple[str, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class _MeanField:
    strength_gauss: float | None = None
    inclination_rad: float | None = None
    heading_rad: float | None = None  # Heading of the vehicle by the compass' north, with our tilt compensation
    bound_deg: float | None = None  # Bound of the heading error from a disturbance, degrees


def assess(
    window: HeadingWindow,
    field: FieldWindow | None,
    compass: CompassModel,
    local: LocalEarth,
    up: Array,
    up_covariance: Matrix | None,
    may_turn_deg: float = 0.0,
) -> CompassHeading:
    """Estimate the true heading from the compass' window, and bound its error.

    `up_covariance` is None if the tilt is from accelerometers of unknown bias; the inclination is then unknown.
    `may_turn_deg` is the largest turn of the aircraft within the window that other sensors would miss.
    """
    heading = vehicle_heading_rad(compass, window.heading_deg, up)
    found = _MeanField() if field is None else _judge(field, compass, local, up, up_covariance)
    gradient, vertical = np.zeros(3), False
    if window.from_field and field is not None:
        try:
            gradient = heading_by_up(compass.vehicle_from_sensor @ np.array(field.field), up)
        except ValueError:
            vertical = True
    difference = None
    if not window.from_field and found.heading_rad is not None:
        difference = wrap_deg((heading - found.heading_rad) / DEG)
    declination_sigma_deg = local.declination_sigma_deg if compass.magnetic else 0.0
    wander_deg = window.wander_deg or 0.0
    bound_deg = None
    if found.bound_deg is not None:
        tilt_deg = 0.0 if up_covariance is None else math.sqrt(gradient @ up_covariance @ gradient) / DEG
        chance_deg = _NINETY_FIVE * math.hypot(tilt_deg, window.sigma_deg, declination_sigma_deg)
        bound_deg = min(math.hypot(max(found.bound_deg, abs(difference or 0.0)), wander_deg, chance_deg), 180.0)
    sigma_deg = math.hypot(max(compass.sigma_at(up), wander_deg), window.sigma_deg, declination_sigma_deg)
    # A compass that shows true north does not depend on the horizontal field.
    use = local.field.compass_use if compass.magnetic and local.field is not None else "good"
    useless = vertical or (bound_deg or 0.0) > USELESS_DEG or use == "none"
    if useless:
        bound_deg = 180.0
    earths = local.field
    warnings = [message("no_heading", reason="compass field is vertical")] if vertical else []
    if use == "none":
        warnings.append(message("no_heading", reason="too near the magnetic pole for a compass"))
    elif use == "poor":
        warnings.append(unknown("exact heading", "gyro sigma widened", "near the magnetic pole"))
    if earths is not None:
        warnings += _disturbed(found, earths, bound_deg, useless=useless, near_pole=use == "none")
    warnings += _unsteady(window, difference, may_turn_deg)
    if field is not None and field.unit == "counts":
        warnings.append(unknown("compass field strength", "only its direction is checked", "set counts_per_gauss"))
    if field is not None and up_covariance is None:
        warnings.append(unknown("heading error", "tilt of the compass field not measured", "no gradienter"))
    return CompassHeading(
        heading_rad=heading + (local.declination_deg * DEG if compass.magnetic else 0.0),
        # Keep sigma at or above the bound: a disturbance may last for the whole flight.
        sigma_rad=max(sigma_deg, bound_deg or 0.0) * DEG,
        heading_by_up=gradient,
        is_usable=not useless,
        magnetic=Magnetic(
            heading_bound_deg=_rounded(bound_deg, 2),
            heading_from="field" if window.from_field else "device",
            field_gauss=_rounded(found.strength_gauss, 5),
            field_expected_gauss=None if earths is None else _rounded(earths.strength_gauss, 5),
            inclination_deg=None if found.inclination_rad is None else _rounded(found.inclination_rad / DEG, 3),
            inclination_expected_deg=None if earths is None else _rounded(earths.inclination_deg, 3),
            device_minus_field_deg=_rounded(difference, 2),
            wander_deg=_rounded(window.wander_deg, 2),
        ),
        warnings=tuple(warnings),
    )


def _judge(
    field: FieldWindow, compass: CompassModel, local: LocalEarth, up: Array, up_covariance: Matrix | None
) -> _MeanField:
    """Compute strength, inclination and heading of the mean field; bound the heading error by a hidden disturbance."""
    vector = compass.vehicle_from_sensor @ np.array(field.field)
    size = float(np.linalg.norm(vector))
    strength = size if field.unit == "gauss" else None
    if up_covariance is None or size == 0.0:
        return _MeanField(strength)
    inclination, expected = inclination_rad(vector, up), local.field
    try:
        own = heading_rad(np.array(field.field), compass.vehicle_from_sensor.T @ up)
        by_up = inclination_by_up(vector, up)
    except ValueError:
        return _MeanField(strength, inclination, None, None if expected is None else 180.0)
    own = vehicle_heading_rad(compass, own / DEG, up)
    if expected is None:
        return _MeanField(strength, inclination, own)
    noise = float(np.linalg.norm(field.sigma)) / size
    dip_sigma_rad = math.sqrt((expected.inclination_sigma_deg * DEG) ** 2 + by_up @ up_covariance @ by_up + noise**2)
    # A device without a unit shows the dip only: assume that its field has the Earth's strength.
    used = expected.strength_gauss if strength is None else strength
    across = used * math.cos(inclination)
    seen = math.hypot(
        across - expected.horizontal_gauss,
        used * math.sin(inclination) - expected.down_gauss,
        expected.strength_gauss * dip_sigma_rad,
        0.0 if strength is None else math.hypot(expected.strength_sigma_gauss, noise * size),
    )
    unseen = seen * (BOUND_OF_ONE if strength is None else BOUND_OF_TWO)
    return _MeanField(strength, inclination, own, deflection_bound_deg(unseen, across))


def _disturbed(
    found: _MeanField, earths: MagneticField, bound_deg: float | None, *, useless: bool, near_pole: bool
) -> list[str]:
    warnings, parts = [], []
    if found.strength_gauss is not None:
        off = found.strength_gauss / earths.strength_gauss - 1.0
        if abs(off) > UNIT_GATE:
            gauss, expected = f"{found.strength_gauss:.3g}", f"{earths.strength_gauss:.3g}"
            warnings.append(message("compass_field_strength_wrong", gauss=gauss, expected=expected))
        if abs(off) > STRENGTH_GATE:
            parts.append(f"{abs(off) * 100.0:.0f} % {'above' if off > 0.0 else 'below'} the Earth's")
    if found.inclination_rad is not None:
        dip = found.inclination_rad / DEG - earths.inclination_deg
        if abs(dip) > INCLINATION_GATE_DEG:
            parts.append(f"{abs(dip):.1f} deg off the Earth's inclination")
    if parts:
        effect = "" if bound_deg is None else f", heading may be off by {bound_deg:.0f} deg"
        effect = ", heading useless" if useless else effect
        warnings.append(message("compass_disturbed", fault=f"field {' and '.join(parts)}{effect}"))
    elif useless and not near_pole:
        warnings.append(message("no_heading", reason="compass field too flat or too steep"))
    return warnings


def _unsteady(window: HeadingWindow, difference: float | None, may_turn_deg: float) -> list[str]:
    warnings = []
    if window.wander_deg is not None and window.wander_deg > WANDER_WARNING_DEG:
        gyros = "gyros do not" if window.wander_deg > may_turn_deg else "or the aircraft turns slowly"
        warnings.append(message("compass_disturbed", fault=f"moves by {window.wander_deg:.1f} deg, {gyros}"))
    if difference is not None and abs(difference) > DEVICE_WARNING_DEG:
        warnings.append(message("compass_headings_differ", difference=f"{abs(difference):.0f}"))
    return warnings


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
