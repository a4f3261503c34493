"""Effect of written offsets, judged from the telemetry before and after.

A parameter that reads back right proves nothing about the value in use: PX4 stores a small change and goes on with
the old one, and a wrong orientation or sign moves the wrong axis (autopilots 4.2, 8.6). So the step that the output
made is compared with the expected one, in the axes of the parameters (the board's), so that a verdict names a
parameter; the residual that remains is judged in the vehicle's.

An axis can tell "the whole step" from "no step" when the expected step is at least 8 sigma, since each then keeps 4
for itself; a true axis is called wrong once in 16000. Over the three axes together a matched filter estimates the
fraction of the step that was made, which can see what no axis can see alone.
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

SCALE_TOLERANCE: Final = 0.05  # besides noise: scale error and cross-axis sensitivity, a few percent at most

AxisWord = Literal["seen", "too small to see", "not seen", "wrong"]
_REFUTED: Final = ("not seen", "wrong")


@dataclasses.dataclass(frozen=True, slots=True)
class Observation:
    """One vector, the rate or the specific force of one IMU, before and after a write.

    Means and sigmas are in the vehicle's FRD; a sigma is that of the mean and covers what the sensor drifts between the
    two windows. `expected_step`: as by `imu_calibration.output_step`.
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
    orientation: Matrix | None = None  # 3x3, the parameters' axes to the vehicle's; None: they are the same
    resolution: float = 0.0  # last digit of integer messages, by which truncation may misstate a mean; 0: floats


@dataclasses.dataclass(frozen=True, slots=True)
class EffectVerdict:
    """One vector."""

    axes: Mapping[str, AxisWord]
    fraction_sigma: float | None  # of the share of the expected step that was made; None: nothing had to move
    problems: tuple[str, ...]
    hidden: tuple[str, ...]  # The parameters whose step could not be judged

    @property
    def ok(self) -> bool:
        """Nothing contradicts the write; what is too small to see does not."""
        return not self.problems

    def outcome(self, parameter: str) -> Literal["verified", "stored", "failed"]:
        """Return the outcome of a parameter that read back right."""
        word = self.axes[parameter]
        return "failed" if word in _REFUTED else "verified" if word == "seen" else "stored"


def judge(seen: Observation) -> EffectVerdict:
    rotation = np.eye(3) if seen.orientation is None else seen.orientation
    made = rotation.T @ np.subtract(seen.after, seen.before)
    expected = rotation.T @ np.asarray(seen.expected_step)
    sigma = np.sqrt((rotation.T**2) @ (np.square(seen.before_sigma) + np.square(seen.after_sigma)))
    # Both means may be misstated, each by up to a digit.
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
        if not abs(value) <= limit:  # NaN is outside too
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
        return ("too small to see", "") if agrees else ("wrong", "it moved although it should not")
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
