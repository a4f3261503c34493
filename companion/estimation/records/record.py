"""The record of one calibration: what was found, how well, and what was done with it.

The keys are a surface that others rely on. What is unknown or does not apply is None (null in JSON), never absent
and never zero. All axes are the vehicle's FRD.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import msgspec

from companion import formats
from companion.samples import TRIADS, Triad, Vector

FORMAT_VERSION = 1

Outcome = Literal["verified", "stored", "failed", "rolled_back"]
TiltFrom = Literal["gradienter", "accelerometers"]
HeadingFrom = Literal["compass", "autopilot"]


def outcome_word(outcome: str) -> str:
    return "restored" if outcome == "rolled_back" else outcome


class PoseSigma(msgspec.Struct, frozen=True, kw_only=True):
    theta: float | None
    gamma: float | None
    psi: float | None


class Pose(msgspec.Struct, frozen=True, kw_only=True):
    """Attitude of the aircraft: nose up, right side down, clockwise from true north."""

    theta_deg: float | None
    gamma_deg: float | None
    psi_deg: float | None
    sigma_deg: PoseSigma
    tilt_from: TiltFrom | None = None  # "accelerometers": those of an IMU that was held on all sides before
    heading_from: HeadingFrom | None = None


class SiteRecord(msgspec.Struct, frozen=True, kw_only=True):
    latitude_deg: float | None
    height_m: float | None
    gravity_m_s2: float | None
    declination_deg: float | None
    source: str | None


class Magnetic(msgspec.Struct, frozen=True, kw_only=True):
    """Magnetic field at the compass and the Earth's by WMM2025; inclinations down positive. None: unknown.

    The heading's error exceeds its bound in one case of twenty; 180: the field shows no heading. `heading_from`: with
    the device's own tilt compensation, or with ours by the gradienter. `device_minus_field_deg`: the one less the
    other, where the device gives both.
    """

    heading_bound_deg: float | None
    """95 % bound of the heading error, degrees; None: field or position unknown; 180: the field gives no heading."""
    heading_from: Literal["device", "field"]
    field_gauss: float | None
    field_expected_gauss: float | None  # Field and inclination of the Earth by WMM2025
    inclination_deg: float | None  # Down positive; needs a gradienter
    inclination_expected_deg: float | None
    device_minus_field_deg: float | None
    wander_deg: float | None

    def in_words(self) -> str:
        bound = "heading error bound unknown"
        if self.heading_bound_deg is not None:
            useless = self.heading_bound_deg >= 180.0
            bound = "shows no heading here" if useless else f"heading good to {self.heading_bound_deg:.1f} deg"
        parts = [bound]
        if self.heading_from == "field":
            parts.append("worked out from its field and the gradienter")
        for what, found, expected, form, unit in (
            ("field", self.field_gauss, self.field_expected_gauss, ".3f", "gauss"),
            ("inclination", self.inclination_deg, self.inclination_expected_deg, ".1f", "deg"),
        ):
            if found is not None:
                earths = "" if expected is None else f" (the Earth's {expected:{form}})"
                parts.append(f"{what} {found:{form}} {unit}{earths}")
        if self.wander_deg is not None:
            parts.append(f"wandered {self.wander_deg:.1f} deg")
        return ", ".join(parts)


class PlatformTurn(msgspec.Struct, frozen=True, kw_only=True):
    """Platform under the aircraft, and its own turn; the gyros' sigma allows for it.

    It turns about the vertical, clockwise seen from above; that is not taken off. None: nothing told, and the ground
    was taken for fixed to the Earth. Told by gyros: by their level at an earlier rest; by earlier calibrations: by the
    biases that they have led to expect.
    """

    platform: Literal["ground", "deck"]
    turn_deg_s: float | None
    """About the vertical, clockwise seen from above, not subtracted; None: not measured, assumed fixed to the Earth."""
    turn_sigma_deg_s: float | None
    told_by: Literal["compass", "gyros", "compass and gyros", "earlier calibrations"] | None
    """Gyros: by their level at an earlier rest; earlier calibrations: by the biases that they have led to expect."""


class WrittenParameter(msgspec.Struct, frozen=True, kw_only=True):
    """One autopilot parameter: before, what was set, what came back.

    "verified": read back and seen in the telemetry. "stored": read back, but its effect cannot be seen.
    "failed": not set, or not put back. "rolled_back": the old value is in force again.
    """

    before: float | None
    after: float
    read_back: float | None
    outcome: Outcome


Prior = dict[Triad, dict[str, Any] | None]
"""Predictions for one IMU from earlier power-ups; None: fewer than three of them.

