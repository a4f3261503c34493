"""Smoother: gyro biases and the mean direction of up, from minutes of data of an IMU that sways and turns.

The gyros, integrated from second to second, propagate the attitude. In the Earth's axes, the mean specific force is
gravity, because the effect of waves averages out (`waves`). If roll or pitch drifts against gravity, the horizontal
gyros have a bias; if the heading drifts against the compass, the vertical gyro has one. Near the true attitude the
readings are linear in the unknowns: weighted least squares is iterated. A Kalman smoother of constants gives the same.

Unknowns: attitude at the start (3), gyro bias (3), error of the accelerometers' bias (3), compass error (2). The
compass error, by iron on the aircraft, is a sine and a cosine of the heading. If significant, a ramp of the
gyro bias (3) is added. The Earth's rotation is subtracted later, once the latitude is known; `by_earth` is its effect.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.estimation.deck.waves import Waves, fit_waves, whitened
from companion.physics.frames import (
    Array,
    Floats,
    Matrix,
    body_from_ned,
    roll_pitch_from_up,
    rotations,
    running_products,
    skew,
)

EARTH_RATE_NORTH_RAD_S: Final = 5.2e-5
"""Assumed Earth's rate to the north, midway between latitudes 0 and 65 deg; an error of this rate acts linearly."""
RAMP_T: Final = 5.0
"""Threshold, in sigmas, for a ramp of the gyro bias; equal to the threshold at rest (`noise.lines`)."""
_ROUNDS: Final = 7
_NEAR: Final = 0.1  # Convergence limit: change of the biases in the last round, in sigmas
_START, _GYRO, _ACCEL, _COMPASS, _RAMP = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11), slice(11, 14)
_UNKNOWNS: Final = 14
_NO_RAMP: Final = 11


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Believed:
    """Prior values for the smoother, and the noise of the noisiest axis: white noise N and random walk K."""

    accel_m_s2: Array  # Accelerometer bias (3,), from the comparison with the gradienter
    accel_sigma_m_s2: float
    compass_sigma_rad: float  # Part of the compass' error that changes with the heading
    gyro_white: float  # N of the gyros, rad/s * sqrt(s): the largest of the axes
    gyro_walk: float  # K of a random walk that wanders as much as the bias in the window, rad/s / sqrt(s)
    gyro_slope: float
    """One sigma of the slope, rad/s^2, that flicker and random walk of the gyro bias cause without a ramp."""
    compass_lag_s: float
    accel_white: float  # N of the accelerometers, m/s^2 * sqrt(s)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of the smoother: means over the window and attitudes; rates (3,) in the body's axes (FRD).

    `gyro_rad_s`: bias at the end of the window, plus `by_earth` (3, 3) times the Earth's rate (NED). `body_to_ned`
    (n + 1, 3, 3): attitudes at the n + 1 ends of the seconds, relative to the compass' north. `heading_sigma_rad`:
    sigma of the heading at the end of the window, by noise alone.
    """

    gyro_rad_s: Array
    gyro_covariance: Matrix  # (3, 3) of `gyro_rad_s`
    by_earth: Matrix
    ramp_rad_s2: Array  # (3,) slope of the gyro bias; zero if not significant
    turn_rad_s: Array  # (3,) mean rate of the platform
    force_m_s2: float  # Mean specific force along the vertical, up
    force_sigma_m_s2: float
    body_to_ned: Floats
    heading_sigma_rad: float


class _Stretch:
    def __init__(self, passages: Sequence[IntegratedSecond]) -> None:
        columns = zip(*passages, strict=True)
        self.spans, self.turn, self.turned, self.velocity, self.by_bias, _ = map(np.array, columns)

    @property
    def ends(self) -> Floats:
        return np.concatenate([[0.0], np.cumsum(self.spans)])

    @property
    def rate(self) -> Array:
        """Mean gyro rate (3,) over the window, bias included; swaying averages out."""
        whole = self.turn.sum(axis=0)
        turned = np.array([whole[2, 1] - whole[1, 2], whole[0, 2] - whole[2, 0], whole[1, 0] - whole[0, 1]]) / 2.0
        return np.asarray(turned / self.spans.sum())

    def attitudes(self, start: Matrix, bias: Array) -> Floats:
        steps = rotations(-(self.turned @ bias)) @ self.turn
        earth = rotations(-np.outer(self.ends, [EARTH_RATE_NORTH_RAD_S, 0.0, 0.0]))
        return np.asarray(earth @ running_products(np.concatenate([start[None], steps])))

    def forces(self, attitudes: Floats, gyro: Array, accel: Array) -> Floats:
        """Return the mean specific force (n, 3) of every second, in NED axes."""
        # Second-order effect of the bias on gravity: 0.6 mg at 3 deg/s.
        bent = np.cross(gyro, np.cross(gyro, self.velocity)) * np.square(self.spans[:, None]) / 6.0
        felt = self.velocity + self.by_bias @ gyro + bent - self.turned @ accel
        return np.asarray(np.einsum("nij,nj->ni", attitudes[:-1], felt) / self.spans[:, None])


def smooth(
    passages: Sequence[IntegratedSecond], headings_rad: Floats, compass_forward: Array, believed: Believed
) -> Found:
    """Estimate biases and attitudes from the integrated motion of at least ten consecutive seconds without a gap.

    `headings_rad` (n,): compass heading in the middle of each second, NaN if missing. `compass_forward` (3,): forward
    axis of the compass in the vehicle's axes.
    """
    stretch = _Stretch(passages)
    known = headings_rad[np.isfinite(headings_rad)]
    up = stretch.velocity[: len(passages) // 4 + 1].sum(axis=0)
    start = body_from_ned(*roll_pitch_from_up(up), float(known[0]) if len(known) else 0.0).T
    bias, ramp = _coarse_bias(stretch, start, headings_rad), np.zeros(3)
    noise: tuple[Waves, Waves] | None = None
    for _ in range(_ROUNDS):
        attitudes = stretch.attitudes(start, bias)
        forces = stretch.forces(attitudes, bias, believed.accel_m_s2)
        system = _System(stretch, attitudes, forces, (headings_rad, compass_forward), believed.compass_lag_s)
        values, covariance, by_earth = system.solve(noise, believed, _NO_RAMP)
        noise = system.noise(values)
        start = rotations(values[_START]) @ start
        bias = bias + values[_GYRO]
        if (np.square(values[_GYRO]) < _NEAR**2 * np.diag(covariance)[_GYRO]).all():
            break
    assert noise is not None
    ramping = system.solve(noise, believed, _UNKNOWNS)
    chance = np.sqrt(np.diag(ramping[1])[_RAMP] + believed.gyro_slope**2)
    if (np.abs(ramping[0][_RAMP]) > RAMP_T * chance).any():
        values, covariance, by_earth = system.solve(system.noise(ramping[0]), believed, _UNKNOWNS)
        bias, ramp = bias + values[_GYRO], values[_RAMP]
    force, force_sigma = _mean_up(-forces[:, 2], stretch.spans, believed.accel_white)
    # Add back the assumed Earth rate: `by_earth` is the effect of the whole rate.
    bias = bias + by_earth[_GYRO] @ np.array([EARTH_RATE_NORTH_RAD_S, 0.0, 0.0])
    return Found(
        gyro_rad_s=bias,
        gyro_covariance=covariance[_GYRO, _GYRO],
        by_earth=by_earth[_GYRO],
        ramp_rad_s2=ramp,
        turn_rad_s=stretch.rate - bias,
        force_m_s2=force,
        force_sigma_m_s2=force_sigma,
        body_to_ned=attitudes,
        heading_sigma_rad=math.sqrt(noise[1].variance / max(len(known), 1)),
    )


def _coarse_bias(stretch: _Stretch, start: Matrix, headings_rad: Floats) -> Array:
    """Return a coarse gyro bias (3,), close enough to the true one to linearise.

    Swaying averages out, and the compass shows the turn. A firmware's calibration on a boat may leave several deg/s.
    """
    known = np.isfinite(headings_rad)
    if known.sum() < 2:
        return stretch.rate
    turn = np.polyfit(stretch.ends[1:][known], np.unwrap(headings_rad[known]), 1)[0]
    return np.asarray(stretch.rate - turn * start[2])


class _System:
    """Linear equations of the smoother: regressors (3, n, unknowns + 3) and readings (3, n), rad, of n seconds.

    The three channels are the force to the north and to the east, over g, and the heading. The last three regressors
    belong to the Earth's rate.
    """

    def __init__(
        self, stretch: _Stretch, attitudes: Floats, forces: Floats, compass: tuple[Floats, Array], lag_s: float
    ) -> None:
        headings_rad, forward = compass
        up = -float(forces[:, 2].mean())
        turned = attitudes[:-1] @ stretch.turned
        ends = stretch.ends
        middle = (ends[1:] + ends[:-1]) / 2.0
        drift = np.cumsum(turned, axis=0) - turned / 2.0
        steps = turned * (middle - ends[-1])[:, None, None]
        ramping = np.cumsum(steps, axis=0) - steps / 2.0
        pointing = attitudes @ forward
        at_knots = np.unwrap(np.arctan2(pointing[:, 1], pointing[:, 0]))
        azimuth = np.interp(middle - lag_s, ends, at_knots)
        columns = np.zeros((3, len(middle), _UNKNOWNS + 3))
        # psi turns the attitude in NED: force = F + psi x F, so north sees psi_east, and east minus psi_north.
        for channel, axis, sign in ((0, 1, 1.0), (1, 0, -1.0), (2, 2, 1.0)):
            columns[channel, :, axis] = sign
            columns[channel, :, _GYRO] = -sign * drift[:, axis]
            columns[channel, :, _RAMP] = -sign * ramping[:, axis]
            columns[channel, :, _UNKNOWNS + axis] = -sign * middle
        columns[:2, :, _ACCEL] = (turned[:, :2] / stretch.spans[:, None, None] / up).transpose(1, 0, 2)
        columns[2, :, _COMPASS] = np.column_stack([np.sin(azimuth), np.cos(azimuth)])
        off = np.remainder(headings_rad - azimuth + math.pi, 2.0 * math.pi) - math.pi
        self.columns, self.readings = columns, np.array([forces[:, 0] / up, forces[:, 1] / up, off])
        self.step_s = float(stretch.spans.mean())

    def solve(
        self, noise: tuple[Waves, Waves] | None, believed: Believed, unknowns: int
    ) -> tuple[Array, Matrix, Matrix]:
        """Solve weighted least squares; return values, covariance, effect of Earth's rate. `noise` None: guessed."""
        wander = believed.gyro_white**2 * self.step_s, believed.gyro_walk**2 * self.step_s**3
        level, heading = noise or (Waves(np.zeros(0), 0.02**2), Waves(np.zeros(0), 0.01**2))
        # (3, n, unknowns + 4): the readings are the last column.
        pairs = np.concatenate([self.columns, self.readings[..., None]], axis=2)
        both = whitened(np.hstack([pairs[0], pairs[1]]), level, wander)
        rows = np.vstack([*np.hsplit(both, 2), whitened(pairs[2], heading, wander)])
        rows = rows[~np.isnan(rows[:, -1])]
        regressors, earth = rows[:, :unknowns], rows[:, _UNKNOWNS:-1]
        information = regressors.T @ regressors
        diagonal = np.diag_indices(unknowns)
        priors = np.zeros(_UNKNOWNS)
        priors[_ACCEL] = believed.accel_sigma_m_s2**-2
        priors[_COMPASS] = max(believed.compass_sigma_rad, 1e-6) ** -2
        information[diagonal] += priors[:unknowns]
        # Units range from rad/s^2 to rad: scale them to keep precision.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
        covariance = np.linalg.inv(information * np.outer(scale, scale) + 1e-12 * np.eye(unknowns)) * np.outer(
            scale, scale
        )
        # The wave model's terms are fitted too: widen the covariance by the degrees of freedom they use.
        spent = unknowns + len(level.terms) + len(heading.terms)
        covariance_found = covariance * (len(rows) / max(len(rows) - spent, len(rows) / 4.0))
        values = np.zeros(_UNKNOWNS)
        values[:unknowns] = covariance @ (regressors.T @ rows[:, -1])
        return values, covariance_found, covariance @ (regressors.T @ earth)

    def noise(self, values: Array) -> tuple[Waves, Waves]:
        left = self.readings - self.columns[..., :_UNKNOWNS] @ values
        heading = left[2][np.isfinite(left[2])]
        if len(heading) == 0:
            heading = np.zeros(1)
        return fit_waves([one - one.mean() for one in left[:2]]), fit_waves([heading - heading.mean()])


