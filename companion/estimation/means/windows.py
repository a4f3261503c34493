"""Means over a window without motion, with realistic sigmas, from one-second batches.

Each mean has two sigmas: `sigma_stat` is the noise that remains after averaging, and `sigma_use` is the expected error
over the next H seconds (method.md sections 2.2, 2.4, 2.5 and 3.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.config.sections import NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.means.integers import HUBER_C as INTEGERS_HUBER_C
from companion.estimation.means.integers import integer_columns
from companion.estimation.means.pose import FieldWindow, HeadingWindow, TiltWindow
from companion.estimation.means.warming import UNKNOWN, Warming, drifting, temperature
from companion.estimation.noise.allan import (
    FLOOR_OF_FLICKER,
    WARM_UP,
    allan_variance,
    columns,
    floor_variance,
    learned_floor,
    slope_variance,
    white_noise,
)
from companion.estimation.noise.lines import HUBER_C, RAMP_BATCHES, huber_line, is_ramp, robust_mean
from companion.estimation.seconds.batch import Batch
from companion.estimation.turning.turn import Turn
from companion.physics.frames import Floats, vector
from companion.physics.units import DEG_H, MG
from companion.samples import TRIADS, Triad, Vector, rows_of

WHITE_SHARE: Final = 0.09
"""Ratio of white-noise variance to all other variance below which more averaging gains nothing: 30 % in sigma."""
_ALLAN_SPANS: Final = 5
RAW_BATCHES: Final = 10  # Least seconds of floats, beside integers, that show their own scatter
RAW_STEP: Final = 1e-5  # Rounding of the floats beside integers: five decimals, rad/s and m/s^2
SPOT_WALK: Final = np.repeat([0.0, 0.05 * MG], 3)
"""Random walk (6,) of an unknown IMU by tilt of the ground and temperature, unit / sqrt(s), beside the IMU's own walk.
No window shows it in advance. Rms of a log-normal fit to 0.013 (Movella DOT), 0.03 (VN-100), 0.05 (MPU6050)."""
_LOST_WARNING: Final = 0.01
_LOST_REFUSAL: Final = 0.5
_USUAL_SHARE: Final = 0.95
"""Share of the usual sample count: a second with less has lost samples; a smaller shortage is due to the 1 s grid."""
_GUESSED_FLOOR: Final = 2.56
"""Factor on the variance of a slope, if flicker and walk are estimated from the line's residuals. With this factor,
chance slopes of ten Movella DOT do not count as ramps; the warm-up of a PX4 board (sample.ulg) does."""
_MOST_WANDER: Final = 0.5  # Largest wander about a ramp, over the change by the ramp in the same time
_ALLAN_SIGNIFICANT: Final = 3.0
"""Threshold: Allan variance at 1/5 of the window, over that of white noise; 5 % point of some 4 degrees of freedom."""


class ImuInput(msgspec.Struct, frozen=True, kw_only=True):
    """Description of one IMU for the collector; `rotation` (3, 3) is from the sensor's to the vehicle's axes (FRD).

    `clock_from_start`: the time in its samples (`t_device_s`) counts from power-up of the device.
    """

    name: str
    rotation: NDArray[np.float64]
    profile: NoiseProfile
    gyro_step_rad_s: float = 0.0
    """Step of integers truncated toward zero; 0 for floats. Both triads are integers, or both are floats."""
    accel_step_m_s2: float = 0.0
    clock_from_start: bool = False

    @property
    def steps(self) -> Floats | None:
        """Quantisation steps (6,), rad/s and m/s^2, of an integer stream; None for floats."""
        return np.repeat([self.gyro_step_rad_s, self.accel_step_m_s2], 3) if self.gyro_step_rad_s else None


class ImuWindow(msgspec.Struct, frozen=True, kw_only=True):
    """Means of one IMU over one window without motion, in the vehicle's axes (FRD).

    `drifting`: warnings of drift, omitted later if a bias curve explains it. `hidden`: texts, by triad, on a noise too
    small to spread the integers: the mean is good to half a step only. `useless`: triads whose mean is unknown. On a
    deck only: `covariance` (6, 6) of all axes, and `by_earth` (3, 3), the share of the Earth's rate ahead, right and
    down in the gyro means. `mounting`: rows of the rotation from the sensor's to the vehicle's axes.
    """

    name: str
    samples: int
    duration_s: float
    gyro_rad_s: Vector
    accel_m_s2: Vector
    gyro_sigma_stat_rad_s: Vector
    accel_sigma_stat_m_s2: Vector
    gyro_sigma_use_rad_s: Vector  # sqrt(V(T, H)) of the sensor alone; `solve` adds the error of the pose
    accel_sigma_use_m_s2: Vector
    temperature_degc: float | None
    warnings: tuple[str, ...]
    drifting: tuple[str, ...] = ()
    hidden: dict[Triad, str] = {}
    useless: frozenset[Triad] = frozenset()
    named: bool = True  # True if the configuration names the part
    covariance: NDArray[np.float64] | None = None
    by_earth: NDArray[np.float64] | None = None
    mounting: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    warming: Warming | None = None  # Slopes from a warm-up; None: no allowance for one

    def refused(self, part: Triad) -> str | None:
        return self.hidden[part] if part in self.useless else None


class Window(msgspec.Struct, frozen=True, kw_only=True):
    """Means of all sensors over one window. `powered_s`: least time from power-up of each IMU to the window's end, s.

    `turn_rad_s`: mean rate of a deck's turn about the vertical, which is computed from raw gradienter readings.
    """

    start_s: float
    end_s: float
    imus: tuple[ImuWindow, ...]
    tilt: TiltWindow | None
    heading: HeadingWindow | None
    field: FieldWindow | None = None
    """Mean field of the compass, over the good seconds that have one; None if the compass sends no field."""
    turn_rad_s: Vector | None = None
    powered_s: dict[str, float] = {}
    turn: Turn = Turn()


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """Estimate of one IMU in its own axes; arrays are (6,), gyro in rad/s, then accelerometer in m/s^2.

    `undecided`: integers do not determine the mean yet; rare integers in later seconds may. `useless`: the mean is only
    known to be within a step of zero. `half_step`: floats with fewer than 3 distinct readings. `white`: white noise N,
    the larger of the measured one and the profile's. `white_variance`: part of `use_variance` that more seconds reduce.
    """

    mean: Floats
    stat_variance: Floats
    use_variance: Floats
    white_variance: Floats
    white: Floats
    warming: Warming
    half_step: NDArray[np.bool_]
    undecided: NDArray[np.bool_]
    useless: NDArray[np.bool_]


def estimate(
    imu: ImuInput, batches: Sequence[Batch], *, end_s: float, horizon_s: float, rounding: float = 0.0
) -> Estimate:
    """Estimate the means of one IMU from at least 2 good seconds.

    A ramp is evaluated at the end of the window, `end_s`, and never later. `horizon_s`: time H for which the means will
    be used. `rounding`: step of rounded floats.
    """
    profile_white, flicker, walk = columns(imu.profile)
    slots = np.array([batch.slot for batch in batches], dtype=np.int64)
    seconds = float(len(slots))
    huber_c, least, useless = HUBER_C, np.zeros(6), np.zeros(6, dtype=np.bool_)
    undecided = half_step = useless
    if imu.steps is not None:
        huber_c = INTEGERS_HUBER_C
        values, least, quantum, undecided, useless = integer_columns(batches, imu.steps)
    else:
        values = np.array([batch.mean for batch in batches])
        quantum, half_step = _quantisation(batches, rounding)
    wander = slope_variance(flicker, walk, float(end_s - slots[0]))
    mean, leverage = robust_mean(values, huber_c, least), np.full(6, 1.0 / seconds)
    half_s = (end_s - slots[0]) / 2.0
    slope, ramp, level = np.zeros(6), np.zeros(6), values
    if is_long := len(slots) >= RAMP_BATCHES:
        times = slots.astype(np.float64) + 0.5
        line = huber_line(times, values, end_s, huber_c, least)
        if not imu.profile.is_named:
            # About the line, as a ramp would count as wander; the line takes the slowest of that with it.
            floors = _learned(slots, values - line.slope * times[:, None], least)
            wander = _GUESSED_FLOOR * slope_variance(*floors, 2.0 * half_s)
        ramps = is_ramp(line, len(slots), wander) & _dominates(slots, values, line.slope)
        slope, ramp = line.slope, np.where(ramps, line.slope, 0.0)
        level = values - ramp * (times - times.mean())[:, None]
        mean, leverage = np.where(ramps, line.end, mean), np.where(ramps, line.end_leverage, leverage)
    measured = np.maximum(white_noise(slots, level), least)
    white = np.maximum(measured, profile_white)
    if imu.profile.is_named:
        flicker = _flicker(slots, level, measured, flicker)
    else:
        flicker, walk = _learned(slots, level, least)
    quantum = np.sqrt(np.square(quantum) + np.mean([batch.shared_variance for batch in batches], axis=0))
    # A ramp may end now or go on for the next H seconds: the error of the mean over them is uniform between 0 and
    # slope * H / 2.
    going_on = np.square(ramp * horizon_s / 2.0) / 3.0
    white_part = np.square(white) * leverage
    rest = floor_variance(flicker, walk, seconds, horizon_s) + np.square(quantum)
    of_line = np.square(white) / max(float(np.square(slots - slots.mean()).sum()), 1.0)
    of_line = of_line + 3.0 * np.square(quantum / (2.0 * half_s)) + wander
    rate, path = temperature(batches)
    return Estimate(
        mean=mean,
        stat_variance=np.square(measured) * leverage + np.square(quantum),
        use_variance=white_part + rest + going_on,
        white_variance=white_part,
        white=white,
        warming=Warming(
            slope=slope,
            ramp=ramp,
            variance=np.minimum(of_line, UNKNOWN) if is_long else np.full(6, UNKNOWN),
            level_variance=np.square(white) / seconds + rest,
            warm_up=imu.profile.warm_up or WARM_UP,
            half_s=half_s,
            rate=rate,
            path=path,
        ),
        half_step=half_step,
        undecided=undecided,
        useless=useless,
    )


def _dominates(slots: NDArray[np.int64], values: Floats, slope: Floats) -> NDArray[np.bool_]:
    """Return (c,) true if, in 1/5 of the window, a line changes more than readings wander about it; a step: false."""
    left = values - slope * (slots - slots.mean())[:, None]
    excess, span = _excess(slots, left, white_noise(slots, left))
    return np.asarray(excess < np.square(slope * span * _MOST_WANDER))


def _learned(slots: NDArray[np.int64], values: Floats, least: Floats) -> tuple[Floats, Floats]:
    """Return flicker B and random walk K (c,) of an IMU of unknown type, whose white noise N is at least `least`."""
    white = np.maximum(white_noise(slots, values), least)
    parts = [learned_floor(slots, values[:, rows_of(triad)], white[rows_of(triad)]) for triad in TRIADS]
    flicker, walk = (np.concatenate(each) for each in zip(*parts, strict=True))
    return flicker, np.hypot(walk, SPOT_WALK)


def _flicker(slots: NDArray[np.int64], values: Floats, white: Floats, profile: Floats) -> Floats:
    """Return flicker B (c,): the larger of the profile's B and B by the excess of Allan variance (`_excess`)."""
    excess, _ = _excess(slots, values, white)
    return np.maximum(np.sqrt(excess) / FLOOR_OF_FLICKER, profile)


