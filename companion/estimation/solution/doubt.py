"""Readings that contradict what is known from before: whose fault is it?

One tilt, one gravity and one rotation are behind the readings of all IMUs. What has changed alike in all of them is
the gradienter (or its zero), the gravity that the place was believed to have, or a turn; what has changed in one of
them, while the others agree with what is known of them, is that one (method 2.1).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Final, Literal

import numpy as np

from companion.physics.frames import Array, Matrix
from companion.physics.units import DEG, DEG_H, MG, UNITS
from companion.samples import Triad

Cause = Literal["gradienter", "gravity", "turn", "imu", "unclear"]

TELLS: Final = 9.0
"""By so much of chi square one explanation must be better than the other: three sigmas."""
_AXES: Final = "xyz"


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """One triad of one IMU against what was expected of it."""

    name: str
    difference: Array
    """Measured less expected, (3,)."""
    own_variance: Array
    """What is its own of the difference's variance, (3,)."""
    common: Matrix
    """What it has in common with the other IMUs, (3, 3)."""
    limit: float
    power_ups: int
    same_zero: bool
    """Measured with the same zero of the gradienter as before."""

    @property
    def sigma(self) -> Array:
        """Of the difference, (3,)."""
        return np.sqrt(self.own_variance + np.diag(self.common))

    @property
    def contradicts(self) -> bool:
        """Whether an axis is beyond the gate."""
        return bool((np.abs(self.difference) > self.limit * self.sigma).any())

    def chi_square(self, shift: Array) -> float:
        """Of what is left after a shift, against its own variance only."""
        return float(np.sum(np.square(self.difference - shift) / self.own_variance))

    def is_explained(self, shift: Array) -> bool:
        """Whether what is left after a shift is within the gate."""
        return bool((np.abs(self.difference - shift) <= self.limit * np.sqrt(self.own_variance)).all())


_Words = Callable[[Array, tuple[str, ...], Sequence[Witness]], str]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """A contradiction, whose it is, and how to say so to a pilot in one line."""

    triad: Triad
    cause: Cause
    names: tuple[str, ...]
    """Of the IMUs whose readings are not to be believed."""
    words: str

    @property
    def of_all(self) -> bool:
        """Whether it concerns this triad of all IMUs, not only of those named."""
        return self.cause not in ("imu", "unclear")

    @property
    def in_short(self) -> str:
        """The same in a few words."""
        return _IN_SHORT[self.cause]


_IN_SHORT: Final[dict[Cause, str]] = {
    "gradienter": "gradienter or its zero moved",
    "gravity": "gravity differs",
    "turn": "it turns",
    "imu": "unlike before",
    "unclear": "unlike before",
}


def doubts(
    triad: Triad, witnesses: Sequence[Witness], up: Array, by_reading: Matrix | None, *, today: bool
) -> list[Doubt]:
    """Everything that contradicts; empty while all is well.

    A witness is every IMU of which something is known from before, `today`: from this very power-up. `up` is a unit
    vector in the vehicle's axes; `by_reading` d (accelerometer bias) / d (gradienter's readings), (3, 2).
    """
    against = [witness for witness in witnesses if witness.contradicts]
    if not against:
        return []
    others = [witness for witness in witnesses if not witness.contradicts]
    for cause, directions, words in _explanations(triad, up, by_reading):
        shift, size = _common(against, directions)
        if not all(witness.is_explained(shift) for witness in against):
            continue
        better = [witness.chi_square(np.zeros(3)) - witness.chi_square(shift) for witness in others]
        if any(gain < -TELLS for gain in better):
            continue
        with_it = [witness.name for witness, gain in zip(others, better, strict=True) if gain > TELLS]
        if len(against) + len(with_it) < 2:
            continue
        named = {*with_it, *(witness.name for witness in against)}
        names = tuple(witness.name for witness in witnesses if witness.name in named)
        return [Doubt(triad, cause, names, words(size, names, against))]
    return [_alone(triad, witness, others, up, by_reading, today=today) for witness in against]


