"""Curves over temperature into the autopilot's own temperature calibration, and back."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.errors import RequestRefusedError
from companion.estimation.records.history import PowerUp
from companion.storage.records import BiasStore
from sim.imu_model import DEG_H, MG
from tests.support.rig import GYRO_BIAS_DEG_H, Rig

FEW: dict[str, Any] = {"imus": 1, "min_still_s": 6.0, "max_s": 10.0, "part": "icm42688p"}
SLOPE = np.array([30.0, -20.0, 10.0])
BEND = np.array([0.4, 0.6, -0.5])
"""deg/h a kelvin, and a square kelvin, about 25 degC; vehicle FRD."""
ACCEL_SLOPE = np.array([0.2, -0.15, 0.25])
"""mg a kelvin, likewise."""
LOW_DEGC, HIGH_DEGC = 13.0, 34.0
NAMES = [f"INS_TCAL1_{kind}{n}_{axis}" for kind in ("ACC", "GYR") for n in (1, 2, 3) for axis in "XYZ"]
TCAL = [*NAMES, "INS_TCAL1_TMIN", "INS_TCAL1_TMAX", "INS_TCAL1_ENABLE", "INS_GYR1_CALTEMP", "INS_ACC1_CALTEMP"]
OFFSETS = [f"INS_{kind}OFFS_{axis}" for kind in ("GYR", "ACC") for axis in "XYZ"]


class Warm(Rig):
    """Gyros that follow the temperature by a known curve, learned on other days."""

    def __init__(self, folder: Path, **more: Any) -> None:
        super().__init__(folder, **{**FEW, **more})
        self.degc = 20.0
        self.aircraft._temperature = lambda _t_s: self.degc

        def bias_at(t_s: float) -> Any:
            both = self.model._turn_on.copy()
            degc = self.model.temperature_degc(t_s)
            both[:3] += self.model.mounting.T @ truth(degc) * DEG_H
            both[3:] += self.model.mounting.T @ ACCEL_SLOPE * (degc - 25.0) * MG
            return both

        self.model._bias_at = bias_at  # type: ignore[method-assign]

    async def learn(self) -> None:
        """Keep eight power-ups at different temperatures."""
        memory = self.service.calibrating.memory
        await self.ready()
        await self.rest()
        first = BiasStore(self.config.storage.path).read()["fc"].points[-1]
        assert first.gyro is not None
        assert first.accel is not None
        assert first.temperature_degc is not None
        at = truth(first.temperature_degc)
        for run, degc in enumerate(np.linspace(LOW_DEGC, HIGH_DEGC, 8)):
            bias = np.array(first.gyro.bias) + (truth(degc) - at) * DEG_H
            forces = np.array(first.accel.bias) + ACCEL_SLOPE * (degc - first.temperature_degc) * MG
            await memory.keep({
                "fc": msgspec.structs.replace(
                    first,
                    started_at=f"day {run}",
                    power_up=PowerUp(host=f"day {run}", since_unix_s=1e6 * run),
                    temperature_degc=float(degc),
                    gyro=msgspec.structs.replace(first.gyro, bias=tuple(bias.tolist())),
                    accel=msgspec.structs.replace(first.accel, bias=tuple(forces.tolist())),
                )
            })  # fmt: skip

    async def rest(self, seconds: float = 10.0) -> None:
        await asyncio.sleep(seconds)

    async def ask(self, **wanted: Any) -> Any:
        return [reply async for reply in self.service.faces.answer({"command": "temperature", **wanted})][-1]

    def parameters(self, *more: str) -> dict[str, float]:
        return {name: self.double.parameter(name) for name in (*TCAL, *OFFSETS, *more)}

    def left_deg_h(self) -> Any:
        return self.double.residual(1, self.now_s).gyro_rad_s / DEG_H

    def left_mg(self) -> Any:
        return self.double.residual(1, self.now_s).accel_m_s2 / MG


def truth(degc: float) -> Any:
    d = degc - 25.0
    return SLOPE * d + BEND * d * d


TURNED = {"mounting_deg": (0.0, 0.0, 90.0), "parameters": {"INS_GYR_CAL": 0.0, "AHRS_ORIENTATION": 2.0}}


async def test_a_curve_is_written_takes_the_warming_off_and_is_undone_to_the_bit(tmp_path: Path) -> None:
    rig = Warm(tmp_path, **TURNED)
    for name in ("INS_TCAL1_ACC2_Y", "INS_TCAL1_GYR3_Z"):  # of somebody, and switched off
        rig.double.set_parameter(name, 12.345)
    async with rig.running():
        await rig.learn()
        before, left, forces = rig.parameters(), rig.left_deg_h(), rig.left_mg()
        reply = await rig.ask(action="write")
        assert (reply["state"], reply["reason"]) == ("done", "written: fc, 13 to 34 degC"), reply
        assert "no IMU of the autopilot was measured" not in reply["written"]["warnings"]
        now = rig.parameters()
        # By hand: about 35 degC instead of 25, in the board's axes, millionths of a rad/s.
        board = rig.model.mounting.T
        slope, bend = board @ (SLOPE + 2.0 * BEND * 10.0) * DEG_H * 1e6, board @ BEND * DEG_H * 1e6
        low = np.array([LOW_DEGC, HIGH_DEGC]) - 35.0
        for axis, n in zip("XYZ", range(3), strict=True):
            c1, c2, c3 = (now[f"INS_TCAL1_GYR{k}_{axis}"] for k in (1, 2, 3))
            got = c1 * low + c2 * low**2 + c3 * low**3
            np.testing.assert_allclose(got, slope[n] * low + bend[n] * low**2, atol=3.0 * DEG_H * 1e6)
        assert any(now[name] for name in NAMES if "ACC" in name)
        assert (now["INS_TCAL1_ENABLE"], now["INS_TCAL1_TMIN"], now["INS_TCAL1_TMAX"]) == (1.0, 13.0, 34.0)
        assert now["INS_GYR1_CALTEMP"] == pytest.approx(rig.model.temperature_degc(0.0), abs=0.01)
        assert {name: now[name] for name in OFFSETS} == {name: before[name] for name in OFFSETS}
        np.testing.assert_allclose(rig.left_deg_h(), left, atol=0.1)
        for degc in (14.0, 28.0, 33.0):
            rig.degc = degc
            np.testing.assert_allclose(rig.left_deg_h(), left, atol=3.0)
            np.testing.assert_allclose(rig.left_mg(), forces, atol=0.05)
        rig.degc = 50.0  # beyond the span nothing is foretold
        edge = truth(rig.model.temperature_degc(0.0)) - truth(HIGH_DEGC)
        np.testing.assert_allclose(rig.left_deg_h() - left, edge, atol=5.0)
        undone = await rig.ask(action="undo")
        assert undone["state"] == "done", undone
        assert rig.parameters() == before
        with pytest.raises(RequestRefusedError, match="no curve was written"):
            await rig.ask(action="undo")


async def test_what_was_learned_stays_and_goes_on_while_the_autopilot_takes_a_part_off(tmp_path: Path) -> None:
    rig = Warm(tmp_path)
    async with rig.running():
        await rig.learn()
        (usual,) = (each.points[0].gyro for each in BiasStore(tmp_path).read().values())
        assert usual is not None
        assert (await rig.ask(action="write"))["state"] == "done"
        rig.degc = 30.0
        await rig.rest(60.0)
        memory = rig.service.calibrating.memory
        assert memory.forgotten() == {}
        assert memory.curve("fc", "gyro") is not None
        drift = memory.drift("fc", "gyro", 20.0, 30.0)
        assert drift is not None
        assert np.abs(drift[0]).max() < 5.0 * DEG_H
        latest = max(BiasStore(tmp_path).read()["fc"].points, key=lambda point: point.unix_s)
        assert latest.temperature_degc is not None
        assert latest.temperature_degc == pytest.approx(30.0, abs=0.5)
        assert latest.gyro is not None
        raw = np.array(GYRO_BIAS_DEG_H) + truth(latest.temperature_degc)
        np.testing.assert_allclose(np.array(latest.gyro.bias) / DEG_H, raw, atol=10.0)


async def test_a_temperature_calibration_of_somebody_elses_is_kept_until_it_is_said(tmp_path: Path) -> None:
    rig = Warm(tmp_path)
    theirs = {
        "INS_TCAL1_ENABLE": 1.0, "INS_TCAL1_TMIN": 0.0, "INS_TCAL1_TMAX": 60.0, "INS_TCAL1_GYR1_X": 100.0,
        "INS_TCAL1_ACC1_Z": 2000.0, "INS_GYR1_CALTEMP": 40.0, "INS_ACC1_CALTEMP": 45.0,
    }  # fmt: skip
    for name, value in theirs.items():
        rig.double.set_parameter(name, value)
    async with rig.running():
        await rig.learn()
        before, left = rig.parameters(), rig.double.residual(1, rig.now_s)
        reply = await rig.ask(action="write")
        assert reply["state"] == "failed"
        assert reply["reason"].startswith("imu fc: INS_TCAL1_ENABLE is on, set by another writer: its curve stays")
        assert rig.parameters() == before
        assert (await rig.ask(action="write", overwrite=True))["state"] == "done"
        now = rig.double.residual(1, rig.now_s)
        np.testing.assert_allclose(now.gyro_rad_s, left.gyro_rad_s, atol=0.1 * DEG_H)
        np.testing.assert_allclose(now.accel_m_s2, left.accel_m_s2, atol=1e-6)
        # Ours by now, it needs no such word.
        rig.degc = 22.0
        await rig.rest()
        assert (await rig.ask(action="write"))["state"] == "done"
        for _ in range(2):
            assert (await rig.ask(action="undo"))["state"] == "done"
        assert rig.parameters() == before


async def test_nothing_is_written_without_a_curve_or_while_armed(tmp_path: Path) -> None:
    rig = Warm(tmp_path)
    async with rig.running():
        await rig.ready()
        await rig.rest()
        before = rig.parameters()
        reply = await rig.ask(action="write")
        assert (reply["state"], reply["reason"]) == ("failed", "imu fc: no curve yet (companion autopilot temperature)")
        await rig.learn()
        rig.double.arm()
        await rig.rest(2.0)
        with pytest.raises(RequestRefusedError, match="armed"):
            await rig.ask(action="write")
        assert rig.parameters() == before
