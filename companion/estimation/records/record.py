"""Record of one calibration: results, sigmas, and parameters written.

The keys are a public interface. A value that is unknown or does not apply is None (null in JSON), never absent and
never zero. All axes are the vehicle's (FRD).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple

import msgspec

from companion import formats
from companion.physics.units import DEG_H, MG
from companion.samples import TRIADS, Triad, Vector

FORMAT_VERSION = 1

Outcome = Literal["verified", "stored", "failed", "rolled_back"]
TiltFrom = Literal["gradienter", "accelerometers"]
HeadingFrom = Literal["compass", "autopilot"]


def sigma_texts(gyro_rad_s: float | None, accel_m_s2: float | None, note: str = "") -> list[str]:
    """Format the sigmas that are known, with a note on the gyros', as all interfaces show them."""
    parts = []
    if gyro_rad_s is not None:
        deg_h = gyro_rad_s / DEG_H
        # Two digits are enough, and three numbers fit into one STATUSTEXT.
        parts.append(f"{deg_h:.{1 if deg_h < 10.0 else 0}f} deg/h{note}")
    if accel_m_s2 is not None:
        parts.append(f"{accel_m_s2 / MG:.2f} mg")
    return parts


def outcome_word(outcome: str) -> str:
    return "restored" if outcome == "rolled_back" else outcome


WORTH_S: Final = 5.0  # Shortest cancelled run that the history keeps: a client in a loop must not displace the others


class PoseSigma(msgspec.Struct, frozen=True, kw_only=True):
    theta: float | None
    gamma: float | None
    psi: float | None


class Pose(msgspec.Struct, frozen=True, kw_only=True):
    """Attitude of the aircraft: pitch theta (nose up), roll gamma (right side down), heading psi (from true north)."""

    theta_deg: float | None
    gamma_deg: float | None
    psi_deg: float | None
    sigma_deg: PoseSigma
    tilt_from: TiltFrom | None = None  # "accelerometers": of an IMU with a six-position calibration
    heading_from: HeadingFrom | None = None


class SiteRecord(msgspec.Struct, frozen=True, kw_only=True):
    latitude_deg: float | None
    height_m: float | None
    gravity_m_s2: float | None
    declination_deg: float | None
    source: str | None


class Magnetic(msgspec.Struct, frozen=True, kw_only=True):
    """Magnetic field at the compass and the Earth's field by WMM2025; inclinations are positive downwards.

    The heading error exceeds its bound in one case of twenty. `heading_from`: tilt compensation by the device, or by
    the companion, of the field. `device_minus_field_deg`: the device's own heading minus the heading from its field.
    None: unknown.
    """

    heading_bound_deg: float | None
    """95 % bound of the heading error, degrees; None: field or position unknown; 180: the field gives no heading."""
    heading_from: Literal["device", "field"]
    field_gauss: float | None
    field_expected_gauss: float | None  # The Earth's field and inclination are by WMM2025
    inclination_deg: float | None  # Down positive; needs a measured tilt
    inclination_expected_deg: float | None
    device_minus_field_deg: float | None
    wander_deg: float | None

    def in_words(self) -> str:
        bound = "heading not checked for iron nearby"
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
            parts.append(f"steady to {self.wander_deg:.1f} deg")
        return ", ".join(parts)


class PlatformTurn(msgspec.Struct, frozen=True, kw_only=True):
    """Turn of the platform (ground or deck) under the aircraft, about the vertical.

    The turn is not subtracted; the gyros' sigma includes it.
    """

    platform: Literal["ground", "deck"]
    turn_deg_s: float | None
    """Turn rate about the vertical, clockwise seen from above; None: not measured, the ground is assumed fixed."""
    turn_sigma_deg_s: float | None
    told_by: Literal["compass", "gyros", "compass and gyros", "earlier calibrations"] | None
    """Source of the turn rate: "gyros", compared with an earlier rest; "earlier calibrations", with predictions."""


class WrittenParameter(msgspec.Struct, frozen=True, kw_only=True):
    """One autopilot parameter: value before, value set, value read back.

    "verified": read back, and the effect seen in the telemetry. "stored": read back, but its effect cannot be seen.
    "failed": not set, or not restored. "rolled_back": the old value is active again.
    """

    before: float | None
    after: float
    read_back: float | None
    outcome: Outcome


