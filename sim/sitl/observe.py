"""What a firmware's telemetry says its IMUs read, undone of the integers it travels in."""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.sitl.ground import GroundStation
from sim.sitl.hil_frames import FIFO_STEPS
from sim.sitl.vehicle import SitlVehicle

SCALED = (
    mavlink.MAVLink_scaled_imu_message,
    mavlink.MAVLink_scaled_imu2_message,
    mavlink.MAVLink_scaled_imu3_message,
)
STEP = np.array([1e-3] * 3 + [1e-3 * STANDARD_GRAVITY_M_S2] * 3)
"""Of the SCALED_IMU messages: mrad/s and mG."""
_STEADY_SIGMA = 1.0 / math.sqrt(2.0)
"""PX4 integrates by the trapezoid rule: an output is the mean of two samples (the figure of autopilots 9.3.2)."""
PX4_RATE_HZ = 250.0
GRID = np.array(FIFO_STEPS)
"""Of PX4's sensor 0."""


async def mean_reading(vehicle: SitlVehicle, ground: GroundStation, instance: int, seconds: float) -> Array:
    """Mean of IMU `instance` as its telemetry tells it: three rates (rad/s), three specific forces (m/s^2), FRD.

    ArduPilot's first IMU comes in floats (HIGHRES_IMU). Everything else comes in integers cut off towards zero; of
    those the most likely mean under Gaussian noise is taken. PX4's HIGHRES_IMU is not used: it has the estimator's
    bias taken out.

    Raises:
        RuntimeError: the messages do not come.
    """
    if vehicle.firmware == "ardupilot" and instance == 1:
        rows = await ground.imu(mavlink.MAVLink_highres_imu_message, seconds)
        mean: Array = rows.mean(axis=0)
        return mean
    px4 = vehicle.firmware == "px4"
    rows = await ground.imu(SCALED[instance - 1], seconds, rate_hz=PX4_RATE_HZ if px4 else 100.0)
    model = vehicle.imus[min(instance, len(vehicle.imus)) - 1]
    sigma = model.white * math.sqrt(PX4_RATE_HZ) * _STEADY_SIGMA / STEP
    counts = np.rint(rows / STEP)
    if px4 and instance == 1:
        offset, scale = await _corrections(ground)
        white = model.white * math.sqrt(PX4_RATE_HZ)
        found = [
            gridded_mean(counts[:, n], white[n] / STEP[n], GRID[n] / STEP[n], offset[n] / STEP[n], scale[n])
            for n in range(6)
        ]
    else:
        found = [truncated_mean(counts[:, axis], float(sigma[axis])) for axis in range(6)]
    result: Array = np.array(found) * STEP
    return result


async def residual(vehicle: SitlVehicle, ground: GroundStation, instance: int, seconds: float) -> Array:
    """`mean_reading` less the truth of the aircraft at the end of the look; the same six numbers.

    Raises:
        RuntimeError: the messages do not come.
    """
    mean = await mean_reading(vehicle, ground, instance, seconds)
    truth = vehicle.aircraft.truth_at(vehicle.now_s)
    return np.asarray(mean - np.concatenate([truth.rate_rad_s, truth.force_m_s2]), dtype=np.float64)


async def _corrections(ground: GroundStation) -> tuple[list[float], list[float]]:
    """Offsets and scales of PX4's first slots, gyro then accelerometer."""
    offset = [await ground.get(f"CAL_{sensor}0_{axis}OFF") for sensor in ("GYRO", "ACC") for axis in "XYZ"]
    return offset, [1.0, 1.0, 1.0, *[await ground.get(f"CAL_ACC0_{axis}SCALE") for axis in "XYZ"]]


def gridded_mean(values: Array, sigma: float, grid: float, offset: float, scale: float = 1.0) -> float:
    """The most likely mean of PX4's sensor 0: three rounded readings meaned 1 2 1, corrected, cut; in last digits.

    Args:
        values: the integers (n).
        sigma: of one reading of the sensor.
        grid: its steps.
        offset: what the firmware takes off.
        scale: what it multiplies with afterwards.
    """
    numbers, seen = np.unique(values, return_counts=True)
    middle = float(np.average(numbers + 0.5 * np.sign(numbers), weights=seen))
    middle_line, reach = round((middle / scale + offset) / grid), math.ceil(8.0 * sigma / grid + 3.0)
    lines = np.arange(middle_line - reach, middle_line + reach + 1)
    sums = np.arange(4 * lines[0], 4 * lines[-1] + 1)
    shown = np.trunc((sums * grid / 4.0 - offset) * scale)
    best, width = middle, 1.5
    for _ in range(4):
        means = best + np.linspace(-width, width, 41)
        raw = means[:, None] / scale + offset
        shares = _phi(((lines + 0.5) * grid - raw) / sigma) - _phi(((lines - 0.5) * grid - raw) / sigma)
        twice = np.zeros((len(shares), 2 * len(lines) - 1))
        twice[:, ::2] = shares
        both = np.array([np.convolve(np.convolve(one, one), two) for one, two in zip(shares, twice, strict=True)])
        told = np.array([both[:, shown == number].sum(axis=1) for number in numbers])
        best, width = (
            float(means[int(np.argmax((np.log(np.maximum(told, 1e-300)) * seen[:, None]).sum(axis=0)))]),
            width / 8.0,
        )
    return best


def truncated_mean(values: Array, sigma: float) -> float:
    """The most likely mean of Gaussian readings that were cut off towards zero, in units of the last digit.

    Args:
        values: the integers (n).
        sigma: standard deviation of the noise, believed where fewer than three values are seen; else found as well.
    """
    numbers, seen = np.unique(values, return_counts=True)
    counts = seen.astype(np.float64)
    below = np.where(numbers > 0, numbers, numbers - 1.0)
    above = np.where(numbers < 0, numbers, numbers + 1.0)
    middle = float(np.average((below + above) / 2.0, weights=counts))
    sigmas = np.array([sigma]) if len(numbers) < 3 else np.geomspace(0.2 * max(sigma, 0.1), 5.0 * max(sigma, 0.1), 41)
    best, width = middle, 2.0 + 2.0 * sigma
    for _ in range(6):
        means = best + np.linspace(-width, width, 41)
        likelihood = _log_likelihood(means[:, None, None], sigmas[None, :, None], below, above, counts)
        row, column = np.unravel_index(int(np.argmax(likelihood)), likelihood.shape)
        best, width = float(means[row]), width / 8.0
        if len(sigmas) > 1:
            near = float(sigmas[column])
            spread = (sigmas[-1] / sigmas[0]) ** 0.125
            sigmas = np.geomspace(near / spread, near * spread, 41)
    return best


def _log_likelihood(means: Array, sigmas: Array, below: Array, above: Array, counts: Array) -> Array:
    shares = _phi((above - means) / sigmas) - _phi((below - means) / sigmas)
    result: Array = (np.log(np.maximum(shares, 1e-300)) * counts).sum(axis=2)
    return result


def _phi(x: Array) -> Array:
    """The normal distribution's integral; the table is fine enough for counting."""
    result: Array = np.interp(x, _GRID, _PHI)
    return result


_GRID = np.linspace(-9.0, 9.0, 36_001)
_PHI = np.array([0.5 * (1.0 + math.erf(value / math.sqrt(2.0))) for value in _GRID])
