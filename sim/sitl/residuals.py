"""What each calibration leaves in a real autopilot, seen by its telemetry beside the truth (autopilots 9.3)."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array
from sim.imu_model import DEG_H, MG
from sim.sitl.daemon import companion_daemon, instances_of
from sim.sitl.ground import GroundStation
from sim.sitl.observe import residual
from sim.sitl.vehicle import SitlVehicle
from sim.udp import open_udp

SETTLE_S = 40.0
"""After a start: the estimator has its position and the first transients are over."""
OWN_CALIBRATION_S = 35.0
"""ArduPilot's gyro calibration gives up after about 30 s; it must not be asked twice (autopilots 9.3.1)."""
CALIBRATE_WITHIN_S = 420.0
"""Two IMUs whose offsets are dithered one after the other, on a busy machine."""
OWN_TRIES = 3
"""Of the firmware's own gyro calibration: its quarter second of averaging gives another result each time, and one
may be good by chance."""
STILL = "[calibration]\nmin_still_s = 60\nmax_s = 60\n"
"""A whole minute, as the figures of autopilots 9.3. By itself the companion stops where the part's flicker, which its
profile knows, makes more averaging worthless; a part of white noise only has none."""
SLOW = 0.95
UNITS = np.array([DEG_H] * 3 + [MG] * 3)


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

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
async def ground_station(vehicle: SitlVehicle) -> AsyncIterator[GroundStation]:
    """A ground station on the vehicle's ground link, with a heartbeat."""
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


async def own_gyro_calibration(vehicle: SitlVehicle, ground: GroundStation) -> int:
    """MAV_CMD_PREFLIGHT_CALIBRATION param1 = 1, until it is over; returns the result of the command.

    Raises:
        TimeoutError: PX4 does not say that it is done.
    """
    since_s = asyncio.get_running_loop().time()
    result = await ground.command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1.0, wait_s=OWN_CALIBRATION_S)
    if vehicle.firmware == "px4":
        await ground.wait_for(
            lambda: any(
                "calibration done" in message.text or "calibration failed" in message.text
                for message in ground.all(mavlink.MAVLink_statustext_message, since_s=since_s)
            ),
            OWN_CALIBRATION_S,
            "[cal] calibration done",
        )
    return result


async def own_accel_calibration(vehicle: SitlVehicle, ground: GroundStation) -> int:
    """MAV_CMD_PREFLIGHT_CALIBRATION param5 = 4, simple (ArduPilot) or quick (PX4); returns the result."""
    result = await ground.command(
        mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 0.0, 0.0, 0.0, 0.0, 4.0, wait_s=OWN_CALIBRATION_S
    )
    await asyncio.sleep(3.0)  # PX4 answers before it has begun
    return result


async def report(vehicle: SitlVehicle, folder: Path, observe_s: float, more: str = STILL, *, own: bool = True) -> int:
    """Start the firmware, calibrate it in every way, print the table; the exit code (1: the companion failed).

    Args:
        vehicle: not running yet.
        folder: for the companion's files; exists.
        observe_s: length of each look.
        more: further lines of the companion's configuration.
        own: whether the firmware's own calibrations are wanted in the table.
    """
    async with vehicle, ground_station(vehicle) as ground:
        p = vehicle.aircraft.pose
        print(f"pitch {p.pitch_deg:g}, roll {p.roll_deg:g}, heading {p.heading_deg:g} deg; looks of {observe_s:g} s")
        print(HEADER, flush=True)
        for instance in instances_of(vehicle):
            bias = vehicle.true_bias(instance, vehicle.now_s)
            print(Row("(the true bias)", instance, np.concatenate(bias)), flush=True)
        await asyncio.sleep(SETTLE_S)
        if own:
            await _look(vehicle, ground, "as it came", observe_s)
            await _own_calibrations(vehicle, ground, observe_s)
            await vehicle.factory_reset()
            await asyncio.sleep(SETTLE_S)
        try:
            async with companion_daemon(vehicle, folder, more=more) as daemon:
                record = await daemon.calibrate(CALIBRATE_WITHIN_S)
        except (RuntimeError, TimeoutError) as error:
            print(f"companion: {error}", file=sys.stderr)
            return 1
        outcome = f"{record['state']} in {record['duration_s']:.0f} s"
        for imu in record["imus"]:
            print(f"imu {imu['name']}: {imu['samples']} samples; {'; '.join(imu['warnings'])}", file=sys.stderr)
        print("; ".join([record["reason"], *record["warnings"]]), file=sys.stderr)
        await _look(vehicle, ground, f"companion ({outcome})", observe_s)
        if record["state"] != "done":
            print(f"companion: {record['state']}: {record['reason']}", file=sys.stderr)
            return 1
        await vehicle.power_cycle()
        await asyncio.sleep(SETTLE_S)
        await _look(vehicle, ground, "companion, after a power cycle", observe_s)
        return 0


async def _own_calibrations(vehicle: SitlVehicle, ground: GroundStation, observe_s: float) -> None:
    for number in range(1, OWN_TRIES + 1):
        await own_gyro_calibration(vehicle, ground)
        await _look(vehicle, ground, f"own gyro calibration (param1 = 1), no. {number}", observe_s / OWN_TRIES)
    await own_accel_calibration(vehicle, ground)
    await _look(vehicle, ground, f"own accelerometer calibration ({_accel_name(vehicle)})", observe_s)


def _accel_name(vehicle: SitlVehicle) -> str:
    return "simple, param5 = 4" if vehicle.firmware == "ardupilot" else "quick, param5 = 4"


async def _look(vehicle: SitlVehicle, ground: GroundStation, what: str, seconds: float) -> None:
    for instance in instances_of(vehicle):
        loop = asyncio.get_running_loop()
        begun_s, physics_s = loop.time(), vehicle.physics_s
        row = Row(what, instance, await residual(vehicle, ground, instance, seconds))
        print(row, flush=True)
        if (speed := (vehicle.physics_s - physics_s) / (loop.time() - begun_s)) < SLOW:
            print(f"  (the firmware ran at {speed:.0%} of real time: fewer readings, more noise)", flush=True)
