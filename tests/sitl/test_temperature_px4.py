"""A real PX4 whose gyros follow the temperature: what is learned of them, foretold, and written into TC_*.

Its thermal compensation is built for SITL, though only a board's start script starts it: an airframe's second script
does so here. HIL_SENSOR tells the temperature.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array
from sim.imu_model import DEG_H, MG
from sim.motions import Handling
from sim.scenario import DEMO_POSE, Scenario, demo
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import MODEL, Px4Sitl
from sim.sitl.residuals import ground_station
from sim.thermal import Curve
from tests.sitl.craft import BINARIES, missing
from tests.sitl.px4_bench import SAVED_S, changed
from tests.sitl.test_temperature import another_day, predicted, typed
from tests.support.extent import extent

USUAL_DEG_H = np.array([[500.0, -700.0, 1000.0], [-90.0, -60.0, 40.0]])
"""At 25 degC, of the two IMUs."""
POWERS_DEG_H = (
    ((20.0, -12.0, 8.0), (0.5, 0.4, -0.3), (0.02, -0.015, 0.01)),
    ((-15.0, 10.0, 25.0), (-0.4, 0.2, 0.3), (-0.03, 0.025, 0.02)),
)
"""A kelvin, square kelvin, cubic kelvin, from 25 degC."""
SCATTER_DEG_H = 15.0
"""From one power-up to the next."""
LEARNED_DEGC = (16.0, 36.0, 26.0, 31.0, 21.0)
FORETOLD_DEGC = 33.5
LOOKS_DEGC = (18.0, 23.0, 34.0)
LOOK_S, WITHIN_DEG_H = 60.0, 5.0
"""Noise leaves 1.4 deg/h of it."""
ACCEL_MG = (1.0, -2.0, 3.0)
QUIET = {"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0}
QUICK = '\n[calibration]\nmin_still_s = 10\nmax_s = 15\nat_arm = "{}"\n'
ONLY_LOOKS = "[push]\nparameters = false\n"
CARRIED_S = 60.0
SETTLE_S = 10.0
TC = ["TC_G_ENABLE"]
for sensor in range(4):
    TC += [f"TC_G{sensor}_{name}" for name in ("ID", "TREF", "TMIN", "TMAX")]
    TC += [f"TC_G{sensor}_X{power}_{axis}" for power in range(4) for axis in range(3)]


class Warm(Px4Sitl):
    """On an aircraft as warm as `degc` says; each power-up has biases of its own."""

    def __init__(self, folder: Path) -> None:
        reason = missing("px4-sitl")
        if reason is not None:
            pytest.skip(reason)
        binary = Path(os.environ[BINARIES["px4-sitl"]])
        super().__init__(binary, self._scenario(), folder / "px4", etc=_with_module(binary, folder), parameters=QUIET)
        self.degc = 25.0

    def _scenario(self) -> Scenario:
        made = demo(pose=DEMO_POSE, part="white_only", seed=1)
        for imu, powers in zip(made.flight_controller_imus, POWERS_DEG_H, strict=False):
            imu.curve = Curve(tuple(np.array([*power, 0.0, 0.0, 0.0]) * DEG_H for power in powers))
        made.aircraft._temperature = lambda _t_s: self.degc
        return made

    def turn(self, day: int) -> None:
        """As it comes up on another day."""
        random = np.random.default_rng([3, day])
        for imu, usual in zip(self.imus, USUAL_DEG_H, strict=True):
            imu.turn_on(random.normal(usual, SCATTER_DEG_H) * DEG_H, np.array(ACCEL_MG) * MG)

    async def another(self, day: int, degc: float) -> None:
        """Off, and on again at a temperature."""
        await self.sleep(SAVED_S)
        await self.power_off()
        self.degc = degc
        self.turn(day)
        await self.power_on()

    def bias_deg_h(self, instance: int = 1) -> Array:
        """The truth."""
        return np.asarray(self.true_bias(instance, self.now_s).gyro_rad_s / DEG_H)


def _with_module(binary: Path, folder: Path) -> Path:
    own = Path(os.environ.get("PX4_SITL_ETC") or binary.parent.parent / "etc")
    etc = folder / "etc"
    if not etc.exists():
        shutil.copytree(own, etc)
        (airframe,) = (etc / "init.d-posix" / "airframes").glob(f"*_{MODEL}")
        airframe.with_name(f"{airframe.name}.post").write_text("#!/bin/sh\n. ${R}etc/init.d/rc.thermal_cal\n")
    return etc


@contextlib.asynccontextmanager
async def flying(folder: Path, day: int, degc: float) -> AsyncIterator[tuple[Warm, GroundStation]]:
    vehicle = Warm(folder)
    vehicle.degc = degc
    vehicle.turn(day)
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        yield vehicle, ground


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What companion and PX4 have stored after five power-ups, at the last of which it was calibrated.

    Of the first IMU: where nothing is written, the second one's integers tell nothing.
    """
    folder = tmp_path_factory.mktemp("learned")

    async def main() -> None:
        (folder / "daemon").mkdir()
        async with flying(folder, 0, LEARNED_DEGC[0]) as (vehicle, _):
            for day, degc in enumerate(LEARNED_DEGC):
                last = degc == LEARNED_DEGC[-1]
                if day:
                    await vehicle.another(day, degc)
                more = QUICK.format("off") + ("" if last else ONLY_LOOKS)
                async with companion_daemon(vehicle, folder / "daemon", more=more) as daemon:
                    record = await daemon.calibrate(120.0)
                    assert record["state"] == "done", (record, daemon.log())
                    found = np.array(record["imus"][0]["gyro_bias_rad_s"]) / DEG_H
                    print(degc, np.round(found, 1), np.round(vehicle.bias_deg_h(), 1), flush=True)
                another_day(folder / "daemon" / "state", day)
            await vehicle.sleep(SAVED_S)

    asyncio.run(main())
    return folder