`used`: it took part in the estimate; it guards in any case. `power_ups`: their number. `temperature_model`: by a curve.
`expected_rad_s` or `expected_m_s2`, with `sigma_…` of today's bias about it. `measured_…`: the bias by the readings
alone. `shift_sigma`: their difference in sigmas.
"""


class Effective(msgspec.Struct, frozen=True, kw_only=True):
    """Sigma of the accelerometers' bias at another attitude: scale errors times 1 g are in it.

    The scale is told by an alignment with tilts, or assumed (0.5 %). An axis' bias moves by `scale_sigma_m_s2`, one
    sigma, times the change of its share of gravity; the vertical one's of a level aircraft that is tilted, times
    1 - cos(tilt). `sensor_sigma_m_s2` is that of the sensor's own bias, in its own axes, whatever its attitude.
    """

    scale_from: Literal["assumed", "alignment"]  # An alignment with tilts has told the scale; else 0.5 % is assumed
    scale_sigma_m_s2: Vector
    level_sigma_m_s2: Vector
    sensor_sigma_m_s2: Vector


class WhenWarm(msgspec.Struct, frozen=True):
    """Whole biases that the curve over temperature predicts for the warm board."""

    degc: float
    gyro_bias_rad_s: Vector
    gyro_sigma_rad_s: Vector
    accel_bias_m_s2: Vector | None
    accel_sigma_m_s2: Vector | None
    words: tuple[str, ...] = ()  # Words for people on the axes that will move most; empty: not worth saying


class TriadFigures(NamedTuple):
    bias: Vector | None
    sigma_stat: Vector | None
    sigma_use: Vector | None
    sigma_warm_up: Vector | None
    residual: Vector | None
    sigma_in_force: Vector | None


class ImuRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU: whole biases (measured without any offset, minus truth), sigmas, and what was written.

    The covariance is 6x6: gyro x y z in rad/s, accelerometer x y z in m/s^2; None where that half was not determined.
    The warm-up's part of sigma_use is too small to see, and only time removes it. Triads `held_back` contradict earlier
    calibrations and were not requested; `unchanged` are those whose offsets in force are as good, with their sigma in
    force. Device ids are the autopilot's; None: it has none, or the record is of an older version.
    """

    name: str
    samples: int
    temperature_degc: float | None
    gyro_bias_rad_s: Vector | None
    gyro_sigma_stat_rad_s: Vector | None
    gyro_sigma_use_rad_s: Vector | None
    accel_bias_m_s2: Vector | None
    accel_sigma_stat_m_s2: Vector | None
    accel_sigma_use_m_s2: Vector | None
    covariance: tuple[tuple[float | None, ...], ...] | None
    residual_gyro_rad_s: Vector | None
    residual_accel_m_s2: Vector | None
    warnings: tuple[str, ...] = ()
    written: dict[str, WrittenParameter] = {}
    prior: Prior | None = None
    effective: Effective | None = None
    held_back: tuple[Literal["gyro", "accel"], ...] = ()
    unchanged: tuple[Literal["gyro", "accel"], ...] = ()
    gyro_sigma_warm_up_rad_s: Vector | None = None
    """Part of sigma_use for a warm-up too small to see; only time removes it."""
    accel_sigma_warm_up_m_s2: Vector | None = None
    when_warm: WhenWarm | None = None  # None: the board was warm, or the end of its warm-up is unknown
    gyro_id: int | None = None  # Device ids in the autopilot; None: it has none, or the record is of an older version
    accel_id: int | None = None
    gyro_sigma_in_force_rad_s: Vector | None = None
    """One sigma of the offsets that this calibration left unchanged; None where it wrote them."""
    accel_sigma_in_force_m_s2: Vector | None = None

    def of(self, triad: Triad) -> TriadFigures:
        if triad == "gyro":
            sigmas = self.gyro_sigma_stat_rad_s, self.gyro_sigma_use_rad_s, self.gyro_sigma_warm_up_rad_s
            return TriadFigures(self.gyro_bias_rad_s, *sigmas, self.residual_gyro_rad_s, self.gyro_sigma_in_force_rad_s)
        sigmas = self.accel_sigma_stat_m_s2, self.accel_sigma_use_m_s2, self.accel_sigma_warm_up_m_s2
        return TriadFigures(self.accel_bias_m_s2, *sigmas, self.residual_accel_m_s2, self.accel_sigma_in_force_m_s2)

    def sigma_in_force(self, triad: Triad) -> Vector | None:
        """Return one sigma of what the offsets in force leave in the output, for the next minutes."""
        own = self.of(triad)
        if own.sigma_in_force is not None:
            return own.sigma_in_force
        if own.sigma_use is None or own.residual is None or triad not in self.unchanged:
            return own.sigma_use
        return _each(math.hypot, own.sigma_use, own.residual)

    def settled_sigma(self, triad: Triad) -> Vector | None:
        """Return sigma_use without the warm-up, which moves the output alike under old and new offsets."""
        own = self.of(triad)
        if own.sigma_use is None or own.sigma_warm_up is None:
            return own.sigma_use
        return _each(lambda use, part: math.sqrt(max(use**2 - part**2, 0.0)), own.sigma_use, own.sigma_warm_up)

    def confirming(self, before: ImuRecord | None) -> ImuRecord:
        """Return this record with the sigma of the offsets that it left unchanged; `before` describes their origin."""

        def confirmed(triad: Triad) -> Vector | None:
            own = self.of(triad)
            earlier = None if before is None or triad in before.held_back else before.sigma_in_force(triad)
            if triad not in self.unchanged or None in (earlier, own.sigma_use, own.sigma_stat, own.residual):
                return None
            return _each(_confirmed_sigma, earlier, own.sigma_use, own.sigma_stat, own.residual)

        gyro, accel = map(confirmed, TRIADS)
        return msgspec.structs.replace(self, gyro_sigma_in_force_rad_s=gyro, accel_sigma_in_force_m_s2=accel)


