"""Level without a gradienter: an aircraft that is turned on one spot, and what its accelerometers read there.

The slope of the spot changes its sign in the aircraft when that is turned by half a turn, a bias does not. What comes
out is relative to the base that it is turned on: the *effective* bias of the level aircraft, the bias proper and how
the board sits in the aircraft in one. With the bias proper known from elsewhere (`faces`) the rest is how it sits.

How well it is told hangs on how well the spot is met again (`Priors.placement_deg`), and on a slope on how well it is
known how far the aircraft was turned: g sin(slope) / 2 for each radian of a half turn, 0.76 mg for each degree on
5 deg of slope. Quarter turns tell their angles themselves, for their readings lie on a circle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import LEVEL, Alignment, ImuAlignment, align
from companion.estimation.alignment.align_model import Ground, Priors, Stand
from companion.estimation.alignment.faces import (
    BIAS,
    FIGURES,
    PRIOR_BIAS_M_S2,
    PRIOR_SCALE,
    PRIOR_SHEAR,
    SCALE,
    Sides,
)
from companion.physics.frames import Array, Matrix, roll_pitch_from_up

ALONE: Final = Priors(scale=PRIOR_SCALE, shear=PRIOR_SHEAR, misalignment_deg=3.0, accel_bias_m_s2=PRIOR_BIAS_M_S2)
"""Of accelerometers that nobody has calibrated, on a board that was put in by eye."""


def turned(stands: Sequence[Stand], ground: Ground) -> Alignment:
    """What two or four headings on one spot tell, with no gradienter: level bias and slope, little else.

    Raises:
        CalibrationRefusedError: the readings cannot belong together.
    """
    try:
        return align("slope", np.eye(3), stands, ground, ALONE)
    except CalibrationRefusedError:
        raise CalibrationRefusedError("the readings do not belong together: is the orientation right?") from None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """How a level aircraft looks to a board whose accelerometers are corrected: what its attitude shows too much.

    Roll is right side down, pitch nose up; the covariance (2, 2) is of both.
    """

    roll_rad: float
    pitch_rad: float
    covariance_rad2: Matrix

    @property
    def sigma_rad(self) -> Array:
        """One sigma of roll and of pitch, (2,)."""
        return np.sqrt(np.diag(self.covariance_rad2))


def mounting(level: ImuAlignment, known: Sides, gravity_m_s2: float) -> Mounting:
    """How the board sits against the base, from its level bias and the bias and scale of its accelerometers.

    Shear is not taken off, for no firmware does; so the attitude that is corrected by this is right when level. Both
    are of the output as it comes.
    """
    vehicle_from_sensor = known.vehicle_from_sensor
    read = vehicle_from_sensor.T @ (level.level_bias_m_s2 + gravity_m_s2 * LEVEL)
    stretch = 1.0 + known.figures[SCALE]
    corrected = (read - known.figures[BIAS]) / stretch
    by = np.zeros((3, FIGURES))
    by[:, BIAS] = np.diag(-1.0 / stretch)
    by[:, SCALE] = np.diag(-corrected / stretch)
    turn = vehicle_from_sensor.T / stretch[:, None]
    inside = turn @ level.level_covariance_m2_s4 @ turn.T + by @ np.diag(np.square(known.sigma)) @ by.T
    up = vehicle_from_sensor @ corrected
    roll, pitch = roll_pitch_from_up(up)
    # A change d of the reading turns it by up x d / |up|^2, and by as much do roll and pitch, to first order in them.
    x, y, z = up / (up @ up)
    tilt = np.array([[0.0, z, -y], [-z, 0.0, x]]) @ vehicle_from_sensor
    return Mounting(roll, pitch, tilt @ inside @ tilt.T)
