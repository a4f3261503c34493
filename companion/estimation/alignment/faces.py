"""Bias, scale and shear of three accelerometers from the length of gravity, in poses of any orientation.

Only the strength g of gravity must be known: in any orientation, the corrected reading is a vector of length g
(Tedaldi, Pretto and Menegatti, ICRA 2014; Skog and Haendel, 2006). With u the unit vector up, in the sensor's axes,

    f = (I + S) g u + b           S symmetric: scale on its diagonal, shear beside it

so that |(I + S)^-1 (f - b)| = g in every pose. A common rotation of the axes does not change the length; `mounting`
finds that rotation from a turn at one place. Unlike the triangular matrix of Tedaldi et al., the symmetric S prefers no
axis. The diagonal of S is the scale that a firmware without shear correction uses.

Each pose is weighted by the noise of its mean, and gravity by its uncertainty at the place. Every value therefore has a
sigma from the first pose on. A pose that does not fit is found by leaving out one pose after another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import ImuAlignment, widened_by
from companion.estimation.alignment.align_model import LEVEL, PRIOR_BIAS_M_S2, PRIOR_SCALE, PRIOR_SHEAR, fit, response
from companion.estimation.alignment.poses import PoseRequest
from companion.physics.frames import Array, Floats, Matrix, roll_pitch_from_up, vector
from companion.physics.units import MG

FIGURES: Final = 9
BIAS: Final = slice(0, 3)
SCALE: Final = slice(3, 6)
SHEAR: Final = slice(6, 9)
W_LIMIT: Final = 3.9
"""Threshold for the normalised residual of one pose (Baarda's |w|): chance exceeds it once in ten thousand."""
LEAST_SPARE: Final = 2
"""Least number of poses beyond the number of unknowns (nine) that identifies a wrong pose."""
_LEAST_REDUNDANCY: Final = 1e-3

ENOUGH_BIAS_M_S2: Final = 0.15 * MG
ENOUGH_SCALE: Final = 2e-4
ENOUGH_WANDER: Final = 0.8
"""Bias sigma that is good enough, over sigma of the bias' own change: a dozen more poses do not help a bad sensor."""
SAME_DEG: Final = 20.0
"""Angle between two poses below which the second pose adds hardly any information."""
FACE_DEG: Final = 30.0  # A pose within this angle of a side counts as a measurement of that side
_STAND_SIGMA_M_S2: Final = 0.03 * MG  # Predicted sigma of the mean of the next pose
_AXES: Final = "xyz"
SIDES: Final = {
    "level": (0, 0, -1),
    "on its back": (0, 0, 1),
    "nose up": (1, 0, 0),
    "nose down": (-1, 0, 0),
    "left side down": (0, 1, 0),
    "right side down": (0, -1, 0),
}
"""Unit vector pointing up, in the aircraft's axes (forward, right, down), for each of the six positions."""


Face = tuple[Array, Array]
"""Mean specific force during one pose, in the sensor's axes, and one sigma per axis; m/s^2, each (3,)."""
_Fit = tuple[Array, Matrix, float, bool]
"""Nine figures (9,), their covariance (9, 9), chi-square, and true if every pose fits."""


class Sides(msgspec.Struct, frozen=True):
    """Errors of one IMU's accelerometers from six positions, with the autopilot's active offsets and scales applied.

    Each of the nine values has one sigma. Time and temperature since the measurement widen the sigmas of the biases.
    """

    figures: Array  # (9,), as in `FacesEstimate`, in the sensor's axes: biases in m/s^2, scale and shear without unit
    sigma: Array
    vehicle_from_sensor: Matrix


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FacesEstimate:
    """Estimate from all poses: nine figures (9,), namely bias x y z, scale x y z, shear xy xz yz.

    `by_stands` (9, 9): covariance of the figures at the time of the poses. `wander_m_s2` (3,): one sigma of the biases'
    change until they are used. `up` (poses, 3): corrected unit vector up in the sensor's axes. `off_m_s2` (poses,):
    length of each corrected reading minus gravity. `left_out`: numbers, from 0, of poses that do not fit the others.
    `in_doubt`: numbers of further poses, one of which does not fit; the next measured pose will show which one.
    """

    figures: Array
    by_stands: Matrix
    wander_m_s2: Array
    gravity_m_s2: float
    gravity_sigma_m_s2: float
    up: Matrix
    left_out: tuple[int, ...]
    off_m_s2: Array
    in_doubt: tuple[int, ...]

    @property
    def covariance(self) -> Matrix:
        """Covariance (9, 9) of the figures when they are used, with the wander of the biases until then."""
        both = self.by_stands.copy()
        both[BIAS, BIAS] += np.diag(self.wander_m_s2**2)
        return both

    @property
    def sigma(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    @property
    def least_poses(self) -> int:
        return FIGURES + LEAST_SPARE + len(self.left_out)


def faces(
    stands: Sequence[Face], gravity_m_s2: float, gravity_sigma_m_s2: float, wander_m_s2: Array | None = None
) -> FacesEstimate:
    """Estimate bias, scale and shear from at least one pose; a value that is not determined keeps its prior sigma.

    `wander_m_s2` (3,): one sigma of the biases' change until they are used; None: zero.

    Raises:
        CalibrationRefusedError: no accelerometer can give these readings.
    """
    everyone = tuple(range(len(stands)))
    gravity = (gravity_m_s2, gravity_sigma_m_s2)
    figures, covariance, _, fits = _fit(stands, everyone, gravity)
    left_out: tuple[int, ...] = ()
    in_doubt: tuple[int, ...] = ()
    while not fits:
        kept = tuple(k for k in everyone if k not in left_out)
        if 4 * (len(left_out) + 1) > len(stands):
            in_doubt = kept
            break
        without = dict(_fits_without_one(stands, kept, gravity))
        mended = [k for k in without if without[k][3]]
        if not without or len(mended) > 1 or len(kept) - FIGURES < LEAST_SPARE:
            in_doubt = tuple(mended) or kept
            break
        worst = mended[0] if mended else min(without, key=lambda k: without[k][2])
        left_out = (*left_out, worst)
        figures, covariance, _, fits = without[worst]
    stretch = response(figures[SCALE], figures[SHEAR])
    inside = np.linalg.solve(stretch, np.array([mean - figures[BIAS] for mean, _ in stands]).T).T
    lengths = np.linalg.norm(inside, axis=1)
    return FacesEstimate(
        figures=figures,
        by_stands=covariance,
        wander_m_s2=np.zeros(3) if wander_m_s2 is None else wander_m_s2,
        gravity_m_s2=gravity_m_s2,
        gravity_sigma_m_s2=gravity_sigma_m_s2,
        up=inside / lengths[:, None],
        left_out=tuple(sorted(left_out)),
        off_m_s2=lengths - gravity_m_s2,
        in_doubt=in_doubt,
    )


def _fits_without_one(
    stands: Sequence[Face], kept: Sequence[int], gravity: tuple[float, float]
) -> Iterator[tuple[int, _Fit]]:
    """Yield each pose that can be left out, with the fit of the others."""
    for k in kept:
        with contextlib.suppress(CalibrationRefusedError):
            yield k, _fit(stands, tuple(j for j in kept if j != k), gravity)


def _fit(stands: Sequence[Face], which: Sequence[int], gravity: tuple[float, float]) -> _Fit:
    force, sigmas = (np.array([stands[k][part] for k in which]) for part in (0, 1))
    prior = np.append(np.repeat([PRIOR_BIAS_M_S2, PRIOR_SCALE, PRIOR_SHEAR], 3), max(gravity[1], 1e-9))

    def residuals(at: Floats) -> Floats:
        inverse = np.linalg.inv(response(at[:, SCALE], at[:, SHEAR]))
        inside = (force - at[:, None, BIAS]) @ inverse
        lengths = np.linalg.norm(inside, axis=-1)
        across = inside / lengths[..., None] @ inverse  # Derivative of each length by its reading
        sigma = np.sqrt(np.einsum("mki,ki->mk", across**2, sigmas**2))
        return np.asarray((lengths - gravity[0] - at[:, FIGURES:]) / sigma)

    try:
        found = fit(residuals, np.zeros(FIGURES + 1), prior)
    except (ValueError, np.linalg.LinAlgError):
        found = None
    if found is None or np.abs(found.values[SCALE]).max() > 0.5:
        raise CalibrationRefusedError("the accelerometers' readings are no gravity: is every stand still?")
    count = len(which)
    residual, freedom = found.residual[:count], count - FIGURES
    chi_square = float(residual @ residual)
    w = residual / np.sqrt(np.maximum(found.redundancy[:count], _LEAST_REDUNDANCY))
    # Compare each pose with the scatter of the others if that exceeds their sigmas.
    others = np.maximum((chi_square - w**2) / (freedom - 1), 1.0) if freedom > 1 else np.ones(count)
    covariance = widened_by(chi_square, freedom) * found.covariance[:FIGURES, :FIGURES]
    return found.values[:FIGURES], covariance, chi_square, bool((np.abs(w) <= W_LIMIT * np.sqrt(others)).all())


def missing(found: FacesEstimate, vehicle_from_sensor: Matrix) -> PoseRequest | None:
    """Return the next pose to ask for; None once bias and scale of all axes are precise enough and checked.

    `vehicle_from_sensor` (3, 3): mounting of the accelerometers that `found` describes.
    """
    wander, gravity = ENOUGH_WANDER * found.wander_m_s2, found.gravity_m_s2
    # Poses cannot show an error of the local gravity: the scale keeps that uncertainty.
    scale = np.hypot(np.maximum(ENOUGH_SCALE, wander / gravity), found.gravity_sigma_m_s2 / gravity)
    sigma = np.sqrt(np.diag(found.by_stands))[: SCALE.stop]
    share = sigma / np.concatenate([np.maximum(ENOUGH_BIAS_M_S2, wander), scale])
    weight = np.where(share > 1.0, share, 0.0)
    if not weight.any():
        if len(found.up) >= found.least_poses and not found.in_doubt:
            return None
        weight = np.ones(SCALE.stop)
    # Once all sides were seen, ask again for the most informative one.
    sides = _not_seen(found, vehicle_from_sensor) or _all_sides(vehicle_from_sensor)
    side, up = sides[int(np.argmax([_told(found, up)[: SCALE.stop] @ weight for _, up in sides]))]
    lacks = "one pose does not fit" if found.in_doubt else _figure(sigma, int(np.argmax(share)))
    words = f"{side}: one pose does not fit, this one shows which" if found.in_doubt else side
    return PoseRequest(words, vector(vehicle_from_sensor @ up), lacks=lacks)


def seen_before(found: FacesEstimate, up: Array, vehicle_from_sensor: Matrix) -> int | None:
    """Return the index of an earlier measurement of this pose; None for a new pose, or if all sides were measured.

    `up` (3,): unit vector pointing up in the sensor's axes. `found`: estimate from the earlier poses.
    """
    if not _not_seen(found, vehicle_from_sensor):
        return None
    near = found.up @ up
    near[list(found.left_out)] = -1.0
    nearest = int(np.argmax(near))
    return nearest if near[nearest] > np.cos(np.radians(SAME_DEG)) else None


def _not_seen(found: FacesEstimate, vehicle_from_sensor: Matrix) -> list[tuple[str, Array]]:
    kept = np.delete(found.up, found.left_out, axis=0)
    sides = _all_sides(vehicle_from_sensor)
    new = [(name, up) for name, up in sides if (kept @ up).max() < np.cos(np.radians(FACE_DEG))]
    return [(name, up) for name, up in new if name in SIDES] or new


def _all_sides(vehicle_from_sensor: Matrix) -> list[tuple[str, Array]]:
    faces = {name: np.array(up, dtype=np.float64) for name, up in SIDES.items()}
    pairs = [pair for pair in itertools.combinations(faces, 2) if not faces[pair[0]] @ faces[pair[1]]]
    edges = {_edge(a, b): (faces[a] + faces[b]) / np.sqrt(2.0) for a, b in pairs}
    return [(name, vehicle_from_sensor.T @ up) for name, up in {**faces, **edges}.items()]


def _edge(a: str, b: str) -> str:
    side, (part, _, way) = (b, a.rpartition(" ")) if a.startswith("nose") else (a, b.rpartition(" "))
    return f"{part} half {way}" if side == "level" else f"{side} with {part} half {way}"


def _told(found: FacesEstimate, up: Array) -> Array:
    by = np.concatenate([up, found.gravity_m_s2 * up**2, found.gravity_m_s2 * 2.0 * up[[0, 0, 1]] * up[[1, 2, 2]]])
    gain = found.by_stands @ by
    return np.asarray(gain**2 / (by @ gain + _STAND_SIGMA_M_S2**2) / np.diag(found.by_stands))


def _figure(sigma: Array, which: int) -> str:
    if which < SCALE.start:
        return f"{_AXES[which]} bias uncertain by {_two_digits(sigma[which] / MG)} mg"
    return f"{_AXES[which - SCALE.start]} scale uncertain by {_two_digits(100.0 * sigma[which])} %"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Tilt of the board against the aircraft's base: attitude by the corrected accelerometers while the base is level.

    Roll is positive right side down, pitch nose up. `sigma_rad` (2,): one sigma of roll and pitch.
    """

    roll_rad: float
    pitch_rad: float
    sigma_rad: Array


def mounting(level: ImuAlignment, known: Sides, gravity_m_s2: float) -> Mounting:
    """Return the board's tilt from the bias of the level aircraft, minus the accelerometers' own bias and scale errors.

    Shear is not removed, because no firmware corrects it. An attitude corrected by this tilt is exact on a level base.
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
    # A change d of the reading turns up by up x d / |up|^2, and so do roll and pitch, to first order.
    x, y, z = up / (up @ up)
    tilt = np.array([[0.0, z, -y], [-z, 0.0, x]]) @ vehicle_from_sensor
    return Mounting(roll, pitch, np.sqrt(np.diag(tilt @ inside @ tilt.T)))
