"""Effect of written offsets, judged from the telemetry before and after.

A parameter that reads back right proves nothing about the value in use: PX4 stores a small change and goes on with
the old one, and a wrong orientation or sign moves the wrong axis (autopilots 4.2, 8.6). So the step that the output
made is compared with the step that it had to make. Everything is judged in the axes of the parameters (the board's),
so that a verdict names a parameter; the residual that remains is judged in the vehicle's.

Two hypotheses stand against each other, "the whole step" and "no step". With the step's standard deviation s, an
axis can tell them apart when the expected step is at least 8 s, since each then keeps 4 s for itself; a true axis is
called wrong once in 16000. Over the three axes together a matched filter estimates the fraction of the step that was
made, which can see what no axis can see alone.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Final, Literal

import numpy as np

from companion.physics.frames import Matrix
from companion.samples import Vector

SIGMAS: Final = 4.0
"""Largest distance of a figure from its hypothesis, in standard deviations."""

VISIBLE_SIGMAS: Final = 2 * SIGMAS

SCALE_TOLERANCE: Final = 0.05
"""Besides noise: a sensor's scale error and cross-axis sensitivity change the step by a few percent at most."""

AxisWord = Literal["seen", "too small to see", "not seen", "wrong"]
_REFUTED: Final = ("not seen", "wrong")


@dataclasses.dataclass(frozen=True, slots=True)
class Observation:
    """One vector, the rate or the specific force of one IMU, before and after a write.

    Means and sigmas are (3,) in the vehicle's FRD, in the unit of the vector; a sigma is that of the mean and covers
    what the sensor drifts between the two windows.
    """

    parameters: tuple[str, str, str]
    unit: str
    before: Vector
    before_sigma: Vector
    after: Vector
    after_sigma: Vector
    expected_step: Vector
    """Step that the output had to make (`imu_calibration.output_step`)."""
    truth: Vector
    tolerance: float
    orientation: Matrix | None = None
    """3x3, the parameters' axes to the vehicle's; None: they are the same."""
    resolution: float = 0.0
    """For integer messages one last digit, by which truncation may misstate a mean; 0 for floats."""


@dataclasses.dataclass(frozen=True, slots=True)
class EffectVerdict:
    """One vector."""

    axes: Mapping[str, AxisWord]
    fraction_sigma: float | None
    """Sigma of the share of the expected step that was made, over all axes; None when nothing had to move."""
    problems: tuple[str, ...]
    hidden: tuple[str, ...]
    """The parameters whose step could not be judged."""

    @property
    def ok(self) -> bool:
        """Nothing contradicts the write; what is too small to see does not."""
        return not self.problems

    def outcome(self, parameter: str) -> Literal["verified", "stored", "failed"]:
        """Return the outcome of a parameter that read back right."""
        word = self.axes[parameter]
        return "failed" if word in _REFUTED else "verified" if word == "seen" else "stored"


def judge(seen: Observation) -> EffectVerdict:
    """Judge one vector."""
    rotation = np.eye(3) if seen.orientation is None else seen.orientation
    made = rotation.T @ (np.asarray(seen.after) - np.asarray(seen.before))
    expected = rotation.T @ np.asarray(seen.expected_step)
    variance = np.asarray(seen.before_sigma) ** 2 + np.asarray(seen.after_sigma) ** 2
    sigma = np.sqrt((rotation.T**2) @ variance)
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
            figures = f"the output moved by {m:.3g} {seen.unit}, expected {e:.3g}, noise {s:.2g}"
            problems.append(f"{name}: {figures}: {why}")
    residual = np.asarray(seen.after) - np.asarray(seen.truth)
    allowed = seen.tolerance + SIGMAS * np.asarray(seen.after_sigma) + seen.resolution
    within = [bool(inside) for inside in np.abs(residual) <= allowed]
    family = f"{seen.parameters[0]}, {', '.join('_' + name[-1] for name in seen.parameters[1:])}"
    if not problems and together == "not seen":
        problems.append(f"{family}: no axis moved as written; the autopilot stored the values but does not use them")
    elif not problems and together == "wrong":
        problems.append(f"{family}: the output made {fraction:.0%} of the step that was written")
    for axis_name, inside, value, limit in zip("xyz", within, residual, allowed, strict=True):
        if not inside:
            problems.append(
                f"after the write {axis_name} is still off by {value:.3g} {seen.unit}, allowed are {limit:.2g}"
                f" ({family})"
            )
    hidden = [name for name, step in zip(axes, expected, strict=True) if axes[name] == "too small to see" and step]
    return EffectVerdict(
        axes=axes,
        fraction_sigma=fraction_sigma,
        problems=tuple(problems),
        hidden=tuple(hidden) if together != "seen" else (),
    )


def _judge_axis(expected: float, made: float, sigma: float, slack: float) -> tuple[AxisWord, str]:
    """Judge the step of one axis, and say what is wrong with it."""
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
    return "wrong", "not the step that was written (sign, orientation, scale, or it moved)"


def _together(fraction: float, sigma: float) -> AxisWord:
    if VISIBLE_SIGMAS * sigma > 1.0:
        return "too small to see"
    if abs(fraction - 1.0) <= SIGMAS * sigma + SCALE_TOLERANCE:
        return "seen"
    return "not seen" if abs(fraction) <= SIGMAS * sigma else "wrong"
