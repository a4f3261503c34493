"""Heading error that each compass calibration leaves on a real autopilot, all round, as a table."""

from __future__ import annotations

import asyncio
import math
import sys
from pathlib import Path
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array, body_from_ned
from sim.firmware.compass import SimCompass, corrected
from sim.hands import AHEAD_S, SIDES, Hands
from sim.motions import Turn
from sim.sitl.daemon import companion_daemon, obeyed
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import SETTLE_S, ground_station
from sim.sitl.vehicle import SitlVehicle

HARD_MGAUSS: Final = (110.0, -80.0, 62.0)
SOFT: Final = np.array([[1.05, 0.02, -0.03], [0.02, 0.95, 0.015], [-0.03, 0.015, 1.03]])
"""Iron of the compass: 150 mG, 5 %."""
HEADINGS: Final = (2, 4, 8)
WRONG_DEG: Final = 3.0
STORED_S: Final = 3.0
DETECTED_S: Final = 4.0
"""Time in which PX4 sees on which side the aircraft lies."""
SPIN_S: Final = 16.0
EDGES: Final = [(pitch, roll) for roll in (0.0, 180.0) for pitch in (45.0, -45.0)] + [
    (0.0, roll) for roll in (45.0, -45.0, 135.0, -135.0)
]
"""Pitch and roll between two sides. ArduPilot wants 300 samples 6.3 deg apart (CompassCalibrator.cpp, accept_sample);
six circles, one for each side, have room for 170."""
NO_IRON: Final = np.array([[0.0] * 3, [1.0] * 3, [0.0] * 3])
_AXES: Final = "XYZ"
NAMES: Final = {
    "ardupilot": [[f"COMPASS_{what}_{axis}" for axis in _AXES] for what in ("OFS", "DIA", "ODI")],
    "px4": [[f"CAL_MAG0_{axis}{what}" for axis in _AXES] for what in ("OFF", "SCALE", "ODIAG")],
}
"""Parameters of the first compass: offsets, diagonal, elements beside it."""
MGAUSS: Final = {"ardupilot": 1.0, "px4": -1e3}


def heading_errors_deg(parameters: Array, firmware: str, field_ned_mgauss: Array, lean: tuple[float, float]) -> Array:
    """Return the errors (36,) of the heading that these parameters give, every 10 degrees, at pitch and roll in deg."""
    offset, diagonal, beside = parameters
    pitch, roll = np.radians(lean).tolist()
    declination = math.atan2(field_ned_mgauss[1], field_ned_mgauss[0])
    errors = []
    for heading in np.radians(np.arange(0.0, 360.0, 10.0)).tolist():
        raw = np.linalg.solve(SOFT, body_from_ned(roll, pitch, heading) @ field_ned_mgauss) - HARD_MGAUSS
        field = corrected(raw, MGAUSS[firmware] * offset, diagonal, beside)
        ahead, right, _ = body_from_ned(roll, pitch, 0.0).T @ field
        errors.append(math.degrees(math.remainder(math.atan2(-right, ahead) + declination - heading, math.tau)))
    return np.array(errors)


async def report(vehicle: SitlVehicle, folder: Path) -> int:
    """Start the firmware, calibrate its compass in every way, print the table; return the exit code."""
    hands = Hands(vehicle.aircraft, placement_deg=0.1, seed=1, takes_s=2.0)
    async with vehicle, ground_station(vehicle) as ground:
        await add_iron(vehicle, ground)
        await asyncio.sleep(SETTLE_S)
        pose = vehicle.aircraft.pose
        where = f"pitch {pose.pitch_deg:g}, roll {pose.roll_deg:g} deg"
        print(f"{vehicle.firmware}, {where}: heading error all round, rms and largest, deg", flush=True)
        await _reset(vehicle, ground)
        await _look(vehicle, ground, "factory zero")
        for off_deg in (0.0, WRONG_DEG):
            await _reset(vehicle, ground)
            heading_deg = math.degrees(vehicle.aircraft.angles_rad(vehicle.now_s)[2]) + off_deg
            result = await ground.command(mavlink.MAV_CMD_FIXED_MAG_CAL_YAW, heading_deg % 360.0)
            await _look(vehicle, ground, f"42006, heading {off_deg:g} deg wrong (result {result})")
        failed = 0
        for headings in HEADINGS:
            await _reset(vehicle, ground)
            async with companion_daemon(vehicle, folder) as daemon:
                words = "align", "compass", "--headings", str(headings), "--write"
                try:
                    said = await obeyed(daemon, hands, vehicle, *words)
                except RuntimeError as error:
                    print(error, file=sys.stderr)
                    failed = 1
                    continue
            done = next((line for line in said.splitlines() if line.startswith("DONE")), "no result")
            await _look(
                vehicle, ground, f"companion, {headings} headings ({done.partition(': ')[2].partition(',')[0]})"
            )
        # The last one, because ArduPilot's writes COMPASS_SCALE too.
        await _reset(vehicle, ground)
        await _look(vehicle, ground, f"own rotation on all sides ({await _own_rotation(vehicle, ground, hands)})")
        return failed


