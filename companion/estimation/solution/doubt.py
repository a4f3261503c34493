"""Detection of contradictions between today's measurement and earlier calibrations, with their probable cause.

All IMUs measure the same tilt, gravity and rotation. A change common to all of them comes from the gradienter (tilt
sensor) or its zero, from a wrong local gravity, or from a turn of the aircraft. If one IMU has changed while the others
agree with their predictions, that IMU is the cause (method.md section 2.1).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from companion.estimation.solution.prior import Prediction
from companion.messages import message
from companion.physics.frames import Array, Matrix
from companion.physics.units import DEG, DEG_H, MG, UNITS
from companion.samples import TRIADS, Triad

Cause = Literal["gradienter", "gravity", "turn", "imu", "unclear"]

LEAST_GAIN: Final = 9.0
"""Least decrease of chi-square by which one explanation beats another: three sigmas."""
CHI_SQUARE_99: Final = 11.34
"""Chi-square of three axes that chance exceeds once in a hundred. A prediction with more is not used in the estimate,
because it may belong to another sensor. A warning needs a larger difference."""
_OF_ALL: Final[dict[Cause, str]] = {
    "gradienter": "gradienter or its zero moved",
    "gravity": "gravity differs",
    "turn": "the aircraft turns",
}
"""Short texts for causes that change the gyros or the accelerometers of all IMUs."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Witness:
    """Measured and predicted bias of one triad (gyros or accelerometers) of IMU number `imu`.

    The variance of their difference has two parts: `own_variance` (3,) of this IMU, and `common` (3, 3) of all IMUs.
    """

    imu: int
    name: str
    triad: Triad
    expected: Prediction
    measured: Array
    own_variance: Array
    common: Matrix

    @property
    def difference(self) -> Array:
        """Measured minus predicted bias, (3,)."""
        return np.asarray(self.measured - np.array(self.expected.value))

    @property
    def sigma(self) -> Array:
        """One sigma of the measured minus the predicted bias, (3,)."""
        return np.sqrt(self.own_variance + np.diag(self.common))

    @property
    def contradicts(self) -> bool:
        return bool((np.abs(self.difference) > self.expected.limit * self.sigma).any())

    @property
    def may_weigh(self) -> bool:
        if not self.expected.weighs:
            return False
        covariance = np.diag(self.own_variance) + self.common
        return float(self.difference @ np.linalg.solve(covariance, self.difference)) < CHI_SQUARE_99

    def along(self, up: Array) -> tuple[float, float]:
        variance = np.square(up) @ self.own_variance + up @ self.common @ up
        return float(up @ self.difference), math.sqrt(variance)

    def gain(self, shift: Array) -> float:
        """Return how much chi-square, by own variance only, decreases if `shift` is subtracted from the difference."""
        return float(np.sum((np.square(self.difference) - np.square(self.difference - shift)) / self.own_variance))

    def is_explained(self, shift: Array) -> bool:
        return bool((np.abs(self.difference - shift) <= self.expected.limit * np.sqrt(self.own_variance)).all())


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Inconsistency:
    """Contradiction to earlier calibrations: probable cause, IMUs concerned, and one line of text for a pilot."""

    triad: Triad
    cause: Cause
    names: tuple[str, ...]  # IMUs with doubtful readings
    words: str

    @property
    def of_all(self) -> bool:
        return self.cause in _OF_ALL

    @property
    def in_short(self) -> str:
        return _OF_ALL.get(self.cause, "unlike before")


def contradictions(
    earlier: Sequence[Witness], today: Sequence[Witness], imus: int, up: Array, by_reading: Matrix | None
) -> list[Inconsistency]:
    """List all contradictions between measured biases and their predictions.

    Predictions from this power-up (`today`) are more exact. Predictions from `earlier` power-ups count only if today's
    agree with the measurement and cover fewer than all IMUs (`imus`: their number). `by_reading` (3, 2) is the
    derivative of accelerometer biases by the gradienter's readings.
    """
    gravity: tuple[Cause, Matrix] = ("gravity", up[:, None])
    causes: dict[Triad, list[tuple[Cause, Matrix]]] = {
        "gyro": [("turn", np.eye(3))],
        "accel": [gravity] if by_reading is None else [("gradienter", by_reading), gravity],
    }
    found: list[Inconsistency] = []
    for triad in TRIADS:
        of_today = [witness for witness in today if witness.triad == triad]
        doubts = _doubts(of_today, causes[triad], today=True)
        if not doubts and len(of_today) < imus:
            doubts = _doubts([one for one in earlier if one.triad == triad], causes[triad], today=False)
        found += doubts
    return found