Prior = dict[Triad, dict[str, Any] | None]
"""Predicted biases of one IMU from earlier power-ups, by triad; None: fewer than three power-ups.

`used`: the prediction took part in the estimate (every prediction is a plausibility gate). `power_ups`: number of
power-ups. `temperature_model`: predicted by a curve over temperature. `expected_rad_s` or `expected_m_s2`: predicted
bias, with `sigma_…`. `measured_…`: bias from the readings alone. `shift_sigma`: measured minus predicted, in sigmas.
"""


class Effective(msgspec.Struct, frozen=True, kw_only=True):
    """Sigma of the accelerometer biases at another attitude than the calibration's, including scale errors times 1 g.

    The bias of an axis changes by `scale_sigma_m_s2` (one sigma) times the change of the axis' share of gravity,
    1 - cos(tilt) for the vertical axis of a level aircraft. `sensor_sigma_m_s2` is one sigma of the bias itself, in the
    sensor's axes, at any attitude.
    """

    scale_from: Literal["assumed", "alignment"]  # "alignment": measured with tilts; "assumed": 0.5 %
    scale_sigma_m_s2: Vector
    level_sigma_m_s2: Vector
    sensor_sigma_m_s2: Vector


class WhenWarm(msgspec.Struct, frozen=True):
    """Biases without autopilot offsets that the curve over temperature predicts for the warm board."""

    degc: float
    gyro_bias_rad_s: Vector
    gyro_sigma_rad_s: Vector
    accel_bias_m_s2: Vector | None
    accel_sigma_m_s2: Vector | None
    words: tuple[str, ...] = ()  # Text on the axes that will change most; empty: negligible


class TriadFigures(NamedTuple):
    bias: Vector | None
    sigma_stat: Vector | None
    sigma_use: Vector | None
    sigma_warm_up: Vector | None
    residual: Vector | None
    sigma_in_force: Vector | None


class ImuRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one IMU: whole biases (output without any offset, minus the true value), sigmas, and what was written.

    The covariance is 6x6: gyro x y z in rad/s, accelerometer x y z in m/s^2; None for a half that was not determined.
    sigma_use includes a warm-up too slow to see. Triads `held_back` were not written: they contradict earlier
    calibrations, and the request did not insist. Triads `unchanged` keep their active offsets, which are as good as new
    ones; one sigma of these offsets is `..._sigma_in_force_...`.
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
    """Part of the stated sigma, for a possible warm-up too slow to see in the window; only time removes it."""
    accel_sigma_warm_up_m_s2: Vector | None = None
    when_warm: WhenWarm | None = None  # None: the board was warm, or the end of its warm-up is unknown
    gyro_id: int | None = None  # Device ids in the autopilot; None: it has none, or the record is of an older version
    accel_id: int | None = None
    gyro_sigma_in_force_rad_s: Vector | None = None
    """One sigma of the active offsets that this calibration left unchanged; None: new offsets, or unknown."""
    accel_sigma_in_force_m_s2: Vector | None = None

    def of(self, triad: Triad) -> TriadFigures:
        if triad == "gyro":
            sigmas = self.gyro_sigma_stat_rad_s, self.gyro_sigma_use_rad_s, self.gyro_sigma_warm_up_rad_s
            return TriadFigures(self.gyro_bias_rad_s, *sigmas, self.residual_gyro_rad_s, self.gyro_sigma_in_force_rad_s)
        sigmas = self.accel_sigma_stat_m_s2, self.accel_sigma_use_m_s2, self.accel_sigma_warm_up_m_s2
        return TriadFigures(self.accel_bias_m_s2, *sigmas, self.residual_accel_m_s2, self.accel_sigma_in_force_m_s2)

    def sigma_in_force(self, triad: Triad) -> Vector | None:
        """Return one sigma of the bias that remains in the output with the active offsets, for the next minutes."""
        own = self.of(triad)
        if own.sigma_in_force is not None:
            return own.sigma_in_force
        if own.sigma_use is None or own.residual is None or triad not in self.unchanged:
            return own.sigma_use
        return _each(math.hypot, own.sigma_use, own.residual)

    def settled_sigma(self, triad: Triad) -> Vector | None:
        """Return the stated sigma without a warm-up, which changes the output equally with old and new offsets."""
        own = self.of(triad)
        if own.sigma_use is None or own.sigma_warm_up is None:
            return own.sigma_use
        return _each(lambda use, part: math.sqrt(max(use**2 - part**2, 0.0)), own.sigma_use, own.sigma_warm_up)

    def confirming(self, before: ImuRecord | None) -> ImuRecord:
        """Add the sigma of offsets that this calibration left unchanged; `before`: record of the last calibration."""

        def confirmed(triad: Triad) -> Vector | None:
            own = self.of(triad)
            earlier = None if before is None or triad in before.held_back else before.sigma_in_force(triad)
            if triad not in self.unchanged or None in (earlier, own.sigma_use, own.sigma_stat, own.residual):
                return None
            return _each(_confirmed_sigma, earlier, own.sigma_use, own.sigma_stat, own.residual)

        gyro, accel = map(confirmed, TRIADS)
        return msgspec.structs.replace(self, gyro_sigma_in_force_rad_s=gyro, accel_sigma_in_force_m_s2=accel)


