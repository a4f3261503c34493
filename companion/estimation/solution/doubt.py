"""Names what contradicts earlier calibrations: one IMU, the gradienter, the believed gravity, or a turn.

One tilt, one gravity and one rotation are behind the readings of all IMUs. What has changed alike in all of them is
the gradienter (or its zero), the gravity that the place was believed to have, or a turn; what has changed in one of
them, while the others agree with their predictions, is that one (method 2.1).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from companion.physics.frames import Array, Matrix
from companion.physics.units import DEG, DEG_H, MG, UNITS
from companion.samples import TRIADS, Triad

Cause = Literal["gradienter", "gravity", "turn", "imu", "unclear"]

TELLS: Final = 9.0
"""Least gain in chi square by which one explanation beats another: three sigmas."""
_IN_SHORT: Final[dict[Cause, str]] = {
    "gradienter": "gradienter or its zero moved",
    "gravity": "gravity differs",
    "turn": "it turns",
    "imu": "unlike before",
    "unclear": "unlike before",
}


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """One triad of one IMU against its prediction."""

    name: str
    difference: Array
    """Measurement less prediction, (3,)."""
    own_variance: Array
    """Variance of the difference that other IMUs do not share, (3,)."""
    common: Matrix
    """Covariance of the difference that all IMUs share, (3, 3)."""
    limit: float
    power_ups: int
    same_zero: bool
    """Both were measured with the same zero of the gradienter."""

    @property
    def sigma(self) -> Array:
        """One sigma of the difference, (3,)."""
        return np.sqrt(self.own_variance + np.diag(self.common))

    @property
    def contradicts(self) -> bool:
        """Whether an axis is beyond the gate."""
        return bool((np.abs(self.difference) > self.limit * self.sigma).any())

    def along(self, up: Array) -> tuple[float, float]:
        """Give the difference about the vertical, and one sigma."""
        variance = np.square(up) @ self.own_variance + up @ self.common @ up
        return float(up @ self.difference), math.sqrt(variance)

    def gain(self, shift: Array) -> float:
        """Give the drop of chi square, against the own variance only, when a common shift is subtracted."""
        return float(np.sum((np.square(self.difference) - np.square(self.difference - shift)) / self.own_variance))

    def is_explained(self, shift: Array) -> bool:
        """Whether the rest is within the gate once a common shift is subtracted."""
        return bool((np.abs(self.difference - shift) <= self.limit * np.sqrt(self.own_variance)).all())


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """A contradiction: its cause, and one line for a pilot."""

    triad: Triad
    cause: Cause
    names: tuple[str, ...]
    """IMUs whose readings are not to be believed."""
    words: str

    @property
    def of_all(self) -> bool:
        """Whether it concerns this triad of all IMUs, not only of those named."""
        return self.cause not in ("imu", "unclear")

    @property
    def in_short(self) -> str:
        """The cause in a few words."""
        return _IN_SHORT[self.cause]


def contradictions(
    earlier: Sequence[tuple[Triad, Witness]],
    today: Sequence[tuple[Triad, Witness]],
    imus: int,
    up: Array,
    by_reading: Matrix | None,
) -> list[Doubt]:
    """Find all contradictions; empty while all is well.

    Args:
        earlier: predictions from earlier power-ups.
        today: predictions from this power-up, which say most: older ones count only where these are silent.
        imus: number of IMUs of the solution.
        up: unit vector in the vehicle's axes.
        by_reading: d (accelerometer bias) / d (gradienter's readings), (3, 2).
    """
    found: list[Doubt] = []
    for triad in TRIADS:
        for known, is_today in ((today, True), (earlier, False)):
            witnesses = [witness for of, witness in known if of == triad]
            doubts = _doubts(triad, witnesses, up, by_reading, today=is_today)
            if doubts or (is_today and len(witnesses) == imus):
                found += doubts
                break
    return found


def _doubts(
    triad: Triad, witnesses: Sequence[Witness], up: Array, by_reading: Matrix | None, *, today: bool
) -> list[Doubt]:
    against = [witness for witness in witnesses if witness.contradicts]
    others = [witness for witness in witnesses if not witness.contradicts]
    causes = _causes(triad, up, by_reading)
    for cause, directions in causes if against else ():
        shift, size = _common(against, directions)
        if not all(witness.is_explained(shift) for witness in against):
            continue
        gains = [witness.gain(shift) for witness in others]
        if any(gain < -TELLS for gain in gains):
            continue
        named = {witness.name for witness in against}
        named |= {witness.name for witness, gain in zip(others, gains, strict=True) if gain > TELLS}
        if len(named) < 2:
            continue
        names = tuple(witness.name for witness in witnesses if witness.name in named)
        return [Doubt(triad, cause, names, _of_all(cause, size, names, against))]
    return [_alone(triad, witness, others, causes, today=today) for witness in against]


def _causes(triad: Triad, up: Array, by_reading: Matrix | None) -> list[tuple[Cause, Matrix]]:
    """List the common causes, and the directions in which each shifts all IMUs."""
    if triad == "gyro":
        return [("turn", np.eye(3))]
    gravity: tuple[Cause, Matrix] = ("gravity", up[:, None])
    return [gravity] if by_reading is None else [("gradienter", by_reading), gravity]


def _common(witnesses: Sequence[Witness], directions: Matrix) -> tuple[Array, Array]:
    """Fit the one shift along these directions that explains all best; also give its size along each."""
    weights = [directions.T / witness.own_variance for witness in witnesses]
    normal = sum((weight @ directions for weight in weights), np.zeros((directions.shape[1],) * 2))
    right = sum((w @ witness.difference for w, witness in zip(weights, witnesses, strict=True)), np.zeros(len(normal)))
    size = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    return directions @ size, size


def _alone(
    triad: Triad, witness: Witness, others: Sequence[Witness], causes: Sequence[tuple[Cause, Matrix]], *, today: bool
) -> Doubt:
    """Judge one IMU that contradicts: do the others rule out the common causes?"""
    unit, words, digits = UNITS[triad]
    axis = int(np.argmax(np.abs(witness.difference) / witness.sigma))
    before = (
        "the calibration before in this power-up"
        if today
        else f"{witness.power_ups} earlier power-ups (usual: {witness.sigma[axis] / unit:.{digits}f})"
    )
    by = f"{witness.difference[axis] / unit:+.{digits}f} {words}"
    line = f"{triad} {witness.name}: {'xyz'[axis]} differs by {by} from {before}"
    for cause, directions in causes:
        shift, size = _common([witness], directions)
        if witness.is_explained(shift) and not any(other.gain(shift) < -TELLS for other in others):
            also = {
                "gradienter": f"the gradienter has moved by {math.hypot(*size) / DEG:.2f} deg",
                "gravity": "height and latitude of the place are wrong",
                "turn": "it turns (a boat?)",
            }[cause]
            return Doubt(triad, "unclear", (witness.name,), f"{line}: this sensor is another one now, or {also}")
    agree = ", ".join(other.name for other in others)
    end = f"while {agree} agrees with its own: look at this sensor" if agree else "look at this sensor"
    return Doubt(triad, "imu", (witness.name,), f"{line}, {end}")


def _of_all(cause: Cause, size: Array, imus: Sequence[str], against: Sequence[Witness]) -> str:
    """Say a contradiction of all IMUs to a pilot; `size` is the shift along the cause's directions."""
    names = ", ".join(imus)
    if cause == "turn":
        return (
            f"all gyros ({names}) differ alike from before, by {float(np.linalg.norm(size)) / DEG_H:.0f} deg/h:"
            " does it turn (a boat, a turntable)?"
        )
    if cause == "gravity":
        return (
            f"all accelerometers ({names}) read {size[0] / MG:+.1f} mg more along the vertical than before: are"
            " height and latitude of the place right?"
        )
    x, y = size / DEG
    by = f"{math.hypot(x, y):.2f} deg (x {x:+.2f}, y {y:+.2f})"
    if all(witness.same_zero for witness in against):
        return (
            f"the gradienter has moved by {by}: all accelerometers ({names}) differ alike from before; look"
            " at its mounting, then companion align zero"
        )
    return (
        f"the gradienter's zero differs from the one before by {by} more than it should: all accelerometers"
        f" ({names}) say so; companion align zero"
    )
