"""Gradienter and compass: conversion of readings to up and heading, and means (method.md sections 1.2 and 3.5).

The heading that a compass sends is used, unless the configuration prefers the one computed from its field vector and
the gradienter's tilt. A field without a gradienter gives no heading, because no other sensor measures the tilt well
enough. The heading's error is tan I times the tilt's error: 2.5 times at a magnetic inclination I of 68 degrees.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.estimation.noise.allan import white_noise
from companion.estimation.noise.lines import huber_mean
from companion.estimation.seconds.batch import Batch, BatchSource, decimal, few_distinct
from companion.physics.frames import Array, Floats, Matrix, body_from_ned, roll_pitch_from_up, vector
from companion.physics.gradienter import Law, up_in_sensor
from companion.physics.magnetic import heading_rad
from companion.physics.units import DEG
from companion.samples import CompassSample, MagSample, TiltSample

LEVEL_COSINE: Final = math.cos(2.0 * DEG)
"""Cosine of the largest tilt at which a compass counts as level; data sheets state errors "level" and "tilted" only."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GradienterModel:
    """Parameters of a gradienter, which measures up in the vehicle's axes: law, zero offset, mounting, sigma, lag."""

    law: Law
    vehicle_from_sensor: Matrix
    offset_deg: tuple[float, float]
    sigma_deg: float
    lag_s: float = 0.0  # Time constant of the device

    def up(self, x_deg: float, y_deg: float) -> Array:
        """Return the unit vector up (3,), in the vehicle's axes, from readings minus the offset.

        Raises:
            ValueError: the readings are inconsistent.
        """
        return self.vehicle_from_sensor @ up_in_sensor(self.law, x_deg, y_deg)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CompassModel:
    """Parameters of a compass: reference north (magnetic or true), offset, mounting, sigma, lag."""

    magnetic: bool
    vehicle_from_sensor: Matrix
    offset_deg: float
    sigma_deg: float
    counts_per_gauss: float | None = None
    """Counts per gauss in the readings of a field; None: only the direction of the field is known."""
    prefers_field: bool = False  # True: compute the heading from the field even if the device sends its own
    tilted_sigma_deg: float | None = None
    """Sigma of the heading, degrees, while the compass is not level; None: equal to `sigma_deg`."""
    lag_s: float = 0.0  # Time constant of the device

    def sigma_at(self, up: Array) -> float:
        """Return the heading's sigma, degrees, at a tilt. `up` (3,): unit vector in the vehicle's axes."""
        upright = float(-(self.vehicle_from_sensor.T @ up)[2])
        if self.tilted_sigma_deg is None or upright >= LEVEL_COSINE:
            return self.sigma_deg
        return self.tilted_sigma_deg


def up_in_vehicle(model: GradienterModel, x_deg: float, y_deg: float) -> Array:
    """Return the unit vector up (3,), in the vehicle's axes, from raw readings; raises as `GradienterModel.up`."""
    return model.up(x_deg - model.offset_deg[0], y_deg - model.offset_deg[1])


def vehicle_heading_rad(compass: CompassModel, heading_deg: float, up: Array) -> float:
    """Return the heading of the vehicle, rad, from the compass' own north (magnetic or true), not wrapped.

    A compass reports the azimuth of its own forward axis. The mounting adds to this the azimuth that the axis would
    have, at the present tilt, if the vehicle headed north.
    """
    gamma, theta = roll_pitch_from_up(up)
    forward_ned = body_from_ned(gamma, theta, 0.0).T @ compass.vehicle_from_sensor[:, 0]
    mounted_rad = math.atan2(forward_ned[1], forward_ned[0])
    return (heading_deg + compass.offset_deg) * DEG - mounted_rad


class TiltWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Mean gradienter readings of a window, in the gradienter's axes; the sigmas are from the scatter only."""

    x_deg: float
    y_deg: float
    x_sigma_deg: float
    y_sigma_deg: float
    temperature_degc: float | None


class HeadingWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Circular mean of the compass heading over a window, degrees in [0, 360); sigma is from the scatter only."""

    heading_deg: float
    sigma_deg: float
    from_field: bool = False  # True: computed from the device's field and the gradienter's tilt
    wander_deg: float | None = None
    """Range of the heading, degrees, since any other sensor last showed a movement; None: too few seconds."""


FieldUnit = Literal["gauss", "counts"]


class FieldWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Mean magnetic field of a window, in the compass' own axes; the sigmas are from the scatter only."""

    field: tuple[float, float, float]
    sigma: tuple[float, float, float]
    unit: FieldUnit


def tilt_window(batches: Sequence[Batch]) -> TiltWindow:
    (x_deg, y_deg), (x_sigma_deg, y_sigma_deg) = _pose_mean(batches, np.array([batch.mean for batch in batches]))
    temperatures = [batch.temperature_degc for batch in batches if batch.temperature_degc is not None]
    return TiltWindow(
        x_deg=float(x_deg),
        y_deg=float(y_deg),
        x_sigma_deg=float(x_sigma_deg),
        y_sigma_deg=float(y_sigma_deg),
        temperature_degc=float(np.mean(temperatures)) if temperatures else None,
    )


