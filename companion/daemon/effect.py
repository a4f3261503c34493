"""Did the autopilot take the new offsets? Its telemetry before and after the write, against what must have changed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from companion.autopilot.ardupilot import ImuCalibration, output_step
from companion.autopilot.imu_stream import StreamKind
from companion.autopilot.verify import Observation, Verdict, judge
from companion.autopilot.writer import Change
from companion.calibration.allan import AllanModel, floor_variance, noise_profile
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


class _Triad(NamedTuple):
    """Gyros or accelerometers of one window."""

    mean: Vector
    sigma_stat: Vector
    sigma_use: Vector


def _gyros(window: ImuWindow) -> _Triad:
    return _Triad(window.gyro_rad_s, window.gyro_sigma_stat_rad_s, window.gyro_sigma_use_rad_s)


def _accelerometers(window: ImuWindow) -> _Triad:
    return _Triad(window.accel_m_s2, window.accel_sigma_stat_m_s2, window.accel_sigma_use_m_s2)


def judge_vectors(
    sides: Sides, calibration: ImuCalibration, changes: list[Change], kind: StreamKind | None, profile: str | None
) -> list[Verdict]:
    """Judge the vectors that were written: accelerometers, gyros, or both."""
    gyro_step, accel_step = output_step(calibration, changes)
    names, noise = calibration.parameters, noise_profile(profile)
    spans_s = (sides.before.duration_s, sides.after.duration_s)
    ordinary = (math.inf, math.inf) if profile is not None else ORDINARY_FLICKER

    def observe(triad: Callable[[ImuWindow], _Triad], residual: Array, drift: float, rest: _Rest) -> Verdict:
        before, after = triad(sides.before), triad(sides.after)
        return judge(
            Observation(
                parameters=rest.parameters,
                unit=rest.unit,
                before=before.mean,
                before_sigma=before.sigma_stat,
                after=after.mean,
                after_sigma=_hypot(after.sigma_stat, drift),
                expected_step=rest.step,
                truth=_minus(before.mean, residual),
                tolerance=TOLERANCE_SIGMAS * max(before.sigma_use),
                orientation=calibration.orientation,
                resolution=rest.resolution,
            )
        )

    result = []
    if sides.accel_residual is not None:
        rest = _Rest(names.accel_offset, "m/s^2", accel_step, kind.accel_step_m_s2 if kind else 0.0)
        drift = _drift_sigma(noise.accel, ordinary[1], spans_s)
        result.append(observe(_accelerometers, sides.accel_residual, drift, rest))
    if sides.gyro_residual is not None:
        rest = _Rest(names.gyro_offset, "rad/s", gyro_step, kind.gyro_step_rad_s if kind else 0.0)
        drift = _drift_sigma(noise.gyro, ordinary[0], spans_s)
        result.append(observe(_gyros, sides.gyro_residual, drift, rest))
    return result


class _Rest(NamedTuple):
    """What else an observation needs."""

    parameters: tuple[str, str, str]
    unit: str
    step: Vector
    resolution: float


def in_short(verdict: Verdict) -> str:
    """What is wrong in one short line for people; `verdict.problems` has the figures."""
    unused = [axis.parameter for axis in verdict.axes if axis.word == "not seen"]
    if unused:
        return f"the autopilot stored {', '.join(unused)} but does not use {'it' if len(unused) == 1 else 'them'}"
    wrong = [axis.parameter for axis in verdict.axes if axis.word == "wrong"]
    if wrong:
        return f"the output did not follow {', '.join(wrong)} (orientation, sign or scale not as believed, or it moved)"
    return "; ".join(verdict.problems)


def nearly_visible(verdict: Verdict) -> bool:
    """Whether a step that could not be seen might be with a longer look: at least 3 of the 8 sigmas it needs."""
    sigma = verdict.fraction_sigma
    return verdict.ok and bool(verdict.warnings) and sigma is not None and sigma < 1 / 3


def _drift_sigma(model: AllanModel, most_flicker: float, spans_s: tuple[float, float]) -> float:
    """How far the bias itself wanders between two neighbouring windows (method section 2.2, V less its white part)."""
    return float(np.sqrt(floor_variance(min(model.flicker, most_flicker), model.walk, *spans_s)))


def _hypot(sigmas: Vector, drift: float) -> Vector:
    x, y, z = (float(np.hypot(sigma, drift)) for sigma in sigmas)
    return x, y, z


def _minus(mean: Vector, residual: Array) -> Vector:
    x, y, z = (float(a - b) for a, b in zip(mean, residual, strict=True))
    return x, y, z
