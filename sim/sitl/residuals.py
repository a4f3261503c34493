"""Error that each calibration leaves in a real autopilot: telemetry beside the truth, as a table (autopilots 9.3)."""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.firmware.messages import SCALED_IMU
from sim.imu_model import DEG_H, MG
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation, imu_row
from sim.sitl.hil_backend import FIFO_STEPS
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle
from sim.station import open_udp

STEP = np.array([1e-3] * 3 + [1e-3 * STANDARD_GRAVITY_M_S2] * 3)
"""Steps of the SCALED_IMU messages: mrad/s and mG."""
SWAYS_STEPS = 10.0
"""Range of the true readings, in steps, above which no correction for truncation is needed: all digits occur."""
_NEAR_S = 0.005
_STEADY_SIGMA = 1.0 / math.sqrt(2.0)
"""Factor for the noise of PX4, whose output is the mean of two samples (trapezoid rule; autopilots 9.3.2)."""
PX4_RATE_HZ = 250.0
GRID = np.array(FIFO_STEPS)
"""Steps of PX4's sensor 0."""


async def mean_reading(vehicle: SitlVehicle, ground: GroundStation, instance: int, seconds: float) -> Array:
    """Mean of IMU `instance` from its telemetry: three rates (rad/s), three specific forces (m/s^2), FRD.

    ArduPilot's first IMU comes in floats (HIGHRES_IMU). Everything else comes in truncated integers; the result is the
    most likely mean under Gaussian noise. PX4's HIGHRES_IMU is not used: the estimator's bias is subtracted from it.
    """
    if vehicle.firmware == "ardupilot" and instance == 1:
        rows = await ground.imu(mavlink.MAVLink_highres_imu_message, seconds)
        mean: Array = rows.mean(axis=0)
        return mean
    px4 = vehicle.firmware == "px4"
    rows = await ground.imu(SCALED_IMU[instance - 1], seconds, rate_hz=PX4_RATE_HZ if px4 else 100.0)
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
    """Return an IMU's reading less the aircraft's truth, with the firmware's offsets applied; as in `mean_reading`."""
    aircraft, begun_s = vehicle.aircraft, vehicle.now_s
    ahead = np.concatenate(aircraft.truth(begun_s + np.linspace(0.0, min(seconds, 30.0), 301)), axis=1)
    if (np.ptp(ahead, axis=0) > SWAYS_STEPS * STEP).any():
        return await _residual_on_the_move(vehicle, ground, instance, seconds)
    mean = await mean_reading(vehicle, ground, instance, seconds)
    truth = np.concatenate(aircraft.truth(np.linspace(begun_s, vehicle.now_s, 301)), axis=1).mean(axis=0)
    return np.asarray(mean - truth, dtype=np.float64)


async def _residual_on_the_move(vehicle: SitlVehicle, ground: GroundStation, instance: int, seconds: float) -> Array:
    floats = vehicle.firmware == "ardupilot" and instance == 1
    kind = mavlink.MAVLink_highres_imu_message if floats else SCALED_IMU[instance - 1]
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
    """Return the mean excess (6) of readings over the truth of a swaying aircraft; the readings' delay is fitted too.

    Args:
        aircraft: the truth.
        rows: readings (n, 6): rad/s, m/s^2.
        times: their aircraft times, all late by the same delay (n).
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
    """Return the time by the firmware's clock."""
    fields = message.to_dict()
    return float(fields["time_usec"]) * 1e-6 if "time_usec" in fields else float(fields["time_boot_ms"]) * 1e-3


async def _corrections(ground: GroundStation) -> tuple[list[float], list[float]]:
    """Return offsets and scales of PX4's first slots, gyro then accelerometer."""
    offset = [await ground.get(f"CAL_{sensor}0_{axis}OFF") for sensor in ("GYRO", "ACC") for axis in "XYZ"]
    return offset, [1.0, 1.0, 1.0, *[await ground.get(f"CAL_ACC0_{axis}SCALE") for axis in "XYZ"]]


def gridded_mean(values: Array, sigma: float, grid: float, offset: float, scale: float = 1.0) -> float:
    """Return the likeliest mean of PX4's sensor 0, in last digits; rounded, averaged 1 2 1, corrected, truncated.

    Args:
        values: the integers (n).
        sigma: sigma of one reading of the sensor.
        grid: steps of the sensor.
        offset: subtracted by the firmware.
        scale: factor applied afterwards.
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
    """Return the likeliest mean of Gaussian readings truncated towards zero, in units of the last digit.

    Args:
        values: the integers (n).
        sigma: standard deviation of the noise, used where fewer than three values occur; else it is fitted.
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
    """Return the integral of the normal distribution from a table, which is fine enough for counting."""
    result: Array = np.interp(x, _GRID, _PHI)
    return result


