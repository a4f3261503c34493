"""A real ArduPilot whose gyros follow a temperature: what the companion's curve does, and what its own learner does.

Its simulator adds a cubic about the middle of SIM_IMUT1_TMIN and TMAX, by a temperature that is fixed or warms up from
START to END after every start.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.estimation.records.history import Point, PowerUp
from companion.physics.frames import vector
from companion.storage.records import BiasStore
from sim.companion_process import CompanionProcess
from sim.earth import Array
from sim.imu_model import DEG_H, MG
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.residuals import UNITS, ground_station, residual
from tests.sitl.craft import BINARIES, missing, world
from tests.support.extent import extent

pytestmark = pytest.mark.real_clock

MIDDLE_DEGC = 35.0
CURVE = np.array([[30.0, -20.0, 12.0], [0.5, 0.8, -0.6], [0.02, -0.01, 0.03]])
"""deg/h a kelvin, square kelvin, cubic kelvin."""
IMUT = {"SIM_IMUT1_ENABLE": 1.0, "SIM_IMUT1_TMIN": 0.0, "SIM_IMUT1_TMAX": 2.0 * MIDDLE_DEGC}
IMUT |= {
    f"SIM_IMUT1_GYR{n + 1}_{axis}": float(CURVE[n, k]) * DEG_H * 1e6 for n in range(3) for k, axis in enumerate("XYZ")
}
ACCEL_CURVE = np.array([[0.2, -0.15, 0.25], [0.002, 0.0, -0.004]])
"""mg a kelvin, square kelvin."""
IMUT |= {
    f"SIM_IMUT1_ACC{n + 1}_{axis}": float(ACCEL_CURVE[n, k]) * MG * 1e6
    for n in range(2)
    for k, axis in enumerate("XYZ")
}
NAMES = [f"INS_TCAL1_{kind}{n}_{axis}" for kind in ("ACC", "GYR") for n in (1, 2, 3) for axis in "XYZ"]
NAMES += ["INS_TCAL1_TMIN", "INS_TCAL1_TMAX", "INS_TCAL1_ENABLE", "INS_GYR1_CALTEMP", "INS_ACC1_CALTEMP"]
NAMES += [f"INS_{kind}OFFS_{axis}" for kind in ("GYR", "ACC") for axis in "XYZ"]
WITHIN_DEG_H, WITHIN_MG = 5.0, 0.2
"""Limits, of 500 deg/h and 3 mg."""
LOOK_S = 12.0
"""White noise of 2 deg/h; the firmware's own of the same size."""
QUICK = '\n[calibration]\nmin_still_s = 8\nmax_s = 12\nat_arm = "off"\n'


def curve(degc: float) -> Array:
    """Curve added by the simulator, deg/h."""
    d = degc - MIDDLE_DEGC
    return np.asarray(CURVE[0] * d + CURVE[1] * d**2 + CURVE[2] * d**3)


def accel_curve(degc: float) -> Array:
    """Curve of the accelerometers added by the simulator, mg."""
    d = degc - MIDDLE_DEGC
    return np.asarray(ACCEL_CURVE[0] * d + ACCEL_CURVE[1] * d**2)


STARTS_DEGC = (6.0, 12.0, 18.0, 24.0, 30.0)
RISE_K, TCONST_S, WARM_S = 14.0, 60.0, 117.0
"""12 K, of which the companion sees the last nine or ten."""
SCATTER_DEG_H = 30.0
"""Scatter from one power-up to the next."""
LEARNER = 2
"""Power-up of the learner, of these five, in the middle of all that is judged."""
TEN_K = np.arange(0.0, 10.5, 2.0)


@contextlib.asynccontextmanager
async def flying(folder: Path, **more: float) -> AsyncIterator[tuple[ArduPilotSitl, GroundStation]]:
    reason = missing("ardupilot-sitl")
    if reason is not None:
        pytest.skip(reason)
    binary = Path(os.environ[BINARIES["ardupilot-sitl"]])
    vehicle = ArduPilotSitl(binary, world(), folder / "ap", parameters={**IMUT, **more})
    (folder / "daemon").mkdir()
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        yield vehicle, ground


