"""What stands of the accelerometers leave open, and which one to take next, in words for whoever holds the aircraft."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Final

import numpy as np

from companion.estimation.alignment.faces import FIGURES, LEAST_SPARE, SCALE, Faces, along
from companion.physics.frames import Array, Matrix
from companion.physics.units import MG

ENOUGH_BIAS_M_S2: Final = 0.15 * MG
ENOUGH_SCALE: Final = 2e-4
ENOUGH_WANDER: Final = 0.8
"""By how much of what a bias wanders it may be unknown: beyond that a dozen stands make a bad sensor no better."""
SAME_DEG: Final = 20.0
"""Two stands within this angle tell hardly more than one."""
FACE_DEG: Final = 30.0
"""A stand within this angle of a face has seen it."""
_STAND_SIGMA_M_S2: Final = 0.03 * MG
"""What the mean of a coming stand will be good for, about."""
_AXES: Final = "xyz"
_SIDES: Final = {
    "level": (0, 0, -1),
    "on its back": (0, 0, 1),
    "nose up": (1, 0, 0),
    "nose down": (-1, 0, 0),
    "left side down": (0, 1, 0),
    "right side down": (0, -1, 0),
}
"""Up in the aircraft's axes, forward, right, down."""


@dataclasses.dataclass(frozen=True, slots=True)
class Missing:
    """The figure that is worst, and the stand that tells most of it."""

    side: str
    figure: str
    """Of which axis, with its sigma; or why there is to be another stand."""
    unknown: tuple[str, ...] = ()
    """All that are not known well enough, likewise, the worst first."""

    def __str__(self) -> str:
        return f"{self.side}: {self.figure}"


def missing(found: Faces, vehicle_from_sensor: Matrix) -> Missing | None:
    """What to do next; None where bias and scale of all axes are known well enough, and checked.

    `vehicle_from_sensor`: 3x3, the mounting of the accelerometers that `found` speaks of.
    """
    wander, gravity = ENOUGH_WANDER * found.wander_m_s2, found.gravity_m_s2
    # No stand tells by how much gravity is not what the place says: that much of the scale stays open.
    scale = np.hypot(np.maximum(ENOUGH_SCALE, wander / gravity), found.gravity_sigma_m_s2 / gravity)
    wanted = np.concatenate([np.maximum(ENOUGH_BIAS_M_S2, wander), scale, np.full(3, np.inf)])
    share = _sigma(found) / wanted
    open_figures = share > 1.0
    unchecked = len(found.up) - len(found.left_out) < FIGURES + LEAST_SPARE
    if not open_figures.any() and not unchecked and not found.in_doubt:
        return None
    # Where all have been seen, the one that tells most is held once more.
    sides = _not_seen(found, vehicle_from_sensor) or _all_sides(vehicle_from_sensor)
    told = {side: _told(found, up) for side, up in sides}
    if not open_figures.any():
        words = "a stand does not fit, one more tells which" if found.in_doubt else "nothing checks the others yet"
        return Missing(max(told, key=lambda side: float(told[side].sum())), words)
    side = max(told, key=lambda side: float(told[side][open_figures].sum()))
    worst_first = [_figure(found, int(which)) for which in np.argsort(-share) if open_figures[which]]
    told_most = int(np.argmax(np.where(open_figures, told[side] * share, 0.0)))
    return Missing(side, _figure(found, told_most), tuple(worst_first))


def seen_before(found: Faces, up: Array, vehicle_from_sensor: Matrix) -> int | None:
    """The stand, counted from 0, that was held like this one; None where it is a new one, or no side is new any more.

    `up` is in the sensor's axes, (3,), of length 1; `found` is from the stands before.
    """
    if not _not_seen(found, vehicle_from_sensor):
        return None
    near = found.up @ up
    near[list(found.left_out)] = -1.0
    nearest = int(np.argmax(near))
    return nearest if near[nearest] > np.cos(np.radians(SAME_DEG)) else None


def _not_seen(found: Faces, vehicle_from_sensor: Matrix) -> list[tuple[str, Array]]:
    """Faces that no stand so far was near, else edges between them; up in the sensor's axes."""
    kept = np.delete(found.up, found.left_out, axis=0)
    sides = _all_sides(vehicle_from_sensor)
    new = [(name, up) for name, up in sides if (kept @ up).max() < np.cos(np.radians(FACE_DEG))]
    return [(name, up) for name, up in new if name in _SIDES] or new


def _all_sides(vehicle_from_sensor: Matrix) -> list[tuple[str, Array]]:
    faces = {name: np.array(up, dtype=np.float64) for name, up in _SIDES.items()}
    edges = {
        f"between {a} and {b}": (faces[a] + faces[b]) / np.sqrt(2.0)
        for a, b in itertools.combinations(faces, 2)
        if not faces[a] @ faces[b]
    }
    return [(name, vehicle_from_sensor.T @ up) for name, up in {**faces, **edges}.items()]


def _told(found: Faces, up: Array) -> Array:
    """The share of each figure's variance, (9,), that a stand with `up` upwards would take away."""
    by = along(up, found.gravity_m_s2)
    gain = found.by_stands @ by
    return np.asarray(gain**2 / (by @ gain + _STAND_SIGMA_M_S2**2) / np.diag(found.by_stands))


def _sigma(found: Faces) -> Array:
    return np.sqrt(np.diag(found.by_stands))


def _figure(found: Faces, which: int) -> str:
    """One of the biases or scales: nobody wants the shear."""
    axis, sigma = _AXES[which % 3], _sigma(found)[which]
    if which < SCALE.start:
        return f"{axis} bias uncertain by {_two_digits(sigma / MG)} mg"
    return f"{axis} scale uncertain by {_two_digits(100.0 * sigma)} %"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def up_of(side: str) -> tuple[float, float, float]:
    """Up in the aircraft's axes, forward, right, down, of length 1, where it is held as `Missing.side` says."""
    names = side.removeprefix("between ").split(" and ")
    up = np.sum([_SIDES[name] for name in names], axis=0)
    x, y, z = (up / np.linalg.norm(up)).tolist()
    return x, y, z