def _excess(slots: NDArray[np.int64], values: Floats, white: Floats) -> tuple[Floats, int]:
    """Return Allan variance (c,) beyond white noise (0 if by chance), and its averaging time, s, 1/5 of the window."""
    span = int(slots[-1] - slots[0] + 1) // _ALLAN_SPANS
    if span < 2:
        return np.zeros(values.shape[1]), span
    variance, _ = allan_variance(slots, values, span)
    explained = np.square(white) / span
    return np.where(variance > _ALLAN_SIGNIFICANT * explained, variance - explained, 0.0), span


def _quantisation(batches: Sequence[Batch], step: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return one sigma of the rounding error (c,), and flags (c,) of channels with fewer than 3 distinct values.

    For these the sigma is half a step. Otherwise it is the bound for noise sigma s and `step` q (0: unknown),
    (q / pi) exp(-2 pi^2 s^2 / q^2) (method.md sections 2.2 and 2.5).
    """
    low = np.min([batch.low for batch in batches], axis=0)
    high = np.max([batch.high for batch in batches], axis=0)
    distinct = np.max([batch.distinct for batch in batches], axis=0)
    if step == 0.0:
        # A stream of floats may still have coarse steps: then the step is the distance of its two values.
        few = distinct < 3
        return np.where(few, (high - low) / 2.0, 0.0), few
    few = high - low < 1.5 * step
    variance = np.mean([batch.variance for batch in batches], axis=0)
    return np.where(few, step / 2.0, step / math.pi * np.exp(-2.0 * math.pi**2 * variance / step**2)), few


def imu_window(
    imu: ImuInput,
    seconds: Sequence[Batch],
    raw: Sequence[Batch] = (),
    *,
    end_s: float,
    horizon_s: float,
    rejected: int,
) -> tuple[Estimate, ImuWindow]:
    """Estimate the means of one IMU from its good seconds: in the IMU's own axes, and in the vehicle's axes.

    `raw`: means in floats of those seconds, sent beside a stream of integers; used if their gyro variance is smaller.

    Raises:
        CalibrationRefusedError: an axis never changes, or most samples were lost.
    """
    _refuse_broken(imu, seconds)
    own = estimate(imu, seconds, end_s=end_s, horizon_s=horizon_s)
    if len(raw) >= RAW_BATCHES:
        floats = msgspec.structs.replace(imu, gyro_step_rad_s=0.0, accel_step_m_s2=0.0)
        better = estimate(floats, raw, end_s=end_s, horizon_s=horizon_s, rounding=RAW_STEP)
        if better.use_variance[:3].sum() < own.use_variance[:3].sum():
            return better, _in_vehicle(floats, raw, better, rejected)
    return own, _in_vehicle(imu, seconds, own, rejected)


def _in_vehicle(imu: ImuInput, batches: Sequence[Batch], found: Estimate, rejected: int) -> ImuWindow:
    temperatures = [batch.temperature_degc for batch in batches if batch.temperature_degc is not None]
    rotation = np.asarray(imu.rotation, dtype=np.float64)
    gyro, accel, hidden = slice(0, 3), slice(3, 6), _hidden(imu, found)
    return ImuWindow(
        name=imu.name,
        samples=sum(batch.n for batch in batches),
        duration_s=float(len(batches)),
        gyro_rad_s=vector(rotation @ found.mean[gyro]),
        accel_m_s2=vector(rotation @ found.mean[accel]),
        gyro_sigma_stat_rad_s=_turned(rotation, found.stat_variance[gyro]),
        accel_sigma_stat_m_s2=_turned(rotation, found.stat_variance[accel]),
        gyro_sigma_use_rad_s=_turned(rotation, found.use_variance[gyro]),
        accel_sigma_use_m_s2=_turned(rotation, found.use_variance[accel]),
        temperature_degc=float(np.mean(temperatures)) if temperatures else None,
        warnings=tuple(_warnings(imu, batches, found, rejected)),
        hidden=hidden,
        useless=frozenset(part for part in hidden if found.useless[rows_of(part)].any()),
        named=imu.profile.is_named,
        mounting=(vector(rotation[0]), vector(rotation[1]), vector(rotation[2])),
        warming=found.warming.rotated(rotation),
        drifting=drifting(imu.name, found.warming.ramp, temperatures),
    )


def _turned(rotation: Floats, variance: Floats) -> Vector:
    return vector(np.sqrt(np.square(rotation) @ variance))


def _hidden(imu: ImuInput, own: Estimate) -> dict[Triad, str]:
    found: dict[Triad, str] = {}
    steps = f"{imu.gyro_step_rad_s / DEG_H:.0f} deg/h", f"{imu.accel_step_m_s2 / MG:.1f} mg"
    for part, step in zip(TRIADS, steps, strict=True):
        undecided, useless = own.undecided[rows_of(part)], own.useless[rows_of(part)]
        if undecided.any():
            what = "not known: bias and" if useless.any() else "half a step unknown:"
            found[part] = (
                f"{part} {imu.name} {_axes(useless if useless.any() else undecided)}: {what} noise smaller than its"
                f" telemetry's steps of {step}: no floats (ArduPilot: companion autopilot script; PX4: its console)"
            )
    return found


def _axes(which: NDArray[np.bool_]) -> str:
    return "".join(axis for axis, is_it in zip("xyz", which.tolist(), strict=True) if is_it)


def _warnings(imu: ImuInput, batches: Sequence[Batch], own: Estimate, rejected: int) -> list[str]:
    found: list[str] = []
    for part in TRIADS:
        if axes := _axes(own.half_step[rows_of(part)]):
            found.append(f"{part} {imu.name} {axes}: fewer than 3 distinct readings, half a step may be hidden")
    if (share := lost(batches)) > _LOST_WARNING:
        found.append(f"imu {imu.name} lost {share:.0%} of its samples")
    if rejected:
        found.append(f"{rejected} of {rejected + len(batches)} s were not still and are left out")
    return found


def _refuse_broken(imu: ImuInput, batches: Sequence[Batch]) -> None:
    low = np.min([batch.low for batch in batches], axis=0)
    high = np.max([batch.high for batch in batches], axis=0)
    for column in np.flatnonzero(low == high).tolist() if imu.steps is None else ():
        part = f"{TRIADS[column // 3]} {imu.name}"
        raise CalibrationRefusedError(f"{part} is stuck: axis {'xyz'[column % 3]} did not change in {len(batches)} s")
    if (share := lost(batches)) > _LOST_REFUSAL:
        raise CalibrationRefusedError(f"imu {imu.name} lost {share:.0%} of its samples, more than {_LOST_REFUSAL:.0%}")


def lost(batches: Sequence[Batch]) -> float:
    """Return the share of lost samples, by the device's counter, or else by the usual number of samples per second."""
    usual = float(np.median([batch.n for batch in batches]))
    missing = came = 0.0
    for batch in batches:
        came += batch.n
        if batch.missing is not None:
            missing += batch.missing
        elif batch.n < _USUAL_SHARE * usual:
            missing += usual - batch.n
    return missing / (missing + came)