def _confirmed_sigma(earlier: float, sigma: float, averaged: float, residual: float) -> float:
    """Return one sigma of an offset of known sigma after a second measurement has found this residual.

    The residual counts by the share that its own noise does not explain. The second measurement alone would leave
    hypot(sigma, residual). No average of the two sigmas is claimed: part of their errors is common.
    """
    gain = earlier**2 / max(earlier**2 + averaged**2, sys.float_info.min)
    return min(math.hypot(earlier, gain * residual), math.hypot(sigma, residual))


def _each(function: Callable[..., float], *vectors: Vector | None) -> Vector:
    x, y, z = map(function, *vectors)  # type: ignore[arg-type]
    return x, y, z


class ArmingRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Calibration in force when the aircraft armed.

    "calibrated": by the calibration that began at `calibration`. "checked": offsets of unknown origin, measured to be
    right. "uncalibrated": neither; `reason` says why.
    """

    armed_at: str
    state: Literal["calibrated", "checked", "uncalibrated"]
    reason: str
    at_arm: Literal["gate", "warn", "off"]
    calibration: str | None
    calibrated_ago_s: float | None
    confirmed_ago_s: float | None  # Time since a still window last agreed with the offsets in force
    gyro_sigma_use_rad_s: float | None
    accel_sigma_use_m_s2: float | None


class AlignmentUsed(msgspec.Struct, frozen=True, kw_only=True):
    """The alignment of the gradienter that was in force: its zero on top of the configured one, and its sigma."""

    measured_at: str
    offset_deg: tuple[float, float]
    sigma_deg: float


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """One calibration, finished in whatever way; times are UTC, ISO 8601, by the host's clock, which may be wrong.

    `alignment` None: the gradienter's zero and sigma were those of the configuration. `armings` is empty in the file,
    and filled in by the history.
    """

    format_version: int = FORMAT_VERSION
    state: Literal["done", "failed", "cancelled"]
    reason: str
    warnings: tuple[str, ...]
    started_at: str  # UTC, ISO 8601; the host's clock, which on a field computer may be wrong
    duration_s: float
    pose: Pose | None
    site: SiteRecord | None
    imus: tuple[ImuRecord, ...]
    system_id: int | None = None  # MAVLink system of the vehicle; None while it had not been heard
    alignment: AlignmentUsed | None = None
    undone_at: str | None = None  # UTC, ISO 8601: when what this calibration has written was put back on request
    magnetic: Magnetic | None = None
    standing: PlatformTurn | None = None
    armings: tuple[ArmingRecord, ...] = ()

    @property
    def written(self) -> dict[str, float]:
        return {name: one.after for imu in self.imus for name, one in imu.written.items()}

    @property
    def is_worth_keeping(self) -> bool:
        return self.state != "cancelled" or bool(self.imus or self.warnings)


def to_json(record: Record) -> bytes:
    return msgspec.json.encode(record)


def from_json(data: bytes) -> Record:
    """Read a record back.

    Raises:
        msgspec.MsgspecError: not a record, or one of a newer companion.
    """
    record: Record = formats.decode(data, Record, FORMAT_VERSION)
    return record
