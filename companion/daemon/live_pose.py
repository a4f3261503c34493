"""How the aircraft stands at this moment, from the newest reading of gradienter and compass: something to look at.

A calibration averages over a still stretch instead; this follows every movement, and knows nothing of stillness.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Final

import numpy as np

from companion.calibration.solve import heading_of, up_of
from companion.config import Config
from companion.daemon import models
from companion.physics.frames import roll_pitch_from_up
from companion.physics.units import DEG
from companion.samples import CompassSample, TiltSample

FRESH_S: Final = 2.0
"""So long a reading counts as "now"."""
_LEVEL: Final = np.array([0.0, 0.0, -1.0])


class LivePose:
    """Takes readings, gives angles in degrees; None where nothing fresh is known."""

    def __init__(self, config: Config) -> None:
        self._gradienter = models.gradienter_model(config.gradienter)
        self._compass = models.compass_model(config.compass)
        self._tilt: TiltSample | None = None
        self._heading: CompassSample | None = None

    def add(self, sample: TiltSample | CompassSample) -> None:
        """Take one reading."""
        if isinstance(sample, TiltSample):
            self._tilt = sample
        else:
            self._heading = sample

    def now(self, declination_deg: float | None) -> dict[str, object]:
        """Pitch (nose up +), roll (right side down +) and heading.

        `heading_is` is "true", or "magnetic" while the declination of the place is not known, or None.
        """
        now_s = asyncio.get_running_loop().time()
        pose: dict[str, object] = {"pitch_deg": None, "roll_deg": None, "heading_deg": None, "heading_is": None}
        tilt, heading, up = self._tilt, self._heading, _LEVEL
        if self._gradienter is not None and tilt is not None and now_s - tilt.t_s <= FRESH_S:
            with contextlib.suppress(ValueError):
                up = up_of(tilt.x_deg, tilt.y_deg, self._gradienter)
                roll_rad, pitch_rad = roll_pitch_from_up(up)
                pose |= {"pitch_deg": round(pitch_rad / DEG, 2), "roll_deg": round(roll_rad / DEG, 2)}
        if self._compass is not None and heading is not None and now_s - heading.t_s <= FRESH_S:
            known = not self._compass.magnetic or declination_deg is not None
            heading_rad = heading_of(heading.heading_deg, self._compass, up, declination_deg or 0.0)
            pose |= {
                "heading_deg": round(heading_rad / DEG % 360.0, 1) % 360.0,
                "heading_is": "true" if known else "magnetic",
            }
        return pose