async def typed(daemon: CompanionProcess, *words: str) -> dict[str, Any]:
    command = daemon.command("autopilot", "temperature", *words, "--json")
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    output, _ = await process.communicate()
    answer: dict[str, Any] = json.loads(output)
    return answer


async def left_deg_h(vehicle: ArduPilotSitl, ground: GroundStation, degc: float, look_s: float = LOOK_S) -> Array:
    """In its telemetry at a temperature."""
    return (await all_left(vehicle, ground, degc, look_s))[:3]


async def all_left(vehicle: ArduPilotSitl, ground: GroundStation, degc: float, look_s: float = LOOK_S) -> Array:
    """Residuals of all axes, deg/h and mg."""
    await ground.put("SIM_IMUT_FIXED", degc)
    await vehicle.sleep(1.5)
    return np.asarray((await residual(vehicle, ground, 1, look_s)) / UNITS)


async def first_seen(folder: Path, within_s: float = 60.0) -> None:
    """Wait until the companion has kept something."""
    async with asyncio.timeout(within_s):
        while not (folder / "state" / "biases.json").exists():
            await asyncio.sleep(0.5)


def another_day(folder: Path, day: int) -> None:
    """The companion computer is off in between, so that its next power-up is another one."""
    store = BiasStore(folder)
    known = store.read()
    store.write({
        name: msgspec.structs.replace(each, points=tuple(_on_day(point, day) for point in each.points))
        for name, each in known.items()
    })  # fmt: skip


def _on_day(point: Point, day: int) -> Point:
    if point.power_up.host.startswith("day"):
        return point
    return msgspec.structs.replace(point, power_up=PowerUp(host=f"day {day}", since_unix_s=None))


BIN_K = 0.5
"""Bin of the firmware's own learner: it counts a span as seen up to that much less."""


async def warm_up(vehicle: ArduPilotSitl, ground: GroundStation, start_degc: float, **more: float) -> None:
    """Switch it off, and on again at a temperature."""
    warm = {"SIM_IMUT_FIXED": 0.0, "SIM_IMUT_START": start_degc, "SIM_IMUT_END": start_degc + RISE_K}
    await ground.put_all({**warm, "SIM_IMUT_TCONST": TCONST_S, **more})
    await vehicle.sleep(3.0)  # until it is stored
    await vehicle.power_cycle()


async def left_over(vehicle: ArduPilotSitl, ground: GroundStation, what: str) -> dict[float, Array]:
    """In its telemetry, over all temperatures that are judged, deg/h."""
    found = {degc: await left_deg_h(vehicle, ground, degc, 5.0) for degc in np.arange(16.0, 36.5, 2.0).tolist()}
    for degc, each in found.items():
        print(f"{what} {degc:5.1f} degC", np.round(each, 1), flush=True)
    return found


def rms_over_ten_k(left: dict[float, Array]) -> dict[float, float]:
    """Residual over each ten kelvin of an aircraft calibrated in their middle, deg/h; key: their beginning."""
    return {
        low: float(np.sqrt(np.mean([np.square(left[low + d] - left[low + 4.0]) for d in TEN_K])))
        for low in left
        if low + 10.0 in left
    }