def _mean_up(up: Floats, spans: Floats, white: float) -> tuple[float, float]:
    """Return the mean of the vertical specific force on waves, and its sigma.

    The height of the waves is modelled as a stationary series. A stationary acceleration would have power at zero
    frequency, which no sea has. The mean force is the curvature of a parabola fitted to the height.
    """
    step, ends = float(spans.mean()), np.cumsum(spans) - spans.sum()
    height = np.cumsum(np.cumsum(up * spans)) * step
    line = np.column_stack([np.ones(len(ends)), ends, ends * ends / 2.0])
    left = height - line @ np.linalg.lstsq(line, height, rcond=None)[0]
    rows = whitened(np.column_stack([line, height]), fit_waves([left]), (0.0, white**2 * step**3))
    covariance = np.linalg.inv(rows[:, :3].T @ rows[:, :3])
    return float(covariance[2] @ (rows[:, :3].T @ rows[:, 3])), math.sqrt(covariance[2, 2])


class IntegratedSecond(NamedTuple):
    """Integrated motion of an IMU over one second. The "start axes" are the body's axes (FRD) at its beginning.

    `turn` (3, 3): rotation from the body's axes at the end to the start axes, by the gyros. `turned` (3, 3): integral
    of `turn` over time, s; a gyro bias b rotates the start axes by -turned @ b. `velocity_m_s` (3,): integral of the
    specific force in the start axes. `velocity_by_bias` (3, 3): derivative of that velocity by the gyro bias, m/s per
    rad/s. `white2`: N^2 of the gyros, mean of the axes, from second differences of neighbouring samples.
    """

    span_s: float
    turn: Matrix
    turned: Matrix
    velocity_m_s: Floats
    velocity_by_bias: Matrix
    white2: float


