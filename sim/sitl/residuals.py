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
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.observe import residual
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle
from sim.udp import open_udp

OBSERVE_S = 60.0
"""Length of each look."""
SETTLE_S = 40.0
"""After a start: the estimator has its position and the first transients are over."""
OWN_CALIBRATION_S = 60.0
"""ArduPilot's gyro calibration gives up after about 30 s; it must not be asked twice (autopilots 9.3.1)."""
QUIET_S = 3.0
GYROS, QUICK, LEVEL = (1.0,), (0.0, 0.0, 0.0, 0.0, 4.0), (0.0, 0.0, 0.0, 0.0, 2.0)
"""Parameters of MAV_CMD_PREFLIGHT_CALIBRATION: gyros; accelerometers by one pose; what is level."""
_QUICK_NAME = {"ardupilot": "simple, param5 = 4", "px4": "quick, param5 = 4"}
_LEVEL = {"ardupilot": ("AHRS_TRIM_X", "AHRS_TRIM_Y"), "px4": ("SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF")}
"""What a level calibration sets: rad, degrees."""
CALIBRATE_WITHIN_S = 420.0
"""Two IMUs, on a busy machine."""
OWN_TRIES = 3
"""Of the firmware's own gyro calibration: its quarter second of averaging gives another result each time, and one
may be good by chance."""
STILL = "[calibration]\nmin_still_s = 60\nmax_s = 60\n"
"""A whole minute, as the figures of autopilots 9.3. By itself the companion stops where the part's flicker, which its
profile knows, makes more averaging worthless; a part of white noise only has none."""
DECK = """
[vehicle]
platform = "deck"
[calibration]
at_arm = "off"
target_gyro_sigma_deg_h = 500
target_accel_sigma_mg = 5
"""
"""On a sea: when it is asked, not by itself, and as soon as it has heard a minute; for longer there is `--listen`."""
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
async def ground_station(vehicle: FirmwareVehicle) -> AsyncIterator[GroundStation]:
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


async def own_calibration(vehicle: FirmwareVehicle, ground: GroundStation, *params: float) -> str:
    """MAV_CMD_PREFLIGHT_CALIBRATION until it is over; how it answered, and what it said."""
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
    """Start the firmware, calibrate it in every way, print the table; the exit code (1: the companion failed).

    Args:
        vehicle: not running yet.
        folder: for the companion's files; exists.
        more: further lines of the companion's configuration.
        listen_s: how long the companion hears the sensors before it is asked.
        own: whether the firmware's own calibrations are wanted in the table.
        companion: whether ours is.
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
