"""What stands of the accelerometers leave open, and which one to take next, in words for whoever holds the aircraft."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Final

import numpy as np

from companion.calibration.alignment.faces import BIAS, FIGURES, LEAST_SPARE, SCALE, Faces, along
from companion.physics.frames import Array, Matrix
from companion.physics.units import MG

ENOUGH_BIAS_M_S2: Final = 0.15 * MG
ENOUGH_SCALE: Final = 2e-4
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
    """Of which axis, with its sigma."""

    def __str__(self) -> str:
        return f"{self.side} is missing: {self.figure}"


def missing(found: Faces, vehicle_from_sensor: Matrix) -> Missing | None:
    """What to do next; None where bias and scale of all axes are known well enough, and checked.

    Args:
        found: from the stands so far.
        vehicle_from_sensor: 3x3, the mounting of the accelerometers that `found` speaks of.
    """
    # No stand tells by how much gravity is not what the place says: that much of the scale stays open.
    scale = np.hypot(ENOUGH_SCALE, found.gravity_sigma_m_s2 / found.gravity_m_s2)
    wanted = np.concatenate([np.full(3, ENOUGH_BIAS_M_S2), np.full(3, scale), np.full(3, np.inf)])
    share = found.sigma / wanted
    open_figures = share > 1.0
    unchecked = len(found.up) - len(found.left_out) < FIGURES + LEAST_SPARE
    if not open_figures.any() and not unchecked and not found.in_doubt:
        return None
    told = {side: _told(found, up) for side, up in _not_seen(found, vehicle_from_sensor)}
    if not open_figures.any():
        words = "a stand does not fit, one more tells which" if found.in_doubt else "nothing checks the others yet"
        return Missing(max(told, key=lambda side: float(told[side].sum())), words)
    side = max(told, key=lambda side: float(told[side][open_figures].sum()))
    return Missing(side, _figure(found, int(np.argmax(np.where(open_figures, told[side] * share, 0.0)))))


def seen_before(found: Faces, up: Array) -> int | None:
    """The stand, counted from 0, that was held like this one; None where it is a new one.

    Args:
        found: from the stands before.
        up: likewise in the sensor's axes, (3,), of length 1.
    """
    near = found.up @ up
    near[list(found.left_out)] = -1.0
    nearest = int(np.argmax(near))
    return nearest if near[nearest] > np.cos(np.radians(SAME_DEG)) else None


def _not_seen(found: Faces, vehicle_from_sensor: Matrix) -> list[tuple[str, Array]]:
    """Faces that no stand so far was near, else edges between them, else all; up in the sensor's axes."""
    faces = {name: np.array(up, dtype=np.float64) for name, up in _SIDES.items()}
    edges = {
        f"half way between {a} and {b}": (faces[a] + faces[b]) / np.sqrt(2.0)
        for a, b in itertools.combinations(faces, 2)
        if not faces[a] @ faces[b]
    }
    kept = np.delete(found.up, found.left_out, axis=0)
    for sides in (faces, edges):
        turned = [(name, vehicle_from_sensor.T @ up) for name, up in sides.items()]
        new = [(name, up) for name, up in turned if (kept @ up).max() < np.cos(np.radians(FACE_DEG))]
        if new:
            return new
    return [(name, vehicle_from_sensor.T @ up) for name, up in {**faces, **edges}.items()]


def _told(found: Faces, up: Array) -> Array:
    """The share of each figure's variance, (9,), that a stand with `up` upwards would take away."""
    by = along(up, found.gravity_m_s2)
    gain = found.covariance @ by
    return np.asarray(gain**2 / (by @ gain + _STAND_SIGMA_M_S2**2) / np.diag(found.covariance))


def _figure(found: Faces, which: int) -> str:
    assert which < FIGURES
    axis, sigma = _AXES[which % 3], found.sigma[which]
    if which in range(*BIAS.indices(FIGURES)):
        return f"{axis} bias {sigma / MG:.2g} mg"
    assert which in range(*SCALE.indices(FIGURES))
    return f"{axis} scale {100.0 * sigma:.2g} %"