def passage(times_s: Floats, rates_rad_s: Floats, forces_m_s2: Floats) -> IntegratedSecond:
    """Integrate n + 1 samples of one second by trapezoids; the first sample is the last one of the second before.

    Times (n + 1,) ascend, n is at least 1; rates and forces are (n + 1, 3) in the body's axes. Rates are integrated as
    rotations, so that the result includes coning and sculling (Forster, Carlone, Dellaert, Scaramuzza, IEEE Trans.
    Robotics 33(1), 2017, section VI).
    """
    steps = np.diff(times_s)
    rates = (rates_rad_s[1:] + rates_rad_s[:-1]) / 2.0
    turns = running_products(rotations(rates * steps[:, None]))
    whole = np.concatenate([np.eye(3)[None], turns])
    half = (whole[1:] + whole[:-1]) / 2.0 * steps[:, None, None]
    turned = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(half, axis=0)])
    felt = np.einsum("nij,nj->ni", whole, forces_m_s2)
    by_bias = skew(felt) @ turned
    bends = np.diff(rates_rad_s, 2, axis=0)
    return IntegratedSecond(
        span_s=float(times_s[-1] - times_s[0]),
        turn=turns[-1],
        turned=turned[-1],
        velocity_m_s=((felt[1:] + felt[:-1]) / 2.0 * steps[:, None]).sum(axis=0),
        velocity_by_bias=((by_bias[1:] + by_bias[:-1]) / 2.0 * steps[:, None, None]).sum(axis=0),
        white2=float(np.square(bends).mean()) / 6.0 * float(np.median(steps)) if len(bends) else 0.0,
    )
