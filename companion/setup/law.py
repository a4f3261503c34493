"""Guided test of a gradienter: two opposite tilts show the law of its readings, and how it is turned.

The autopilot's accelerometers measure both tilts. The size of gravity gives their biases in the plane of the two tilts.
Half the difference of the tilts is free of the remaining bias and of the gradienter's zero. At 20 deg of pitch and roll
the laws differ by 1.2 deg (companion/physics/gradienter.py).
"""

from __future__ import annotations

import itertools
import re
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
ENOUGH_DEG, ABOUT_DEG, MOST_DEG = 17, 20, 26
"""Tilts to ask for, so that by every law both readings are above `LEAST_DEG` and within a range of 30 deg."""
MOVED_DEG: Final = 5.0  # Change of a tilt that is worth a line
_FITS_DEG: Final = 1.0  # Largest difference from the readings of the right law
_CLEARLY_DEG: Final = 0.5  # Least advantage of the best law over the second best
_BOTH: Final = f"both by about {ABOUT_DEG} deg ({ENOUGH_DEG} to {MOST_DEG}). Hold it still."
STEPS: Final = (
    f"Tilt 1 of 2: lift the nose and lower the right side, {_BOTH}",
    f"Tilt 1 is measured. Tilt 2 of 2: lower the nose and lift the right side, {_BOTH}",
)
SIDES: Final = (("Nose up", "right side down"), ("Nose down", "right side up"))


class Tilt(NamedTuple):
    """One tilt: the gradienter's readings x and y (2,), and the specific force in body axes (FRD), (3,)."""

    readings_deg: Floats
    force_m_s2: Floats


class TiltTest:
    """Collects two opposite tilts from one-second means, and tells the operator how far each angle is."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self.tilts: list[Tilt] = []
        self._recent: deque[tuple[int, Tilt]] = deque(maxlen=STEADY_S)
        self._key, self._said_deg = "", np.zeros(2)
        self._say = say
        say(STEPS[0])

    @property
    def complete(self) -> bool:
        return len(self.tilts) == len(STEPS)

    def add(self, second: int, tilt: Tilt) -> None:
        """Add the means of one second; a gradienter beyond its range has the readings NaN."""
        if self.complete or (self._recent and second <= self._recent[-1][0]):
            return
        self._recent.append((second, tilt))
        readings, forces = (np.array(each) for each in zip(*(each for _, each in self._recent), strict=True))
        angles_deg = readings_from_up("euler", tilt.force_m_s2)[::-1] * (-1.0 if self.tilts else 1.0)
        spread_deg = np.ptp(readings, axis=0).max()
        is_enough = angles_deg.min() >= LEAST_DEG and np.abs(readings).min() >= LEAST_DEG
        if not (is_enough and spread_deg <= SPREAD_DEG) or len(readings) < STEADY_S:
            self._guide(angles_deg, spread_deg, reads=not np.isnan(tilt.readings_deg).any())
            return
        self.tilts.append(Tilt(readings.mean(axis=0), forces.mean(axis=0)))
        self._say((*STEPS, "Tilt 2 is measured.")[len(self.tilts)])

    def _guide(self, angles_deg: Floats, spread_deg: float, *, reads: bool) -> None:
        """Say pitch and roll (2,), positive towards the wanted tilt, and what each still wants, if that has changed."""
        most_deg = MOST_DEG if reads else ENOUGH_DEG + 1

        def advice(by_deg: float) -> str:
            if ENOUGH_DEG <= by_deg <= most_deg:
                return "good"
            return f"{abs(min(ABOUT_DEG, most_deg) - by_deg):.0f} deg {'back' if by_deg > most_deg else 'more'}"

        pairs = zip(SIDES[len(self.tilts)], angles_deg.round() + 0.0, strict=True)
        words = "; ".join(f"{side} {angle:.0f} deg: {advice(angle)}" for side, angle in pairs)
        words += "." if reads else ". The gradienter gives no reading: over its range?"
        if spread_deg > SPREAD_DEG and words.count("good") == len(angles_deg):
            words += " It moves: hold it still."
        key = re.sub(r"[-\d]+", "", words)
        if key != self._key or np.abs(angles_deg - self._said_deg).max() > MOVED_DEG:
            self._key, self._said_deg = key, angles_deg
            self._say(f"  {words}")


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
