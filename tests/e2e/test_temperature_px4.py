"""Curves over temperature into PX4's thermal compensation, and back."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.autopilot.firmware.px4 import SLOTS, THERMAL_ENABLE, thermal_names
from sim.imu_model import DEG_H
from tests.e2e.test_temperature_write import Warm, truth
from tests.support.virtual_time import run_virtual

QUIET = {"IMU_GYRO_CAL_EN": 0, "SENS_IMU_AUTOCAL": 0}
NAMES = [THERMAL_ENABLE, *(name for sensor in range(SLOTS) for name in thermal_names(sensor))]
OFFSETS = [f"CAL_GYRO0_{axis}OFF" for axis in "XYZ"]


class WarmPx4(Warm):
    def __init__(self, folder: Path, thermal: str, **parameters: int) -> None:
        super().__init__(folder, firmware="px4", thermal=thermal, parameters={**QUIET, **parameters})

    def values(self) -> dict[str, float]:
        return {name: self.px4.parameter(name) for name in (*NAMES, *OFFSETS)}

    def now_deg_h(self) -> Any:
        return self.px4.residual(1, self.now_s).gyro_rad_s / DEG_H

    async def reboot(self) -> None:
        await self.rest(4.0)
        self.px4.reboot()
        await self.rest(15.0)
        await self.ready()
        await self.rest(15.0)


def taken_deg_h(rig: WarmPx4) -> Any:
    """By PX4's formula, of the parameters as they are; the board is not turned."""
    values, own = rig.values(), "TC_G0_"
    held = min(max(rig.model.temperature_degc(0.0), values[f"{own}TMIN"]), values[f"{own}TMAX"])
    d = held - values[f"{own}TREF"]
    return sum(np.array([values[f"{own}X{n}_{axis}"] for axis in range(3)]) * d**n for n in range(4)) / DEG_H


def test_a_curve_acts_after_the_switch_and_a_boot_and_is_undone_to_the_bit(tmp_path: Path) -> None:
    async def main() -> None:
        rig = WarmPx4(tmp_path, "started")
        async with rig.running():
            await rig.learn()
            before, left = rig.values(), rig.now_deg_h()
            reply = await rig.ask(action="write")
            assert reply["state"] == "done", reply
            assert reply["reason"] == "TC_G_ENABLE is on now: reboot PX4, then companion temperature --write once more"
            # Without the boot nothing acts, and what was tried is put back.
            switched = rig.values()
            reply = await rig.ask(action="write")
            assert reply["state"] == "failed", reply
            assert "TC_G0 has no effect: reboot PX4" in reply["reason"]
            assert rig.values() == switched
            await rig.reboot()
            at_write = rig.model.temperature_degc(0.0)
            reply = await rig.ask(action="write")
            assert (reply["state"], reply["reason"]) == ("done", "written: fc, 13 to 34 degC"), reply
            assert {name: rig.values()[name] for name in OFFSETS} == {name: before[name] for name in OFFSETS}
            for degc in (20.0, 14.0, 28.0, 33.0):
                rig.degc = degc
                await asyncio.sleep(2.5)
                warmer = truth(rig.model.temperature_degc(0.0)) - truth(at_write)
                np.testing.assert_allclose(rig.now_deg_h(), left + warmer - taken_deg_h(rig), atol=0.1)
                # The curve is of few points, and PX4 keeps no coefficient below 2^-23.
                np.testing.assert_allclose(rig.now_deg_h(), left, atol=20.0)
            rig.degc = 20.0
            await rig.rest(15.0)
            for _ in range(2):
                assert (await rig.ask(action="undo"))["state"] == "done"
            assert rig.values() == before
            np.testing.assert_allclose(rig.now_deg_h(), left, atol=1.0)

    run_virtual(main())


@pytest.mark.parametrize(("thermal", "why"), [("absent", "this PX4 has no thermal compensation")])
def test_without_the_module_it_is_refused_in_one_line(tmp_path: Path, thermal: str, why: str) -> None:
    async def main() -> None:
        rig = WarmPx4(tmp_path, thermal)
        async with rig.running():
            await rig.learn()
            reply = await rig.ask(action="write")
            assert reply["state"] == "failed"
            assert reply["reason"].startswith(why), reply

    run_virtual(main())


def test_where_it_runs_without_this_gyro_it_is_asked_for_twice_without_a_boot(tmp_path: Path) -> None:
    async def main() -> None:
        rig = WarmPx4(tmp_path, "started", TC_G_ENABLE=1)
        async with rig.running():
            await rig.learn()
            before = rig.values()
            assert (await rig.ask(action="write"))["reason"].endswith("companion temperature --write once more")
            assert (await rig.ask(action="write"))["reason"] == "written: fc, 13 to 34 degC"
            for _ in range(2):
                assert (await rig.ask(action="undo"))["state"] == "done"
            assert rig.values() == before

    run_virtual(main())