async def _own_rotation(vehicle: SitlVehicle, ground: GroundStation, hands: Hands) -> str:
    """Run the firmware's own compass calibration: spin the aircraft in each pose until it is done; return its word."""
    since_s = asyncio.get_running_loop().time()
    if isinstance(vehicle, Px4Sitl):
        await ground.command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 0.0, 1.0)
    else:
        await ground.stream(mavlink.MAVLINK_MSG_ID_MAG_CAL_REPORT, 1.0)
        await ground.command(mavlink.MAV_CMD_DO_START_MAG_CAL, 1.0, 0.0, 1.0)

    def word() -> str:
        if reports := ground.all(mavlink.MAVLink_mag_cal_report_message, since_s=since_s):
            return f"status {reports[-1].cal_status}, fitness {reports[-1].fitness:.1f}"
        said = [one.text.strip() for one in ground.all(mavlink.MAVLink_statustext_message, since_s=since_s)]
        return next((text for text in said if "calibration done" in text or "calibration failed" in text), "")

    for pitch, roll in (*SIDES.values(), *EDGES, *SIDES.values()):
        if not word():
            await vehicle.sleep(hands.hold(vehicle.now_s + AHEAD_S, pitch, roll) - vehicle.now_s + DETECTED_S)
            spin = Turn(start_s=vehicle.now_s + AHEAD_S, duration_s=SPIN_S, heading_deg=360.0)
            vehicle.aircraft.add(spin)
            await vehicle.sleep(SPIN_S + DETECTED_S)
    await vehicle.sleep(hands.back(vehicle.now_s + AHEAD_S) - vehicle.now_s + STORED_S)
    return word() or "no word"


async def add_iron(vehicle: SitlVehicle, ground: GroundStation) -> None:
    if isinstance(vehicle, Px4Sitl):
        vehicle.backend.compass = SimCompass(HARD_MGAUSS, SOFT)
        return
    beside = [SOFT[0, 1], SOFT[0, 2], SOFT[1, 2]]
    for stem, values in (("OFS", HARD_MGAUSS), ("DIA", np.diag(SOFT)), ("ODI", beside)):
        await ground.put_all(
            {f"SIM_MAG1_{stem}_{axis}": float(value) for axis, value in zip(_AXES, values, strict=True)}
        )


async def _reset(vehicle: SitlVehicle, ground: GroundStation) -> None:
    for names, values in zip(NAMES[vehicle.firmware], NO_IRON.tolist(), strict=True):
        await ground.put_all(dict(zip(names, values, strict=True)))
    await asyncio.sleep(STORED_S)


async def _look(vehicle: SitlVehicle, ground: GroundStation, what: str) -> None:
    await asyncio.sleep(STORED_S)
    found = np.array([[await ground.get(name) for name in names] for names in NAMES[vehicle.firmware]])
    field, pose = 1e3 * vehicle.aircraft.site.field_ned_gauss, vehicle.aircraft.pose
    cells = []
    for lean in ((0.0, 0.0), (pose.pitch_deg, pose.roll_deg)):
        errors = heading_errors_deg(found, vehicle.firmware, field, lean)
        cells.append(f"{math.sqrt(float(np.mean(np.square(errors)))):8.2f}{np.abs(errors).max():8.2f}")
    print(f"{what:56} level{cells[0]}   as it stands{cells[1]}", flush=True)
