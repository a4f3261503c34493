"""Guided test of a gradienter: two opposite tilts show the law of its readings, and how it is turned.

The autopilot's accelerometers measure both tilts. The size of gravity gives their biases in the plane of the two tilts.
Half the difference of the tilts is free of the remaining bias and of the gradienter's zero. At 20 deg of pitch and roll
the laws differ by 1.2 deg (companion/physics/gradienter.py).
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, get_args

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.physics.frames import Floats, rotation_matrix
from companion.physics.gradienter import Law, readings_from_up
from companion.physics.units import G

STEADY_S: Final = 3  # Seconds without movement that make a tilt
SPREAD_DEG: Final = 0.5  # Largest spread of the readings of these seconds
LEAST_DEG: Final = 15.0  # Least size of both readings: below, the laws differ by less than 0.5 deg
_FITS_DEG: Final = 1.0  # Largest difference from the readings of the right law
_CLEARLY_DEG: Final = 0.5  # Least advantage of the best law over the second best
STEPS: Final = (
    "Tilt 1 of 2: lift the nose and lower the right side, both by 20 to 40 deg. Hold it still.",
    "Tilt 2 of 2: now lower the nose and lift the right side, both by 20 to 40 deg. Hold it still.",
)


class Tilt(NamedTuple):
    """One tilt: the gradienter's readings x and y (2,), and the specific force in body axes (FRD), (3,)."""

    readings_deg: Floats
    force_m_s2: Floats


class TiltTest:
    """Collects two opposite tilts from one-second means."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self.tilts: list[Tilt] = []
        self._recent: deque[tuple[int, Tilt]] = deque(maxlen=STEADY_S)
        self._say = say
        say(STEPS[0])

    @property
    def complete(self) -> bool:
        return len(self.tilts) == len(STEPS)

    def add(self, second: int, tilt: Tilt) -> None:
        if self.complete or (self._recent and second <= self._recent[-1][0]):
            return
        self._recent.append((second, tilt))
        readings = np.array([each.readings_deg for _, each in self._recent])
        mean = readings.mean(axis=0)
        if len(readings) < STEADY_S or np.ptp(readings, axis=0).max() > SPREAD_DEG or np.abs(mean).min() < LEAST_DEG:
            return
        if self.tilts and (np.sign(mean) == np.sign(self.tilts[0].readings_deg)).any():
            return
        self.tilts.append(Tilt(mean, np.mean([each.force_m_s2 for _, each in self._recent], axis=0)))
        if not self.complete:
            self._say(STEPS[len(self.tilts)])


def law_of(tilts: Sequence[Tilt]) -> tuple[Law, int]:
    """Return the law and the mounting's yaw, 0, 90, 180 or 270 deg, that explain two opposite tilts.

    Raises:
        CalibrationRefusedError: no law explains them, or two laws do.
    """
    seen = (tilts[0].readings_deg - tilts[1].readings_deg) / 2.0
    forces = np.array([tilt.force_m_s2 for tilt in tilts])
    sizes = np.linalg.norm(forces, axis=1)
    forces -= np.linalg.pinv(forces / sizes[:, None]) @ (sizes - G)
    misses: dict[tuple[Law, int], float] = {}
    laws: Sequence[Law] = get_args(Law)
    for law, yaw in itertools.product(laws, (0, 90, 180, 270)):
        turned = [readings_from_up(law, rotation_matrix((0.0, 0.0, yaw)).T @ force) for force in forces]
        misses[law, yaw] = float(np.hypot(*(seen - (turned[0] - turned[1]) / 2.0)))
    (best, miss), (_, next_miss) = sorted(misses.items(), key=lambda item: item[1])[:2]
    if miss > _FITS_DEG:
        raise CalibrationRefusedError(f"no law explains these tilts: {best[0]} misses by {miss:.1f} deg")
    if next_miss - miss < _CLEARLY_DEG:
        raise CalibrationRefusedError("these tilts fit two laws: tilt further, both ways at once")
    return best