def _explanations(triad: Triad, up: Array, by_reading: Matrix | None) -> list[tuple[Cause, Matrix, _Words]]:
    if triad == "gyro":
        return [("turn", np.eye(3), _turn)]
    gravity: tuple[Cause, Matrix, _Words] = ("gravity", up[:, None], _gravity)
    return [gravity] if by_reading is None else [("gradienter", by_reading, _gradienter), gravity]


def _common(witnesses: Sequence[Witness], directions: Matrix) -> tuple[Array, Array]:
    """The one shift along these directions that explains all best, and its size along each."""
    weights = [directions.T / witness.own_variance for witness in witnesses]
    normal = sum((weight @ directions for weight in weights), np.zeros((directions.shape[1],) * 2))
    right = sum((w @ witness.difference for w, witness in zip(weights, witnesses, strict=True)), np.zeros(len(normal)))
    size = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    return directions @ size, size


def _alone(
    triad: Triad, witness: Witness, others: Sequence[Witness], up: Array, by_reading: Matrix | None, *, today: bool
) -> Doubt:
    """One IMU contradicts; do the others exonerate what it has in common with them?"""
    unit, words, digits = UNITS[triad]
    axis = int(np.argmax(np.abs(witness.difference) / witness.sigma))
    before = (
        "the calibration before in this power-up"
        if today
        else f"{witness.power_ups} earlier power-ups (usual: {witness.sigma[axis] / unit:.{digits}f})"
    )
    by = f"{witness.difference[axis] / unit:+.{digits}f} {words}"
    line = f"{triad} {witness.name}: {_AXES[axis]} differs by {by} from {before}"
    kinds = _explanations(triad, up, by_reading)
    shifts = [(cause, *_common([witness], directions)) for cause, directions, _ in kinds]
    possible = [
        (cause, size)
        for cause, shift, size in shifts
        if witness.is_explained(shift)
        and not any(other.chi_square(shift) - other.chi_square(np.zeros(3)) > TELLS for other in others)
    ]
    if not possible:
        agree = ", ".join(other.name for other in others)
        end = f"while {agree} agrees with its own: look at this sensor" if agree else "look at this sensor"
        return Doubt(triad, "imu", (witness.name,), f"{line}, {end}")
    cause, size = possible[0]
    also = {
        "gradienter": f"the gradienter has moved by {math.hypot(*size) / DEG:.2f} deg",
        "gravity": "height and latitude of the place are wrong",
        "turn": "it turns (a boat?)",
    }[cause]
    return Doubt(triad, "unclear", (witness.name,), f"{line}: this sensor is another one now, or {also}")


def _gradienter(size: Array, names: tuple[str, ...], against: Sequence[Witness]) -> str:
    x, y = size / DEG
    by = f"{math.hypot(x, y):.2f} deg (x {x:+.2f}, y {y:+.2f})"
    if all(witness.same_zero for witness in against):
        return (
            f"the gradienter has moved by {by}: all accelerometers ({', '.join(names)}) differ alike from before; look"
            " at its mounting, then companion align zero"
        )
    return (
        f"the gradienter's zero differs from the one before by {by} more than it should: all accelerometers"
        f" ({', '.join(names)}) say so; companion align zero"
    )


def _gravity(size: Array, names: tuple[str, ...], _: Sequence[Witness]) -> str:
    return (
        f"all accelerometers ({', '.join(names)}) read {size[0] / MG:+.1f} mg more along the vertical than before: are"
        " height and latitude of the place right?"
    )


def _turn(size: Array, names: tuple[str, ...], _: Sequence[Witness]) -> str:
    return (
        f"all gyros ({', '.join(names)}) differ alike from before, by {float(np.linalg.norm(size)) / DEG_H:.0f} deg/h:"
        " does it turn (a boat, a turntable)?"
    )
