"""What a firmware's telemetry says its IMUs read, undone of the integers it travels in."""

from __future__ import annotations

import asyncio
import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.sitl.ground import GroundStation, imu_row
from sim.sitl.hil_frames import FIFO_STEPS
from sim.sitl.vehicle import SitlVehicle

SCALED = (
    mavlink.MAVLink_scaled_imu_message,
    mavlink.MAVLink_scaled_imu2_message,
    mavlink.MAVLink_scaled_imu3_message,
)
STEP = np.array([1e-3] * 3 + [1e-3 * STANDARD_GRAVITY_M_S2] * 3)
"""Of the SCALED_IMU messages: mrad/s and mG."""
SWAYS_STEPS = 10.0
"""An aircraft that moves by more has all digits in its integers."""
_NEAR_S = 0.005
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
    """What an IMU reads more than the truth of the aircraft, after its offsets; the same six numbers."""
    aircraft, begun_s = vehicle.aircraft, vehicle.now_s
    ahead = np.concatenate(aircraft.truth(begun_s + np.linspace(0.0, min(seconds, 30.0), 301)), axis=1)
    if (np.ptp(ahead, axis=0) > SWAYS_STEPS * STEP).any():
        return await _residual_on_the_move(vehicle, ground, instance, seconds)
    mean = await mean_reading(vehicle, ground, instance, seconds)
    truth = np.concatenate(aircraft.truth(np.linspace(begun_s, vehicle.now_s, 301)), axis=1).mean(axis=0)
    return np.asarray(mean - truth, dtype=np.float64)


async def _residual_on_the_move(vehicle: SitlVehicle, ground: GroundStation, instance: int, seconds: float) -> Array:
    floats = vehicle.firmware == "ardupilot" and instance == 1
    kind = mavlink.MAVLink_highres_imu_message if floats else SCALED[instance - 1]
    since_s = asyncio.get_running_loop().time()
    await ground.imu(kind, seconds, rate_hz=100.0 if vehicle.firmware == "ardupilot" else PX4_RATE_HZ)
    heard = ground.timed(kind, since_s=since_s)
    rows = np.array([imu_row(message) for _, message in heard])
    if not floats:  # they move by many digits, so that half a digit towards zero is what was cut off
        rows += np.sign(rows) * STEP / 2.0
    times = vehicle.samples.aircraft_times(np.array([_own_s(message) for _, message in heard]))
    arrived_s = np.array([vehicle.aircraft.time_at(t_s) for t_s, _ in heard])
    # The firmware's clock may have begun some time before our physics.
    return excess(vehicle.aircraft, rows, times + float(np.median(arrived_s - times)))


def excess(aircraft: VirtualAircraft, rows: Array, times: Array) -> Array:
    """What readings of a swaying aircraft are too large by (6); how late they are is found beside it.

    Args:
        aircraft: the truth.
        rows: readings (n, 6): rad/s, m/s^2.
        times: when they were made, aircraft time, and the same for all too late (n).
    """
    found = []
    for sensor in range(2):
        shown, late_s, more = rows[:, 3 * sensor : 3 * sensor + 3], 0.0, np.zeros(3)
        for _ in range(4):
            before, at, after = (aircraft.truth(times - late_s + d)[sensor] for d in (-_NEAR_S, 0.0, _NEAR_S))
            slope, left = (after - before) / (2.0 * _NEAR_S), shown - at
            middle = slope - slope.mean(axis=0)
            later_s = -float((middle * left).sum() / (middle**2).sum())
            more = left.mean(axis=0) + later_s * slope.mean(axis=0)
            late_s += later_s
        found.append(more)
    return np.concatenate(found)


def _own_s(message: mavlink.MAVLink_message) -> float:
    """The firmware's clock."""
    fields = message.to_dict()
    return float(fields["time_usec"]) * 1e-6 if "time_usec" in fields else float(fields["time_boot_ms"]) * 1e-3


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
