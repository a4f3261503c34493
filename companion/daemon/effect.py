"""Did the autopilot take the new offsets? Its telemetry before and after the write, against what must have changed."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from companion.autopilot.ardupilot import ImuCalibration, output_step
from companion.autopilot.imu_stream import StreamKind
from companion.autopilot.verify import Observation, Verdict, judge
from companion.autopilot.writer import Change
from companion.calibration.allan import AllanModel, NoiseProfile, floor_variance, noise_profile
from companion.calibration.rolling import ImuWindow
from companion.physics.frames import Array
from companion.physics.units import DEG_H, MG
from companion.samples import Vector

# Between two neighbouring windows of some ten seconds an unnamed part is taken for an ordinary one (floors of 8 deg/h
# and 50 micro-g), not for the worst there is as over the minutes of sigma_use: else no step could ever be seen.
ORDINARY_FLICKER: Final = (8.0 / 0.664 * DEG_H, 0.05 / 0.664 * MG)
TOLERANCE_SIGMAS: Final = 2.0
"""What may remain besides noise: nobody claims the bias better than by its sigma_use."""


@dataclasses.dataclass(frozen=True, slots=True)
class Sides:
    """One IMU's telemetry before and after the write, and what it had to read before (vehicle FRD)."""

    before: ImuWindow
    after: ImuWindow
    gyro_residual: Array | None
    accel_residual: Array | None


def judge_vectors(
    sides: Sides, calibration: ImuCalibration, changes: list[Change], kind: StreamKind | None, profile: str | None
) -> list[Verdict]:
    """Judge the vectors that were written: accelerometers, gyros, or both."""
    gyro_step, accel_step = output_step(calibration, changes)
    model, known = noise_profile(profile), profile is not None
    names = calibration.parameters
    before, after = sides.before, sides.after
    span_s = (before.duration_s, after.duration_s)
    result = []
    if sides.accel_residual is not None:
        drift = _drift_sigma(model, "accel", span_s, known=known)
        result.append(
            judge(
                Observation(
                    parameters=names.accel_offset,
                    unit="m/s^2",
                    before=before.accel_m_s2,
                    before_sigma=before.accel_sigma_stat_m_s2,
                    after=after.accel_m_s2,
                    after_sigma=_hypot(after.accel_sigma_stat_m_s2, drift),
                    expected_step=accel_step,
                    truth=_minus(before.accel_m_s2, sides.accel_residual),
                    tolerance=TOLERANCE_SIGMAS * max(before.accel_sigma_use_m_s2),
                    orientation=calibration.orientation,
                    resolution=kind.accel_step_m_s2 if kind else 0.0,
                )
            )
        )
    if sides.gyro_residual is not None:
        drift = _drift_sigma(model, "gyro", span_s, known=known)
        result.append(
            judge(
                Observation(
                    parameters=names.gyro_offset,
                    unit="rad/s",
                    before=before.gyro_rad_s,
                    before_sigma=before.gyro_sigma_stat_rad_s,
                    after=after.gyro_rad_s,
                    after_sigma=_hypot(after.gyro_sigma_stat_rad_s, drift),
                    expected_step=gyro_step,
                    truth=_minus(before.gyro_rad_s, sides.gyro_residual),
                    tolerance=TOLERANCE_SIGMAS * max(before.gyro_sigma_use_rad_s),
                    orientation=calibration.orientation,
                    resolution=kind.gyro_step_rad_s if kind else 0.0,
                )
            )
        )
    return result


def nearly_visible(verdict: Verdict) -> bool:
    """Whether a step that could not be seen might be with a longer look: at least 3 of the 8 sigmas it needs."""
    sigma = verdict.fraction_sigma
    return verdict.ok and bool(verdict.warnings) and sigma is not None and sigma < 1 / 3


def _drift_sigma(profile: NoiseProfile, triad: str, span_s: tuple[float, float], *, known: bool) -> float:
    """How far the bias itself wanders between two neighbouring windows (method section 2.2, V less its white part)."""
    model: AllanModel = getattr(profile, triad)
    flicker = model.flicker if known else min(model.flicker, ORDINARY_FLICKER[triad == "accel"])
    walk = model.walk if known else 0.0
    return float(np.sqrt(floor_variance(flicker, walk, span_s[0], span_s[1])))


def _hypot(sigmas: Vector, drift: float) -> Vector:
    x, y, z = (float(np.hypot(sigma, drift)) for sigma in sigmas)
    return x, y, z


def _minus(mean: Vector, residual: Array) -> Vector:
    x, y, z = (float(a - b) for a, b in zip(mean, residual, strict=True))
    return x, y, z