def copied(learned: Path, to: Path) -> Path:
    return Path(shutil.copytree(learned, to, dirs_exist_ok=True, symlinks=True))


@pytest.mark.sitl
def test_offsets_are_foretold_at_another_temperature_before_it_has_stood_still(learned: Path, tmp_path: Path) -> None:
    async def main() -> None:
        folder = copied(learned, tmp_path)
        async with flying(folder, len(LEARNED_DEGC), FORETOLD_DEGC) as (vehicle, ground):
            was = vehicle.bias_deg_h() - await held_deg_h(ground)
            vehicle.move([Handling(start_s=vehicle.now_s - 10.0, duration_s=CARRIED_S, angle_deg=6.0)])
            async with companion_daemon(vehicle, folder / "daemon", more=QUICK.format("warn")) as daemon:
                sigma_deg_h = await predicted(daemon, 40.0)
                left = vehicle.bias_deg_h() - await held_deg_h(ground)
            print("was", np.round(was), "left", np.round(left, 1), "said", sigma_deg_h, flush=True)
            assert np.abs(left).max() < 2.0 * sigma_deg_h < np.abs(was).max()

    asyncio.run(main())


async def held_deg_h(ground: GroundStation) -> Array:
    """The offsets of the first IMU."""
    return np.array([await ground.get(f"CAL_GYRO0_{axis}OFF") for axis in "XYZ"]) / DEG_H


async def left_deg_h(vehicle: Warm, ground: GroundStation) -> Array:
    """In the telemetry of the first IMU, in floats: with EKF2_IMU_CTRL so, HIGHRES_IMU is without the EKF's bias."""
    assert await ground.get("EKF2_IMU_CTRL") == 6.0
    await vehicle.fly_by(1)  # it is of the primary IMU, which may be another one by now
    await vehicle.sleep(1.0)
    begun_s = vehicle.now_s
    rows = await ground.imu(mavlink.MAVLink_highres_imu_message, LOOK_S, rate_hz=250.0)
    truth = np.concatenate(vehicle.aircraft.truth(np.linspace(begun_s, vehicle.now_s, 301)), axis=1).mean(axis=0)
    return np.asarray((rows.mean(axis=0) - truth)[:3] / DEG_H)


async def taken_off_deg_h(ground: GroundStation, degc: float) -> Array:
    """Of the first IMU, by PX4's formula and its parameters as they are."""
    values = {name: await ground.get(name) for name in TC if name.startswith("TC_G0_")}
    d = min(max(degc, values["TC_G0_TMIN"]), values["TC_G0_TMAX"]) - values["TC_G0_TREF"]
    curve = sum(np.array([values[f"TC_G0_X{power}_{axis}"] for axis in range(3)]) * d**power for power in range(4))
    return np.asarray(curve / DEG_H) + await held_deg_h(ground)


async def all_parameters(ground: GroundStation) -> dict[str, float]:
    """What PX4 lists, and those of its compensation, which it does not while that is off."""
    return await ground.whole_list() | {name: await ground.get(name) for name in TC}


@pytest.mark.sitl
def test_what_is_written_acts_as_predicted_and_undo_leaves_no_bit_of_it(learned: Path, tmp_path: Path) -> None:
    if missing("px4-sitl") is None and not extent(whole=True, a_slice=False):
        pytest.skip("with looks of a minute it takes five; TESTS=long does them")

    async def main() -> None:
        folder = copied(learned, tmp_path)
        async with flying(folder, len(LEARNED_DEGC), 26.0) as (vehicle, ground):
            await vehicle.sleep(SETTLE_S)
            before = await all_parameters(ground)
            async with companion_daemon(vehicle, folder / "daemon", more=QUICK.format("off")) as daemon:
                first = await typed(daemon, "--write")
                assert str(first["reason"]).startswith("TC_G_ENABLE is on now: reboot PX4"), (first, daemon.log())
                await vehicle.another(len(LEARNED_DEGC), 26.0)
                await vehicle.sleep(SETTLE_S)
                second = await typed(daemon, "--write")
                assert str(second["reason"]).startswith("written: fc1, 16 to 36 degC"), (second, daemon.log())
                await ground.put("EKF2_IMU_CTRL", 6.0)
                off = {}
                for degc in LOOKS_DEGC:
                    vehicle.degc = degc
                    await vehicle.sleep(3.0)
                    foretold = vehicle.bias_deg_h() - await taken_off_deg_h(ground, degc)
                    left = await left_deg_h(vehicle, ground)
                    print(degc, "left", np.round(left, 1), "foretold", np.round(foretold, 1), flush=True)
                    off[degc] = np.abs(left - foretold).max()
                await ground.put("EKF2_IMU_CTRL", before["EKF2_IMU_CTRL"])
                vehicle.degc = 26.0
                for _ in range(2):
                    undone = await typed(daemon, "--undo")
                    assert undone["state"] == "done", (undone, daemon.log())
                assert not changed(before, await all_parameters(ground))
            await vehicle.another(len(LEARNED_DEGC), 26.0)
            await vehicle.sleep(SETTLE_S)
            assert not changed(before, await all_parameters(ground))
            assert max(off.values()) < WITHIN_DEG_H, off

    asyncio.run(main())