def heading_window(batches: Sequence[Batch], *, from_field: bool, wander_deg: float | None) -> HeadingWindow:
    first = batches[0].mean
    turned = np.array([np.mod(batch.mean - first + 180.0, 360.0) - 180.0 for batch in batches])
    mean, sigma = _pose_mean(batches, turned)
    return HeadingWindow(
        heading_deg=float(np.mod(mean[0] + first[0], 360.0)),
        sigma_deg=float(sigma[0]),
        from_field=from_field,
        wander_deg=wander_deg,
    )


def _pose_mean(batches: Sequence[Batch], values: Floats) -> tuple[Floats, Floats]:
    slots = np.array([batch.slot for batch in batches], dtype=np.int64)
    variance = np.square(white_noise(slots, values)) / len(values) + np.square(_resolution(batches)) / 12.0
    return huber_mean(values), np.asarray(np.sqrt(variance))


def _resolution(batches: Sequence[Batch]) -> Floats:
    """Return the step (c,) of channels with two values (their difference) or one (its last decimal); of others, 0."""
    low = np.min([batch.low for batch in batches], axis=0)
    high = np.max([batch.high for batch in batches], axis=0)
    few = few_distinct(np.array([batch.distinct for batch in batches]))
    return np.where(few, np.where(high > low, high - low, decimal(low, high)), 0.0)


OLDEST_TILT_S: Final = 1.0  # Maximum age of a tilt; the slowest gradienters send five readings in that time
OWN_HEADING_S: Final = 2.0
"""Time, s, without a heading from the device after which a compass counts as sending its field only."""
_LIMITS: Final = (1e6,) * 3


class FieldHeading:
    """Computes magnetic headings of the compass' own forward axis from its field and the gradienter's tilt."""

    def __init__(self, compass: CompassModel, gradienter: GradienterModel | None, keep: int) -> None:
        self._compass, self._gradienter = compass, gradienter
        self._keep = keep
        self._tilt: TiltSample | None = None
        self._own_s: float | None = None
        self._begun_s: float | None = None
        self.unit: FieldUnit = "gauss"
        self.batches = BatchSource(_LIMITS, keep)
        self.from_field = False  # True: the latest heading in use was computed from the field
        self.hint = ""
        """Reason why no heading can be computed from the field, although one is needed; else empty."""

    def take_tilt(self, sample: TiltSample) -> None:
        self._tilt = sample

    def takes_own(self, sample: CompassSample) -> bool:
        """Add a heading that the compass computed; return false if one from its magnetic field is used instead."""
        if self._compass.prefers_field:
            return False
        self._own_s, self.from_field, self.hint = sample.t_s, False, ""
        return True

    def add(self, sample: MagSample) -> CompassSample | None:
        """Add a magnetic field; return the heading computed from the field, if that heading is used."""
        field = self._in_unit(sample)
        if field is None:
            return None
        self.batches.add(sample.t_s, vector(field))
        if self._begun_s is None:
            self._begun_s = sample.t_s
        since_s = self._begun_s if self._own_s is None else self._own_s
        if not self._compass.prefers_field and abs(sample.t_s - since_s) < OWN_HEADING_S:
            return None
        up = self._up(sample.t_s)
        if up is None:
            return None
        try:
            heading = heading_rad(field, self._compass.vehicle_from_sensor.T @ up)
        except ValueError:
            self.hint = "compass field is vertical: no heading"
            return None
        self.from_field, self.hint = True, ""
        return CompassSample(sample.t_s, heading / DEG % 360.0)

    def window(self, slots: Sequence[int]) -> FieldWindow | None:
        found = [self.batches.batches[slot] for slot in slots if slot in self.batches.batches]
        if not found:
            return None
        mean, sigma = _pose_mean(found, np.array([batch.mean for batch in found]))
        return FieldWindow(field=vector(mean), sigma=vector(sigma), unit=self.unit)

    def _in_unit(self, sample: MagSample) -> Array | None:
        scale, read = self._compass.counts_per_gauss, sample.field_gauss
        unit: FieldUnit = "gauss" if read is not None or scale is not None else "counts"
        if read is None and sample.counts is None:
            return None
        field = np.array(sample.counts if read is None else read, dtype=np.float64)
        if read is None:
            field /= scale or 1.0
        if not np.isfinite(field).all():
            return None
        if unit != self.unit:
            # Means over both units would be meaningless.
            self.unit, self.batches = unit, BatchSource(_LIMITS, self._keep)
        return field

    def _up(self, t_s: float) -> Array | None:
        """Return the present unit vector up (3,) in the vehicle's axes, or None with the reason in `hint`."""
        if not self._compass.magnetic:
            self.hint = 'compass sends its field only, and that shows magnetic north, not reference = "true"'
        elif self._gradienter is None:
            self.hint = "compass sends its field only: a heading from it needs a gradienter"
        elif self._tilt is None or not abs(t_s - self._tilt.t_s) <= OLDEST_TILT_S:
            self.hint = "compass sends its field only: no tilt from the gradienter to work out the heading"
        else:
            try:
                up = up_in_vehicle(self._gradienter, self._tilt.x_deg, self._tilt.y_deg)
                if np.isfinite(up).all():
                    return up
            except ValueError as error:
                self.hint = str(error)
        return None
