"""How an accelerometer's bias, measured in one attitude, moves with the attitude.

f = (I + S) (I - [m x]) g u + b (`align_model`): in one pose u, scale, shear and misalignment times 1 g look like a
bias. What a calibration finds is the *effective* bias at its attitude; g (S - [m x]) (u' - u) is by how much it is
another one at u'. A multi-pose alignment knows S and m; otherwise they are as large as its priors say (method
section 2.3: 0.5 % of scale make 5 mg).
"""

from __future__ import annotations

import dataclasses
from typing import Final, Literal

import numpy as np

from companion.calibration.alignment.align_model import Priors
from companion.calibration.alignment.align_record import Determined, ImuAlignmentRecord
from companion.calibration.solution.record import Effective
from companion.physics.frames import Array, Matrix, vector
from companion.physics.units import DEG, MG

LEVEL: Final = np.array([0.0, 0.0, -1.0])
WORTH_SAYING_M_S2: Final = 1.0 * MG
"""Below this nobody stands tilted enough for the effect to matter: what a wheel on a stone makes is not said."""
_SIGMAS: Final = 2.0
_PRIORS: Final = Priors()


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PoseEffect:
    """S - [m x] of one IMU: its mean and one sigma of each element, both (3, 3)."""

    mean: Matrix
    sigma: Matrix
    misalignment_mean: Matrix
    misalignment_sigma: Matrix
    source: Literal["assumed", "alignment"]

    def change(self, gravity_m_s2: float, at: Array, then: Array) -> tuple[Array, Array]:
        """By how much the bias at `at` is more than that at `then`, and one sigma of it; each (3,), m/s^2."""
        by = gravity_m_s2 * (at - then)
        mean = (self.mean + self.misalignment_mean) @ by
        variance = (np.square(self.sigma) + np.square(self.misalignment_sigma)) @ np.square(by)
        return mean, np.sqrt(variance)

    def effective(self, gravity_m_s2: float, up: Array, sigma_use_m_s2: Array) -> Effective:
        """What a record says of it, without misalignment, which turns the axes and is none of the sensor's bias.

        Args:
            gravity_m_s2: local.
            up: unit vector, the attitude of the calibration, (3,).
            sigma_use_m_s2: of the bias at this attitude, (3,).
        """
        # The mean is known but not taken off what is written, so that it counts in full.
        whole = np.sqrt(np.square(self.mean) + np.square(self.sigma))
        to_level = np.square(gravity_m_s2 * (LEVEL - up))
        own = np.square(whole) @ np.square(gravity_m_s2 * up)
        return Effective(
            scale_from=self.source,
            scale_sigma_m_s2=vector(gravity_m_s2 * np.diag(whole)),
            level_sigma_m_s2=vector(np.sqrt(np.square(sigma_use_m_s2) + np.square(whole) @ to_level)),
            sensor_sigma_m_s2=vector(np.sqrt(np.square(sigma_use_m_s2) + own)),
        )

    def warning(self, name: str, gravity_m_s2: float, up: Array, sigma_use_m_s2: Array) -> str | None:
        """What a pilot should know who has calibrated while it stood tilted; None while it stood about level."""
        whole = np.square(self.mean) + np.square(self.sigma)
        moves = np.sqrt(whole @ np.square(gravity_m_s2 * (LEVEL - up)))
        if not (moves > np.maximum(WORTH_SAYING_M_S2, _SIGMAS * sigma_use_m_s2)).any():
            return None
        return (
            f"accel {name}: effective at this attitude; level again it may be off by {moves.max() / MG:.1f} mg, since"
            " its scale error looks like a bias: calibrate level (companion align tilts tells the scale)"
        )


def pose_effect(aligned: ImuAlignmentRecord | None) -> PoseEffect:
    """What is known of one IMU's scale, shear and misalignment."""
    none: Determined | None = None
    scale, scale_sigma = _known(aligned.accel_scale if aligned else none, 1.0, _PRIORS.scale)
    shear, shear_sigma = _known(aligned.accel_shear if aligned else none, 1.0, _PRIORS.shear)
    turn, turn_sigma = _known(aligned.misalignment_deg if aligned else none, DEG, _PRIORS.misalignment_deg * DEG)
    return PoseEffect(
        mean=np.diag(scale) + _beside(shear),
        sigma=np.diag(scale_sigma) + _beside(shear_sigma),
        misalignment_mean=np.array([[0.0, turn[2], -turn[1]], [-turn[2], 0.0, turn[0]], [turn[1], -turn[0], 0.0]]),
        misalignment_sigma=_beside(turn_sigma[::-1]),
        source="alignment" if aligned is not None and any(aligned.accel_scale.known) else "assumed",
    )


def _known(found: Determined | None, unit: float, assumed: float) -> tuple[Array, Array]:
    if found is None:
        return np.zeros(3), np.full(3, assumed)
    known = np.array(found.known)
    return np.where(known, found.value, 0.0) * unit, np.where(known, np.array(found.sigma) * unit, assumed)


def _beside(values: Array) -> Matrix:
    """xy, xz, yz as a symmetric matrix."""
    xy, xz, yz = values
    return np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