@pytest.mark.sitl
async def test_five_partial_warm_ups_leave_less_than_its_own_learner_does_after_one(tmp_path: Path) -> None:
    if missing("ardupilot-sitl") is None and not extent(whole=True, a_slice=False):
        pytest.skip("five warm-ups in real time take a quarter of an hour; TESTS=long does them")
    random = np.random.default_rng(17)
    folder = tmp_path / "daemon"
    only_looks = QUICK + "[push]\nparameters = false\n"
    async with flying(tmp_path, SIM_IMUT_FIXED=0.0) as (vehicle, ground):
        for day, start_degc in enumerate(STARTS_DEGC):
            bias = random.normal(0.0, SCATTER_DEG_H, 3) * DEG_H
            turn_on = {f"SIM_GYR1_BIAS_{axis}": float(bias[k]) for k, axis in enumerate("XYZ")}
            await warm_up(vehicle, ground, start_degc, **turn_on)
            async with companion_daemon(vehicle, folder, more=only_looks) as daemon:
                await vehicle.sleep(WARM_S - vehicle.physics_s)
                record = await daemon.calibrate(60.0)
                assert record["state"] == "done", record
                ((_, known),) = BiasStore(folder / "state").read().items()
                print(f"day {day}", [round(point.temperature_degc or 0.0, 1) for point in known.points], flush=True)
            another_day(folder / "state", day)
        # Its own learner, from start to end of the same warm-up.
        start_degc = STARTS_DEGC[LEARNER]
        learn = {"INS_TCAL1_ENABLE": 2.0, "INS_TCAL1_TMAX": start_degc + 11.8}
        none = {name: await ground.get(name) for name in NAMES}
        await warm_up(vehicle, ground, start_degc, **learn)
        await vehicle.sleep(WARM_S + 5.0 - vehicle.physics_s)
        low_degc, high_degc = [await ground.get(f"INS_TCAL1_{end}") for end in ("TMIN", "TMAX")]
        print(f"its own learner has seen {low_degc:.1f} to {high_degc:.1f} degC", flush=True)
        await ground.put("INS_TCAL1_ENABLE", 1.0)
        own = rms_over_ten_k(await left_over(vehicle, ground, "own"))
        # The switch hides the rest where it is off.
        await ground.put_all({name: value for name, value in none.items() if not name.endswith("ENABLE")})
        await ground.put("INS_TCAL1_ENABLE", 0.0)
        await ground.put("SIM_IMUT_FIXED", 26.0)
        async with companion_daemon(vehicle, folder, more=QUICK) as daemon:
            answer = await typed(daemon, "--write")
            assert answer["state"] == "done", (answer, daemon.log())
            ours = rms_over_ten_k(await left_over(vehicle, ground, "ours"))
        print("own", own, "ours", ours, flush=True)
        unseen = [low for low in ours if not low_degc - BIN_K <= low <= low + 10.0 <= high_degc + BIN_K]
        assert len(unseen) > 2
        assert all(ours[low] < own[low] / 3.0 for low in unseen), (unseen, own, ours)


@pytest.mark.sitl
async def test_what_is_written_acts_as_predicted_and_undo_leaves_no_bit_of_it(tmp_path: Path) -> None:
    async with flying(tmp_path) as (vehicle, ground):
        folder = tmp_path / "daemon"
        async with companion_daemon(vehicle, folder, more=QUICK):
            await first_seen(folder)
        store = BiasStore(folder / "state")
        ((name, known),) = store.read().items()
        first = known.points[-1]
        assert first.gyro is not None
        assert first.accel is not None
        assert first.temperature_degc is not None
        days = [
            msgspec.structs.replace(
                first,
                power_up=PowerUp(host=f"day {day}", since_unix_s=None),
                temperature_degc=float(degc),
                gyro=msgspec.structs.replace(
                    first.gyro,
                    bias=vector(first.gyro.bias + (curve(degc) - curve(first.temperature_degc)) * DEG_H),
                ),
                accel=msgspec.structs.replace(
                    first.accel,
                    bias=vector(first.accel.bias + (accel_curve(degc) - accel_curve(first.temperature_degc)) * MG),
                ),
            )
            for day, degc in enumerate(np.linspace(10.0, 40.0, 12))
        ]
        store.write({name: msgspec.structs.replace(known, points=tuple(days))})
        async with companion_daemon(vehicle, folder, more=QUICK) as daemon:
            before = {name: await ground.get(name) for name in NAMES}
            left = await all_left(vehicle, ground, 25.0)
            answer = await typed(daemon, "--write")
            assert answer["state"] == "done", (answer, daemon.log())
            for degc in (25.0, 15.0, 37.0):
                moved = await all_left(vehicle, ground, degc) - left
                print(degc, np.round(moved, 2), flush=True)
                assert np.abs(moved[:3]).max() < WITHIN_DEG_H
                assert np.abs(moved[3:]).max() < WITHIN_MG
            assert (await typed(daemon, "--undo"))["state"] == "done"
            assert {name: await ground.get(name) for name in NAMES} == before