_GRID = np.linspace(-9.0, 9.0, 36_001)
_PHI = np.array([0.5 * (1.0 + math.erf(value / math.sqrt(2.0))) for value in _GRID])


OBSERVE_S = 60.0
"""Length of each observation."""
SETTLE_S = 40.0
"""Time after a start in which the estimator finds its position and the first transients end."""
OWN_CALIBRATION_S = 60.0
"""Timeout of ArduPilot's gyro calibration, which gives up after about 30 s; do not repeat it (autopilots 9.3.1)."""
QUIET_S = 3.0
GYROS, QUICK, LEVEL = (1.0,), (0.0, 0.0, 0.0, 0.0, 4.0), (0.0, 0.0, 0.0, 0.0, 2.0)
"""Parameters of MAV_CMD_PREFLIGHT_CALIBRATION: gyros; accelerometers by one pose; level."""
_QUICK_NAME = {"ardupilot": "simple, param5 = 4", "px4": "quick, param5 = 4"}
_LEVEL = {"ardupilot": ("AHRS_TRIM_X", "AHRS_TRIM_Y"), "px4": ("SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF")}
"""Parameters that a level calibration sets: in rad for ArduPilot, degrees for PX4."""
CALIBRATE_WITHIN_S = 420.0
"""Timeout of the companion's calibration of two IMUs on a busy machine."""
OWN_TRIES = 3
"""Number of tries of the firmware's own gyro calibration: it averages 0.25 s, so one result can be good by chance."""
STILL = "[calibration]\nmin_still_s = 60\nmax_s = 60\n"
"""Settings to measure a whole minute, as for the figures of autopilots 9.3.

By default the companion stops where the part's flicker, known from its profile, makes more averaging useless.
"""
DECK = """
[vehicle]
platform = "deck"
[calibration]
at_arm = "off"
target_gyro_sigma_deg_h = 500
target_accel_sigma_mg = 5
"""
"""On a sea: only on request, and as soon as a minute is heard; `--listen` makes it longer."""
SLOW = 0.95
UNITS = np.array([DEG_H] * 3 + [MG] * 3)


@dataclass(frozen=True, slots=True)
class Row:
    what: str
    instance: int
    left: Array
    """Reading minus truth: three rates in rad/s, three specific forces in m/s^2."""

    def __str__(self) -> str:
        values = self.left / UNITS
        rms = np.sqrt((values.reshape(2, 3) ** 2).mean(axis=1))
        return (
            f"{self.what:44} {self.instance:>3} {values[0]:+9.1f} {values[1]:+9.1f} {values[2]:+9.1f} {rms[0]:8.1f}"
            f" {values[3]:+9.3f} {values[4]:+9.3f} {values[5]:+9.3f} {rms[1]:8.3f}"
        )


HEADER = (
    f"{'residual by telemetry, reading - truth':44} {'IMU':>3} {'gyro x':>9} {'y':>9} {'z deg/h':>9} {'rms':>8}"
    f" {'accel x':>9} {'y':>9} {'z mg':>9} {'rms':>8}"
)


@contextlib.asynccontextmanager
async def ground_station(vehicle: FirmwareVehicle) -> AsyncIterator[GroundStation]:
    """Run a ground station on the vehicle's ground link, with a heartbeat."""
    station = GroundStation(vehicle.firmware, vehicle=vehicle.system_id)
    if vehicle.firmware == "px4":
        end = await open_udp(station, target=vehicle.ground_target)
    else:
        end = await open_udp(station, listen=vehicle.ground_target)
    beating = asyncio.create_task(station.run(), name="ground station")
    try:
        yield station
    finally:
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)
        end.close()


async def own_calibration(vehicle: FirmwareVehicle, ground: GroundStation, *params: float) -> str:
    """Run MAV_CMD_PREFLIGHT_CALIBRATION until it ends; return its answer and texts."""
    loop = asyncio.get_running_loop()
    since_s = loop.time()
    result = await ground.command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, *params, wait_s=OWN_CALIBRATION_S)
    texts: list[str] = []

    def over() -> bool:
        said = ground.all(mavlink.MAVLink_statustext_message, since_s=since_s)
        texts[:] = dict.fromkeys(message.text.strip() for message in said)
        return any("calibration done" in text or "calibration failed" in text for text in texts)

    if vehicle.firmware == "px4":  # it answers before it has begun, and says no word of a quick one
        with contextlib.suppress(TimeoutError):
            await ground.wait_for(over, QUIET_S if params == QUICK else OWN_CALIBRATION_S * 3.0, "its end")
    else:
        await asyncio.sleep(QUIET_S)
    over()
    named = mavlink.enums["MAV_RESULT"].get(result)
    name = "no answer" if named is None else named.name.removeprefix("MAV_RESULT_").lower()
    return f"{name} after {loop.time() - since_s:.0f} s: {'; '.join(texts) or 'no word'}"


