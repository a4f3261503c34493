"""Means of the gradienter and of the compass over a still stretch (method section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.calibration.noise.allan import white_noise
from companion.calibration.noise.robust import huber_mean
from companion.calibration.seconds.batch import Batch
from companion.physics.frames import Floats

_MAX_DECIMALS: Final = 4


class TiltWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Means of the gradienter in its own axes; sigmas are statistical."""

    samples: int
    x_deg: float
    y_deg: float
    x_sigma_deg: float
    y_sigma_deg: float
    temperature_degc: float | None


class HeadingWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Mean on the circle of the compass' heading in [0, 360); sigma is statistical."""

    samples: int
    heading_deg: float
    sigma_deg: float
    from_field: bool = False
    """Worked out from the device's field and the gradienter's tilt; else the device's own."""
    wander_deg: float | None = None
    """By how much it has changed while nothing else said that the aircraft turned; None: not watched long enough."""


FieldUnit = Literal["gauss", "counts"]


class FieldWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Mean of the magnetic field in the compass' own axes; sigmas are statistical."""

    samples: int
    field: tuple[float, float, float]
    sigma: tuple[float, float, float]
    unit: FieldUnit


def tilt_window(batches: Sequence[Batch]) -> TiltWindow:
    """The gradienter's window from its good batches, at least one."""
    mean, sigma = _pose_mean(batches, np.array([batch.mean for batch in batches]))
    temperatures = [batch.temperature_degc for batch in batches if batch.temperature_degc is not None]
    return TiltWindow(
        samples=sum(batch.n for batch in batches),
        x_deg=float(mean[0]),
        y_deg=float(mean[1]),
        x_sigma_deg=float(sigma[0]),
        y_sigma_deg=float(sigma[1]),
        temperature_degc=float(np.mean(temperatures)) if temperatures else None,
    )


def heading_window(
    batches: Sequence[Batch], *, from_field: bool = False, wander_deg: float | None = None
) -> HeadingWindow:
    """The compass' window from its good batches, at least one."""
    first = batches[0].mean
    turned = np.array([np.mod(batch.mean - first + 180.0, 360.0) - 180.0 for batch in batches])
    mean, sigma = _pose_mean(batches, turned)
    return HeadingWindow(
        samples=sum(batch.n for batch in batches),
        heading_deg=float(np.mod(mean[0] + first[0], 360.0)),
        sigma_deg=float(sigma[0]),
        from_field=from_field,
        wander_deg=wander_deg,
    )


def field_window(batches: Sequence[Batch], unit: FieldUnit) -> FieldWindow:
    """The field's window from the batches of good seconds, at least one."""
    mean, sigma = _pose_mean(batches, np.array([batch.mean for batch in batches]))
    (x, y, z), (sx, sy, sz) = mean.tolist(), sigma.tolist()
    return FieldWindow(samples=sum(batch.n for batch in batches), field=(x, y, z), sigma=(sx, sy, sz), unit=unit)


def _pose_mean(batches: Sequence[Batch], values: Floats) -> tuple[Floats, Floats]:
    slots = np.array([batch.slot for batch in batches], dtype=np.int64)
    variance = np.square(white_noise(slots, values)) / len(values) + np.square(_resolution(batches)) / 12.0
    return huber_mean(values), np.asarray(np.sqrt(variance))


def _resolution(batches: Sequence[Batch]) -> Floats:
    """Step of a reading that shows fewer than 3 values: their distance, or that of the last decimal it prints."""
    low = np.min([batch.low for batch in batches], axis=0)
    high = np.max([batch.high for batch in batches], axis=0)
    few = np.max([batch.distinct for batch in batches], axis=0) < 3
    decimal = np.full(len(low), 10.0**-_MAX_DECIMALS)
    for digits in range(_MAX_DECIMALS - 1, -1, -1):
        prints = (np.abs(low - np.round(low, digits)) < 1e-9) & (np.abs(high - np.round(high, digits)) < 1e-9)
        decimal = np.where(prints, 10.0**-digits, decimal)
    return np.where(few, np.where(high > low, high - low, decimal), 0.0)
