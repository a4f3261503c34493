"""Effect of written offsets, judged from the telemetry before and after.

A correct read-back proves nothing about the value in use. PX4 stores a small change and still uses the old value, and a
wrong orientation or sign moves the wrong axis (docs/reference/autopilots 4.2, 8.6). So the step of the output is
compared with the expected one in the axes of the parameters (the board's), and a verdict names a parameter. The
remaining residual is judged in the vehicle's axes.

On an axis, "the whole step" differs clearly from "no step" if the expected step is at least 8 sigma, 4 for each. A
correct axis is called wrong once in 16000. A matched filter over the three axes estimates the fraction of the step that
was made, also if the step is too small to see on each single axis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from companion.autopilot.parameters.change import Names
from companion.messages import message
from companion.physics.frames import Matrix
from companion.samples import Vector

SIGMAS: Final = 4.0  # largest distance of a figure from its hypothesis, in standard deviations

VISIBLE_SIGMAS: Final = 2 * SIGMAS

SCALE_TOLERANCE: Final = 0.05  # tolerance besides noise, for scale error and cross-axis sensitivity of a few percent

AxisWord = Literal["seen", "too small to see", "not seen", "wrong"]
_REFUTED: Final = ("not seen", "wrong")


@dataclasses.dataclass(frozen=True, slots=True)
class Observation:
    """Mean rate or specific force of one IMU before and after a write.

    Vectors are in the vehicle's FRD axes. Each sigma is that of the mean and includes the drift of the sensor between
    the two measurements. `expected_step` comes from `imu_calibration.output_step`.
    """

    parameters: Names
    unit: str
    before: Vector
    before_sigma: Vector
    after: Vector
    after_sigma: Vector
    expected_step: Vector
    truth: Vector
    tolerance: float
    orientation: Matrix | None = None  # 3x3, parameters' axes to the vehicle's; None: identity
    resolution: float = 0.0  # last digit of integer messages, the largest truncation error of a mean; 0: floats


@dataclasses.dataclass(frozen=True, slots=True)
class EffectVerdict:
    """Verdict on the effect of a write on one vector (rate or specific force)."""

    axes: Mapping[str, AxisWord]
    fraction_sigma: float | None  # sigma of the fraction of the expected step; None: no step expected
    problems: tuple[str, ...]
    hidden: tuple[str, ...]  # Parameters whose step was too small to judge

    @property
    def ok(self) -> bool:
        """Return True if nothing contradicts the write; a step too small to see is no contradiction."""
        return not self.problems

    def outcome(self, parameter: str) -> Literal["verified", "stored", "failed"]:
        """Return the outcome of a parameter whose read-back was correct."""
        word = self.axes[parameter]
        return "failed" if word in _REFUTED else "verified" if word == "seen" else "stored"


def judge(seen: Observation) -> EffectVerdict:
    rotation = np.eye(3) if seen.orientation is None else seen.orientation
    made = rotation.T @ np.subtract(seen.after, seen.before)
    expected = rotation.T @ np.asarray(seen.expected_step)
    sigma = np.sqrt((rotation.T**2) @ (np.square(seen.before_sigma) + np.square(seen.after_sigma)))
    # Truncation may change each of the two means by up to one digit.
    slack = 2.0 * seen.resolution
    floor = np.maximum(sigma, max(seen.resolution, 1e-12))
    weight = float(np.sum((expected / floor) ** 2))
    fraction, fraction_sigma = 0.0, None
    together: AxisWord = "too small to see"
    if math.isfinite(weight) and weight > 0.0:
        fraction, fraction_sigma = float(np.sum(made * expected / floor**2)) / weight, 1.0 / math.sqrt(weight)
        together = _together(fraction, fraction_sigma)
    axes: dict[str, AxisWord] = {}
    problems: list[str] = []
    for name, e, m, s in zip(seen.parameters, expected.tolist(), made.tolist(), sigma.tolist(), strict=True):
        axes[name], why = _judge_axis(e, m, s, slack)
        if axes[name] in _REFUTED:
            problems.append(_problem(name, f"{m:.3g} {seen.unit}", f"{e:.3g}", f"{s:.2g}", why))
    family = f"{seen.parameters[0]}, {', '.join('_' + name[-1] for name in seen.parameters[1:])}"
    if not problems and together in _REFUTED:
        problems.append(
            _problem(family, f"{fraction:.0%} of the step", "100%", f"{fraction_sigma:.0%}", "all axes together")
        )
    residual = np.subtract(seen.after, seen.truth)
    allowed = seen.tolerance + SIGMAS * np.asarray(seen.after_sigma) + seen.resolution
    for axis, value, limit in zip("xyz", residual, allowed, strict=True):
        if not abs(value) <= limit:  # this form also rejects NaN
            off, most = f"{value:.3g} {seen.unit}", f"{limit:.2g}"
            problems.append(message("still_off_after_write", axis=axis, value=off, limit=most, parameters=family))
    hidden = [name for name, step in zip(axes, expected, strict=True) if axes[name] == "too small to see" and step]
    return EffectVerdict(
        axes=axes,
        fraction_sigma=fraction_sigma,
        problems=tuple(problems),
        hidden=tuple(hidden) if together != "seen" else (),
    )


def _judge_axis(expected: float, made: float, sigma: float, slack: float) -> tuple[AxisWord, str]:
    noise = SIGMAS * sigma + slack
    agrees = abs(made - expected) <= noise + SCALE_TOLERANCE * abs(expected)
    if not all(map(math.isfinite, (expected, made, sigma))):
        return "wrong", "not a number"
    if abs(expected) < 2 * noise:
        return ("too small to see", "") if agrees else ("wrong", "it changed although it should not")
    if agrees:
        return "seen", ""
    if abs(made) <= noise:
        return "not seen", "the autopilot stored the value but does not use it"
    return "wrong", "not the step that was written"


def _problem(parameters: str, moved: str, expected: str, noise: str, why: str) -> str:
    return message("write_without_effect", parameters=parameters, moved=moved, expected=expected, noise=noise, why=why)


def _together(fraction: float, sigma: float) -> AxisWord:
    if VISIBLE_SIGMAS * sigma > 1.0:
        return "too small to see"
    if abs(fraction - 1.0) <= SIGMAS * sigma + SCALE_TOLERANCE:
        return "seen"
    return "not seen" if abs(fraction) <= SIGMAS * sigma else "wrong"