def _doubts(
    witnesses: Sequence[Witness], causes: Sequence[tuple[Cause, Matrix]], *, today: bool
) -> list[Inconsistency]:
    """Explain all contradictions by one cause common to all IMUs if it fits; else explain each contradiction alone."""
    against = [witness for witness in witnesses if witness.contradicts]
    others = [witness for witness in witnesses if not witness.contradicts]
    for cause, directions in causes if against else ():
        shift, size = _common(against, directions)
        gains = [witness.gain(shift) for witness in others]
        named = {witness.name for witness in against}
        named |= {witness.name for witness, gain in zip(others, gains, strict=True) if gain > LEAST_GAIN}
        explains = all(witness.is_explained(shift) for witness in against) and min(gains, default=0.0) >= -LEAST_GAIN
        if explains and len(named) > 1:
            names = tuple(witness.name for witness in witnesses if witness.name in named)
            return [Inconsistency(against[0].triad, cause, names, _of_all(cause, size, ", ".join(names), against))]
    return [_alone(witness, others, causes, today=today) for witness in against]


def _common(witnesses: Sequence[Witness], directions: Matrix) -> tuple[Array, Array]:
    """Fit the shift along `directions` (3, n) that best explains all differences; return it and its n components."""
    by = np.vstack([directions / np.sqrt(witness.own_variance)[:, None] for witness in witnesses])
    found = np.concatenate([witness.difference / np.sqrt(witness.own_variance) for witness in witnesses])
    size = np.asarray(np.linalg.lstsq(by, found)[0], dtype=np.float64)
    return directions @ size, size


def _alone(
    witness: Witness, others: Sequence[Witness], causes: Sequence[tuple[Cause, Matrix]], *, today: bool
) -> Inconsistency:
    triad, name, expected = witness.triad, witness.name, witness.expected
    unit, words, digits = UNITS[triad]
    axis = int(np.argmax(np.abs(witness.difference) / witness.sigma))
    before = "the last calibration of this power-up"
    if not today:
        before = f"{expected.power_ups} earlier power-ups (usual: {witness.sigma[axis] / unit:.{digits}f})"

    def doubt(found: Cause, suspicion: str) -> Inconsistency:
        axis_of, by = f"{triad} {name}: {'xyz'[axis]}", f"{witness.difference[axis] / unit:+.{digits}f} {words}"
        line = message("imu_differs", axis=axis_of, difference=by, before=before, suspicion=suspicion)
        return Inconsistency(triad, found, (name,), line)

    for cause, directions in causes:
        shift, size = _common([witness], directions)
        if witness.is_explained(shift) and not any(other.gain(shift) < -LEAST_GAIN for other in others):
            also = {
                "gradienter": f"the gradienter has moved by {math.hypot(*size) / DEG:.2f} deg",
                "gravity": "height or latitude are wrong",
                "turn": "the aircraft turns (a boat?)",
            }[cause]
            return doubt("unclear", f"sensor replaced, or {also}")
    agree = ", ".join(other.name for other in others)
    return doubt("imu", f"check this sensor ({agree} agrees with its own)" if agree else "check this sensor")


def _of_all(cause: Cause, size: Array, names: str, against: Sequence[Witness]) -> str:
    """Describe a contradiction of all IMUs for a pilot; `size`: change of tilt (rad), gravity or turn rate (SI)."""
    sensors = "accelerometers"
    if cause == "turn":
        fault, sensors = f"the aircraft turns by {float(np.linalg.norm(size)) / DEG_H:.0f} deg/h", "gyros"
        remedy = "is it on a boat or a turntable?"
    elif cause == "gravity":
        fault, remedy = f"gravity differs by {size[0] / MG:+.1f} mg", "check height and latitude"
    else:
        x, y = size / DEG
        by = f"{math.hypot(x, y):.2f} deg (x {x:+.2f}, y {y:+.2f})"
        fault, remedy = f"the gradienter has moved by {by}", "check its mounting, then companion align zero"
        if not all(witness.expected.same_zero > 0.5 for witness in against):
            fault, remedy = f"the gradienter's zero has changed by {by} too much", "repeat companion align zero"
    return message("all_imus_differ", fault=fault, sensors=sensors, imus=names, remedy=remedy)
