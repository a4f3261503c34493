"""A heading out of a compass' field vector, with the gradienter's tilt; and its seconds, for a look at its quality.

The compass' own heading is used where it sends one, unless it is set to be worked out here. A field alone, without a
gradienter, gives none: nothing else at hand tells tilt well enough (tan I times its error, 2.5 times at 68 degrees).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.calibration.means.pose_models import CompassModel, GradienterModel, up_in_vehicle
from companion.calibration.means.pose_windows import FieldUnit, FieldWindow, field_window
from companion.calibration.seconds.batches import BatchSource
from companion.physics.frames import Array
from companion.physics.magnetic import heading_rad
from companion.physics.units import DEG
from companion.samples import CompassSample, MagSample, TiltSample

OLDEST_TILT_S: Final = 1.0
"""A tilt older than this is none; the slowest gradienters send five readings in that time."""
OWN_HEADING_S: Final = 2.0
"""After so long without a heading of its own a compass is taken for one that sends its field only."""
_LIMITS: Final = (1e6,) * 3


class FieldHeading:
    """Takes tilts and fields, gives headings of the compass' own forward axis from magnetic north."""

    def __init__(self, compass: CompassModel, gradienter: GradienterModel | None, keep: int) -> None:
        self._compass, self._gradienter = compass, gradienter
        self._keep = keep
        self._tilt: tuple[float, float, float] | None = None
        self._own_s: float | None = None
        self._begun_s: float | None = None
        self.unit: FieldUnit = "gauss"
        self.batches = BatchSource(_LIMITS, keep)
        self.from_field = False
        """Whether the latest heading that counts was worked out here."""
        self.hint = ""
        """Why there is none from the field although one is needed; empty while there is."""

    def take_tilt(self, sample: TiltSample) -> None:
        """Take a reading of the gradienter."""
        self._tilt = (sample.t_s, sample.x_deg, sample.y_deg)

    def takes_own(self, sample: CompassSample) -> bool:
        """Take a heading of the device's own; whether it is the one that counts."""
        if self._compass.prefers_field:
            return False
        self._own_s, self.from_field, self.hint = sample.t_s, False, ""
        return True

    def take(self, sample: MagSample) -> CompassSample | None:
        """Take a field; the heading that it gives, where that is the one that counts."""
        field = self._in_unit(sample)
        if field is None:
            return None
        self.batches.add(sample.t_s, (float(field[0]), float(field[1]), float(field[2])))
        if self._begun_s is None:
            self._begun_s = sample.t_s
        since_s = self._begun_s if self._own_s is None else self._own_s
        if not self._compass.prefers_field and abs(sample.t_s - since_s) < OWN_HEADING_S:
            return None
        up = self._up(sample.t_s)
        if up is None:
            return None
        try:
            heading = heading_rad(field, self._compass.vehicle_from_sensor.T @ up)
        except ValueError:
            self.hint = "compass field is vertical: no heading"
            return None
        self.from_field, self.hint = True, ""
        return CompassSample(sample.t_s, heading / DEG % 360.0)

    def window(self, slots: Sequence[int]) -> FieldWindow | None:
        """The mean field of these seconds; None where nothing came in them."""
        found = [self.batches.batches[slot] for slot in slots if slot in self.batches.batches]
        return field_window(found, self.unit) if found else None

    def _in_unit(self, sample: MagSample) -> Array | None:
        unit: FieldUnit = "gauss"
        if sample.field_gauss is not None:
            field = np.array(sample.field_gauss, dtype=np.float64)
        elif sample.counts is None:
            return None
        elif self._compass.counts_per_gauss is not None:
            field = np.array(sample.counts, dtype=np.float64) / self._compass.counts_per_gauss
        else:
            field, unit = np.array(sample.counts, dtype=np.float64), "counts"
        if not np.isfinite(field).all():
            return None
        if unit != self.unit:
            # Means over both would be neither.
            self.unit, self.batches = unit, BatchSource(_LIMITS, self._keep)
        return field

    def _up(self, t_s: float) -> Array | None:
        """Up in the vehicle's axes now; without one, `hint` says why."""
        if not self._compass.magnetic:
            self.hint = 'compass sends its field only, and that shows magnetic north, not reference = "true"'
        elif self._gradienter is None:
            self.hint = "compass sends its field only: a heading from it needs a gradienter"
        elif self._tilt is None or not abs(t_s - self._tilt[0]) <= OLDEST_TILT_S:
            self.hint = "compass sends its field only: no tilt from the gradienter to work out the heading"
        else:
            try:
                up = up_in_vehicle(self._gradienter, self._tilt[1], self._tilt[2])
                if np.isfinite(up).all():
                    return up
            except ValueError as error:
                self.hint = str(error)
        return None
