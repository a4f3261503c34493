"""A real PX4 whose gyros follow the temperature: what is learned of them and foretold.

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
from tests.sitl.px4_bench import SAVED_S
from tests.sitl.test_temperature import another_day, predicted

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
ACCEL_MG = (1.0, -2.0, 3.0)
QUIET = {"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0}
QUICK = '\n[calibration]\nmin_still_s = 10\nmax_s = 15\nat_arm = "{}"\n'
ONLY_LOOKS = "[push]\nparameters = false\n"
CARRIED_S = 60.0


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