def _confirmed_sigma(earlier: float, sigma: float, averaged: float, residual: float) -> float:
    """Return one sigma of an offset after a second measurement found a `residual`; `earlier`: its sigma before.

    The residual counts by the share that the measurement's noise (`averaged`) does not explain. The second
    measurement alone would give hypot(sigma, residual). The sigmas are not averaged: part of their errors is common.
    """
    gain = earlier**2 / max(earlier**2 + averaged**2, sys.float_info.min)
    return min(math.hypot(earlier, gain * residual), math.hypot(sigma, residual))


def _each(function: Callable[..., float], *vectors: Vector | None) -> Vector:
    x, y, z = map(function, *vectors)  # type: ignore[arg-type]
    return x, y, z


class ArmingRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Arming of the autopilot, and the calibration that was active then.

    "calibrated": the offsets are from the calibration that began at `calibration`. "checked": the offsets' origin is
    unknown, but a measurement confirmed them. "uncalibrated": neither; `reason` gives the cause.
    """

    armed_at: str
    state: Literal["calibrated", "checked", "uncalibrated"]
    reason: str
    at_arm: Literal["gate", "warn", "off"]
    calibration: str | None
    calibrated_ago_s: float | None
    confirmed_ago_s: float | None  # Time since a still window last agreed with the active offsets
    gyro_sigma_use_rad_s: float | None
    accel_sigma_use_m_s2: float | None


class AlignmentUsed(msgspec.Struct, frozen=True, kw_only=True):
    """Alignment of the gradienter used in a calibration: measured zero, added to the configured one, and sigma."""

    measured_at: str
    offset_deg: tuple[float, float]
    sigma_deg: float


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """One finished calibration; times are UTC, ISO 8601, by the companion computer's clock, which may be wrong.

    `alignment` is None if the gradienter's zero and sigma were those of the configuration. `armings` is empty in the
    file; the history fills it in.
    """

    format_version: int = FORMAT_VERSION
    state: Literal["done", "failed", "cancelled"]
    reason: str
    warnings: tuple[str, ...]
    started_at: str  # UTC, ISO 8601; by the companion computer's clock, which may be wrong
    duration_s: float
    pose: Pose | None
    site: SiteRecord | None
    imus: tuple[ImuRecord, ...]
    system_id: int | None = None  # MAVLink system id of the vehicle; None before its first heartbeat
    alignment: AlignmentUsed | None = None
    undone_at: str | None = None  # UTC, ISO 8601: time at which the old offsets were restored on request
    magnetic: Magnetic | None = None
    standing: PlatformTurn | None = None
    armings: tuple[ArmingRecord, ...] = ()

    @property
    def written(self) -> dict[str, float]:
        return {name: one.after for imu in self.imus for name, one in imu.written.items()}

    @property
    def is_worth_keeping(self) -> bool:
        return self.state != "cancelled" or self.duration_s >= WORTH_S or bool(self.imus or self.warnings)


def to_json(record: Record) -> bytes:
    return msgspec.json.encode(record)


def from_json(data: bytes) -> Record:
    """Parse a calibration record from JSON.

    Raises:
        msgspec.MsgspecError: not a record, or one of a newer companion.
    """
    record: Record = formats.decode(data, Record, FORMAT_VERSION)
    return record