async def report(
    vehicle: SitlVehicle, folder: Path, more: str, *, listen_s: float = 0.0, own: bool = True,
    companion: bool = True,
) -> int:  # fmt: skip
    """Start the firmware, calibrate it in every way, print the table; return the exit code (1: the companion failed).

    Args:
        vehicle: not running yet.
        folder: existing folder for the companion's files.
        more: further lines of the companion's configuration.
        listen_s: time for which the companion hears the sensors before the request.
        own: include the firmware's own calibrations.
        companion: include ours.
    """
    async with vehicle, ground_station(vehicle) as ground:
        p = vehicle.aircraft.pose
        print(f"pitch {p.pitch_deg:g}, roll {p.roll_deg:g}, heading {p.heading_deg:g} deg; looks of {OBSERVE_S:g} s")
        print(HEADER, flush=True)
        for instance in vehicle.instances:
            bias = vehicle.true_bias(instance, vehicle.now_s)
            print(Row("(the true bias)", instance, np.concatenate(bias)), flush=True)
        await asyncio.sleep(SETTLE_S)
        if own:
            await _look(vehicle, ground, "as it came")
            await _own_calibrations(vehicle, ground)
        if own and companion:
            await vehicle.factory_reset()
            await asyncio.sleep(SETTLE_S)
        return await _companion(vehicle, ground, folder, more, listen_s) if companion else 0


async def _companion(vehicle: SitlVehicle, ground: GroundStation, folder: Path, more: str, listen_s: float) -> int:
    try:
        async with companion_daemon(vehicle, folder, more=more) as daemon:
            await vehicle.sleep(listen_s)
            record = await daemon.calibrate(CALIBRATE_WITHIN_S)
    except (RuntimeError, TimeoutError) as error:
        print(f"companion: {error}", file=sys.stderr)
        return 1
    outcome = f"{record['state']} in {record['duration_s']:.0f} s"
    for imu in record["imus"]:
        print(f"imu {imu['name']}: {imu['samples']} samples; {'; '.join(imu['warnings'])}", file=sys.stderr)
    print("; ".join([record["reason"], *record["warnings"]]), file=sys.stderr)
    await _look(vehicle, ground, f"companion ({outcome})")
    if record["state"] != "done":
        print(f"companion: {record['state']}: {record['reason']}", file=sys.stderr)
        return 1
    await vehicle.power_cycle()
    await asyncio.sleep(SETTLE_S)
    await _look(vehicle, ground, "companion, after a power cycle")
    return 0


async def _own_calibrations(vehicle: SitlVehicle, ground: GroundStation) -> None:
    for number in range(1, OWN_TRIES + 1):
        print(f"  {await own_calibration(vehicle, ground, *GYROS)}")
        await _look(vehicle, ground, f"own gyro calibration (param1 = 1), no. {number}", OBSERVE_S / OWN_TRIES)
    print(f"  {await own_calibration(vehicle, ground, *QUICK)}")
    await _look(vehicle, ground, f"own accelerometer calibration ({_QUICK_NAME[vehicle.firmware]})")
    names = _LEVEL[vehicle.firmware]
    before = [await ground.get(name) for name in names]
    print(f"  {await own_calibration(vehicle, ground, *LEVEL)}")
    for name, was in zip(names, before, strict=True):
        print(f"  own level calibration (param5 = 2): {name} {was:.4f}, now {await ground.get(name):.4f}", flush=True)


async def _look(vehicle: SitlVehicle, ground: GroundStation, what: str, seconds: float = OBSERVE_S) -> None:
    for instance in vehicle.instances:
        loop = asyncio.get_running_loop()
        begun_s, physics_s = loop.time(), vehicle.physics_s
        row = Row(what, instance, await residual(vehicle, ground, instance, seconds))
        print(row, flush=True)
        if (speed := (vehicle.physics_s - physics_s) / (loop.time() - begun_s)) < SLOW:
            print(f"  (the firmware ran at {speed:.0%} of real time: fewer readings, more noise)", flush=True)
