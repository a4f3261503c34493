"""A MEMS IMU with a wandering bias, whose true value can be read at any time.

Noise terms and figures are those of method 2.2: white noise N (unit * sqrt(s), two-sided PSD N^2), flicker B (PSD
B^2 / (2 pi f), Allan floor 0.664 B), rate random walk K. The slow part (flicker and walk) is one path in time, the same
for every reader and every sampling rate; only white noise and rounding belong to a reading.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sim.aircraft import Truth, VirtualAircraft
from sim.earth import STANDARD_GRAVITY_M_S2, Array, mounting_matrix
from sim.thermal import Curve, Piece

DEG_H = math.radians(1.0) / 3600.0
"""One deg/h in rad/s."""
MG = STANDARD_GRAVITY_M_S2 * 1e-3
"""One mg in m/s^2."""
UG = STANDARD_GRAVITY_M_S2 * 1e-6

SLOW_STEP_S = 0.1
"""Time step of the slow path. Faster flicker is far below the white noise of every part listed here."""
_BLOCK = 512
_KEPT_BLOCKS = 400
"""Number of stored blocks, about 5.7 hours of slow path; a read of older times raises an error."""
_TAU_RATIO = 3.0
_TAUS_S = 0.3 * _TAU_RATIO ** np.arange(11.0)
"""Time constants of the Gauss-Markov processes whose sum is the flicker: 0.3 s to 5 hours."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisNoise:
    """Noise figures of one triad in SI units: rad/s for gyros, m/s^2 for accelerometers."""

    white: float
    """White noise N, unit * sqrt(s)."""
    flicker: float = 0.0
    """Flicker noise B, unit; the Allan floor is 0.664 B."""
    walk: float = 0.0
    """Random walk K, unit / sqrt(s)."""
    per_kelvin: float = 0.0
    """Bias per kelvin of difference to the reference temperature; when a piece is drawn, the sigma of that slope."""
    scatter: float = 0.0
    """Sigma of the bias from power-up to power-up, at constant temperature."""
    step: float = 0.0
    """Quantisation step of the output; 0: floats."""
    limit: float = math.inf
    """Saturation limit of the output."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSpec:
    name: str
    gyro: AxisNoise
    accel: AxisNoise
    reference_degc: float = 25.0

    def piece(self, random: np.random.Generator, usual: Array) -> Piece:
        """Draw one piece of this part, with these usual biases (6,) and its own temperature curve."""
        scatter = np.repeat([self.gyro.scatter, self.accel.scatter], 3)
        return Piece.drawn(random, usual, scatter, np.repeat([self.gyro.per_kelvin, self.accel.per_kelvin], 3))


def _triad(
    *,
    white: float,
    floor: float,
    per_kelvin: float,
    scatter: float,
    step: float,
    limit: float,
    walk: float | None = None,
) -> AxisNoise:
    """Return figures for an Allan floor; without K, the walk reaches the floor at 1000 s (as the method assumes)."""
    return AxisNoise(
        white=white,
        flicker=floor / 0.664,
        walk=floor * math.sqrt(3.0 / 1000.0) if walk is None else walk,
        per_kelvin=per_kelvin,
        scatter=scatter,
        step=step,
        limit=limit,
    )


_DPS = math.radians(1.0)
_G = STANDARD_GRAVITY_M_S2

# Noise and floors: method 2.2. Steps and ranges are the parts' usual digital formats; temperature figures of
# the two Analog Devices parts, which are compensated inside, are assumptions. The ADIS16405's accelerometer is that of
# three sessions of 2.8 h at rest, tilt and temperature of the bench included.
# Scatter: method 1.3 for the ADIS16405, the others' is assumed.
# VN-100: VectorNav's data sheet (0.0035 deg/s/rtHz, 5 to 7 deg/h, 0.14 mg/rtHz, 0.04 mg); its temperature is assumed.
PARTS: dict[str, ImuSpec] = {
    "icm42688p": ImuSpec(
        name="icm42688p",
        gyro=_triad(white=7.1 * DEG_H, floor=3 * DEG_H, per_kelvin=18 * DEG_H, scatter=30 * DEG_H,
            step=_DPS / 262.4, limit=2000 * _DPS),
        accel=_triad(white=49.5 * UG, floor=10 * UG, per_kelvin=0.15 * MG, scatter=0.5 * MG,
            step=_G / 32768, limit=16 * _G),
    ),
    "bmi088": ImuSpec(
        name="bmi088",
        gyro=_triad(white=35.6 * DEG_H, floor=2 * DEG_H, per_kelvin=54 * DEG_H, scatter=60 * DEG_H,
            step=_DPS / 16.384, limit=2000 * _DPS),
        accel=_triad(white=124 * UG, floor=20 * UG, per_kelvin=0.2 * MG, scatter=1.0 * MG,
            step=24 * _G / 32768, limit=24 * _G),
    ),
    "adis16470": ImuSpec(
        name="adis16470",
        gyro=_triad(white=20.4 * DEG_H, floor=8 * DEG_H, per_kelvin=4 * DEG_H, scatter=15 * DEG_H,
            step=0.0, limit=2000 * _DPS),
        accel=_triad(white=63 * UG, floor=13 * UG, per_kelvin=0.02 * MG, scatter=0.3 * MG,
            step=0.0, limit=40 * _G),
    ),
    "adis16405": ImuSpec(
        name="adis16405",
        gyro=_triad(white=120 * DEG_H, floor=25 * DEG_H, per_kelvin=36 * DEG_H, scatter=70 * DEG_H,
            step=0.05 * _DPS, limit=300 * _DPS),
        accel=_triad(white=650 * UG, floor=260 * UG, per_kelvin=0.3 * MG, scatter=1.6 * MG,
            step=3.33 * MG, limit=18 * _G, walk=55 * UG),
    ),
    "vn100": ImuSpec(
        name="vn100",
        gyro=_triad(white=8.9 * DEG_H, floor=5 * DEG_H, per_kelvin=9 * DEG_H, scatter=15 * DEG_H,
            step=0.0, limit=2000 * _DPS),
        accel=_triad(white=99 * UG, floor=40 * UG, per_kelvin=0.05 * MG, scatter=0.3 * MG,
            step=0.0, limit=16 * _G),
    ),
    "white_only": ImuSpec(
        name="white_only", gyro=AxisNoise(white=7.1 * DEG_H), accel=AxisNoise(white=49.5 * UG)
    ),
    "perfect": ImuSpec(name="perfect", gyro=AxisNoise(white=0.0), accel=AxisNoise(white=0.0)),
}  # fmt: skip


class Bias(NamedTuple):
    """Gyro bias in rad/s and accelerometer bias in m/s^2, arrays of shape (3,)."""

    gyro_rad_s: Array
    accel_m_s2: Array


class _SlowPath:
    """Flicker plus rate random walk of six axes on a fixed time grid, zero at time 0, extended on demand.

    The flicker is a sum of stationary first-order Gauss-Markov processes with time constants in the ratio r, each of
    variance B^2 ln(r) / pi: their spectra add up to B^2 / (2 pi f) between the slowest and the fastest.
    """

    def __init__(self, flicker: Array, walk: Array, seed: Sequence[int]) -> None:
        self._random = np.random.default_rng(seed)
        self._flicker = flicker
        self._walk_step = walk * math.sqrt(SLOW_STEP_S)
        self._decay = np.exp(-SLOW_STEP_S / _TAUS_S)[:, None]
        sigma = flicker * math.sqrt(math.log(_TAU_RATIO) / math.pi)
        self._kick = np.sqrt(1.0 - self._decay**2) * sigma
        self._state = self._random.standard_normal((len(_TAUS_S), 6)) * sigma
        self._walked = np.zeros(6)
        self._origin = self._state.sum(axis=0)
        self._blocks: dict[int, Array] = {}
        self._made = 0
        self._last = np.zeros(6)
        self.silent = not (flicker.any() or walk.any())

    def at(self, t_s: Array) -> Array:
        """Return the path, linearly interpolated, at times (n, 6); before time 0 the values are those at time 0."""
        position = np.maximum(t_s, 0.0) / SLOW_STEP_S
        index = position.astype(np.int64)
        share = (position - index)[:, None]
        first, last = int(index.min()), int(index.max()) + 1
        grid = self._grid(first, last)
        return (1.0 - share) * grid[index - first] + share * grid[index - first + 1]

    def at_one(self, t_s: float) -> Array:
        position = max(t_s, 0.0) / SLOW_STEP_S
        index = int(position)
        share = position - index
        block, offset = divmod(index, _BLOCK)
        while block >= self._made:
            self._make_block()
        here = self._get_block(block)
        result: Array = (1.0 - share) * here[offset] + share * here[offset + 1]
        return result

    def _grid(self, first: int, last: int) -> Array:
        while last // _BLOCK >= self._made:
            self._make_block()
        parts = []
        for block in range(first // _BLOCK, last // _BLOCK + 1):
            start = max(first - block * _BLOCK, 0)
            parts.append(self._get_block(block)[start : min(last - block * _BLOCK + 1, _BLOCK)])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _get_block(self, block: int) -> Array:
        try:
            return self._blocks[block]
        except KeyError:
            raise ValueError(
                f"the bias at {block * _BLOCK * SLOW_STEP_S:.0f} s is no longer kept; at most"
                f" the last {_KEPT_BLOCKS * _BLOCK * SLOW_STEP_S / 3600:.1f} h are"
            ) from None

    def forget_before(self, t_s: float) -> None:
        for block in [each for each in self._blocks if (each + 1) * _BLOCK * SLOW_STEP_S <= t_s]:
            del self._blocks[block]

    def _make_block(self) -> None:
        """Make one block and the first value of the next, so that interpolation needs only one block."""
        out = np.empty((_BLOCK + 1, 6))
        out[0] = self._last
        kicks = self._random.standard_normal((_BLOCK, len(_TAUS_S), 6)) * self._kick
        steps = np.cumsum(self._random.standard_normal((_BLOCK, 6)) * self._walk_step, axis=0)
        state = self._state
        for row in range(_BLOCK):
            state = self._decay * state + kicks[row]
            out[row + 1] = state.sum(axis=0)
        out[1:] += self._walked + steps - self._origin
        self._state, self._walked, self._last = state, self._walked + steps[-1], out[-1].copy()
        self._blocks[self._made] = out
        self._blocks.pop(self._made - _KEPT_BLOCKS, None)
        self._made += 1


class ImuModel:
    """One IMU on the aircraft. Vectors are in the IMU's own axes unless a name says otherwise.

    Reading = M (truth in sensor axes) + bias(t) + white noise, rounded to the step, cut at the limit; with bias(t) =
    turn-on bias + flicker + walk + curve(T - T_ref) and M = scale and misalignment.

    Args:
        spec: a part of `PARTS`, by name, or a specification.
        gyro_bias_rad_s, accel_bias_m_s2: bias at aircraft time 0 and reference temperature.
        gyro_scale, accel_scale: relative scale errors of the three axes.
        gyro_misalignment_rad, accel_misalignment_rad: small rotation of the triad.
        gyro_shear, accel_shear: deviation from square of x and y, x and z, y and z.
        mounting_deg: roll, pitch, yaw of the sensor's axes relative to the vehicle's (a MAVLink rotation's angles).
        thermometer_off_k: error of the IMU's own thermometer.
        curve: the piece's curve over temperature; without one each axis moves as the specification allows.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        spec: ImuSpec | str = "icm42688p",
        *,
        seed: int = 0,
        gyro_bias_rad_s: Sequence[float] | Array = (0.0, 0.0, 0.0),
        accel_bias_m_s2: Sequence[float] | Array = (0.0, 0.0, 0.0),
        gyro_scale: Sequence[float] = (0.0, 0.0, 0.0),
        accel_scale: Sequence[float] = (0.0, 0.0, 0.0),
        gyro_misalignment_rad: Sequence[float] = (0.0, 0.0, 0.0),
        accel_misalignment_rad: Sequence[float] = (0.0, 0.0, 0.0),
        gyro_shear: Sequence[float] = (0.0, 0.0, 0.0),
        accel_shear: Sequence[float] = (0.0, 0.0, 0.0),
        mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        thermometer_off_k: float = 0.0,
        curve: Curve | None = None,
    ) -> None:
        self.aircraft = aircraft
        self.spec = PARTS[spec] if isinstance(spec, str) else spec
        self.mounting = mounting_matrix(*mounting_deg)
        """Rotation from sensor axes to vehicle FRD."""
        self._turn_on = np.concatenate([gyro_bias_rad_s, accel_bias_m_s2]).astype(np.float64)
        self.thermometer: Callable[[float], float] = lambda degc: degc + thermometer_off_k
        """Function from true temperature to the thermometer's reading; a test can replace it by a bad thermometer."""
        gyro, accel = self.spec.gyro, self.spec.accel
        self.curve = curve or Curve((np.repeat([gyro.per_kelvin, accel.per_kelvin], 3),))
        self.white: Array = np.repeat([gyro.white, accel.white], 3)
        """White noise N of the six axes: three in rad/s * sqrt(s), three in m/s^2 * sqrt(s)."""
        self._limit = np.repeat([gyro.limit, accel.limit], 3)
        self._slow = _SlowPath(
            np.repeat([gyro.flicker, accel.flicker], 3), np.repeat([gyro.walk, accel.walk], 3), [seed, 1]
        )
        self._random = np.random.default_rng([seed, 2])
        self._noise = np.empty((0, 6))
        self._seen: Truth | None = None
        self._ideal = np.zeros(6)
        self._gyro_matrix = _response(gyro_scale, gyro_misalignment_rad, gyro_shear) @ self.mounting.T
        self._accel_matrix = _response(accel_scale, accel_misalignment_rad, accel_shear) @ self.mounting.T

    def in_steps(self, gyro_rad_s: float, accel_m_s2: float) -> ImuModel:
        """Return the sensor with another converter, in place of this one: both draw from the same noise."""
        other, spec = copy.copy(self), self.spec
        gyro, accel = replace(spec.gyro, step=gyro_rad_s), replace(spec.accel, step=accel_m_s2)
        other.spec = replace(spec, gyro=gyro, accel=accel)
        return other

    def turn_on(self, gyro_bias_rad_s: Sequence[float] | Array, accel_bias_m_s2: Sequence[float] | Array) -> None:
        """Power up again with other biases, also for the sensors made by `in_steps`."""
        self._turn_on[:] = np.concatenate([gyro_bias_rad_s, accel_bias_m_s2])

    def forget_before(self, t_s: float) -> None:
        """Delete the stored bias before a time: one hour takes 1.7 MB."""
        self._slow.forget_before(t_s)

    def temperature_degc(self, t_s: float) -> float:
        return self.thermometer(self.aircraft.temperature_degc(t_s))

    def true_bias(self, t_s: float) -> Bias:
        """Return the true additive bias at a time: turn-on, flicker, walk and temperature."""
        both = self._bias_at(t_s)
        return Bias(both[:3], both[3:])

    def mean_bias(self, start_s: float, end_s: float) -> Bias:
        """Return the mean of `true_bias` over a window, on a grid of 0.1 s."""
        times = np.arange(start_s, end_s, SLOW_STEP_S) if end_s > start_s else np.array([start_s])
        both = self._bias(times).mean(axis=0)
        return Bias(both[:3], both[3:])

    def true_bias_in_vehicle(self, t_s: float) -> Bias:
        gyro, accel = self.true_bias(t_s)
        return Bias(self.mounting @ gyro, self.mounting @ accel)

    def in_accel_axes(self, force_m_s2: Array) -> Array:
        """Return the accelerometers' reading of a specific force (3,) in the vehicle's axes, without bias and noise."""
        result: Array = self._accel_matrix @ force_m_s2
        return result

    def expected(self, t_s: float) -> Array:
        """Return the reading without noise, rounding and limit: three rates, three specific forces."""
        truth = self.aircraft.truth_at(t_s)
        if truth is not self._seen:  # a standing aircraft gives the same object again and again
            ideal = np.concatenate((self._gyro_matrix @ truth.rate_rad_s, self._accel_matrix @ truth.force_m_s2))
            self._seen, self._ideal = truth, ideal
        return self._ideal + self._bias_at(t_s)

    def expected_block(self, t_s: Array) -> Array:
        """Return readings (n, 6) without noise, rounding and limit at ascending times (n)."""
        rate, force = self.aircraft.truth(t_s)
        out = self._bias(t_s)
        out[:, :3] += rate @ self._gyro_matrix.T
        out[:, 3:] += force @ self._accel_matrix.T
        return out

    def read(self, t_s: Array, interval_s: float) -> Array:
        """Return readings (n, 6) at ascending times, of samples that each average over `interval_s`.

        White noise is drawn in the order of reading, so one model has one reader; the bias does not care.
        """
        out = self.expected_block(t_s)
        out += self._draw(len(t_s)) * (self.white / math.sqrt(interval_s))
        for part, triad in ((out[:, :3], self.spec.gyro), (out[:, 3:], self.spec.accel)):
            if triad.step > 0.0:
                np.rint(part / triad.step, out=part)
                part *= triad.step
        np.maximum(out, -self._limit, out=out)
        np.minimum(out, self._limit, out=out)
        return out

    def _draw(self, count: int) -> Array:
        if len(self._noise) < count:
            self._noise = np.concatenate([self._noise, self._random.standard_normal((max(256, count), 6))])
        drawn, self._noise = self._noise[:count], self._noise[count:]
        return drawn

    def _bias(self, t_s: Array) -> Array:
        thin = _thin(t_s)
        degc = self.aircraft.temperatures_degc(thin - self.curve.lag_s)
        if thin is not t_s:
            degc = np.interp(t_s, thin, degc)
        out = self._turn_on + self.curve.at((degc - self.spec.reference_degc)[:, None])
        result: Array = out if self._slow.silent else out + self._slow.at(t_s)
        return result

    def _bias_at(self, t_s: float) -> Array:
        degc = self.aircraft.temperature_degc(t_s - self.curve.lag_s)
        out = self._turn_on + self.curve.at(degc - self.spec.reference_degc)
        return out if self._slow.silent else out + self._slow.at_one(t_s)


def _thin(t_s: Array) -> Array:
    """Return times about 0.1 s apart that span a block: often enough to ask for a temperature."""
    if len(t_s) < 3:
        return t_s
    return np.linspace(t_s[0], t_s[-1], max(2, int((t_s[-1] - t_s[0]) / SLOW_STEP_S) + 2))


def _response(
    scale: Sequence[float], misalignment_rad: Sequence[float], shear: Sequence[float] = (0.0, 0.0, 0.0)
) -> Array:
    x, y, z = misalignment_rad
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    xy, xz, yz = shear
    stretch = np.diag(1.0 + np.asarray(scale, dtype=np.float64))
    stretch += np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
    result: Array = stretch @ (np.eye(3) - skew)
    return result
