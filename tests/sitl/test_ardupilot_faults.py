"""A real ArduPilot that restarts, loses packets or has another master, and a daemon that dies: right or refused.

Every test starts its own binary and looks at every parameter it lists: nothing may have changed but what the record
says, and an undo brings all of it back. Each takes a minute or two of real time.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from sim.companion_process import CompanionProcess
from tests.sitl.ardupilot_bench import (
    BOOT_LIMIT_DEG_H,
    GYRO_FAMILY,
    GYRO_LIMIT_DEG_H,
    OUR_ACCELS,
    OUR_GYROS,
    ArduPilotBench,
    asks_for_ahrs,
    assert_as_recorded,
    bench,
    calibrated,
    calibrates,
    imu_warnings,
    sets,
    until_quiet,
    until_status,
)

pytestmark = pytest.mark.sitl

PHASE_WITHIN_S = 120.0

# --- phases of a calibration, in order; each waits until it has come

Phase = Callable[[ArduPilotBench, CompanionProcess], Awaitable[None]]


async def measuring(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await until_status(daemon, lambda s: s["still_s"] > 3 and s["progress"] is not None)


async def writing(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await bench.link.sent(sets(*OUR_GYROS, *OUR_ACCELS))


async def firmware_calibrating(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await bench.link.sent(calibrates)
    await asyncio.sleep(0.1)


async def writing_fine_offsets(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await bench.link.sent(calibrates)
    await bench.link.sent(sets(*OUR_GYROS))


async def verifying(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await writing_fine_offsets(bench, daemon)
    await asyncio.sleep(2.5)


async def settling(bench: ArduPilotBench, daemon: CompanionProcess) -> None:
    await writing_fine_offsets(bench, daemon)
    await bench.link.sent(asks_for_ahrs)
    await asyncio.sleep(0.5)


PHASES: dict[str, Phase] = {
    phase.__name__: phase
    for phase in (measuring, writing, firmware_calibrating, writing_fine_offsets, verifying, settling)
}


# --- the tests


async def test_only_what_the_record_says_changes_and_undo_brings_the_whole_list_back(tmp_path: Path) -> None:
    async with bench(tmp_path) as b, b.daemon() as daemon:
        record = await calibrated(daemon)
        assert record["state"] == "done", record
        now = await b.ground.whole_list()
        b.assert_right(now)
        assert_as_recorded(record, await b.changed())
        assert {*OUR_GYROS, *OUR_ACCELS} <= (await b.changed()).keys()
        answer = await daemon.ask("undo")
        assert answer["state"] == "done", answer
        assert await b.changed() == {}


@pytest.mark.parametrize("gyr_cal", [False, True], ids=["gyr_cal_0", "gyr_cal_1"])
@pytest.mark.parametrize("phase", PHASES)
async def test_a_restart_of_the_autopilot_leaves_new_values_or_old_ones(
    tmp_path: Path, phase: str, gyr_cal: bool
) -> None:
    async with bench(tmp_path, gyr_cal=gyr_cal) as b, b.daemon() as daemon:
        calibrating = asyncio.create_task(calibrated(daemon))
        async with asyncio.timeout(PHASE_WITHIN_S):
            await PHASES[phase](b, daemon)
        await b.vehicle.power_cycle()
        record = await calibrating
        print(phase, gyr_cal, record["state"], record["reason"], record["warnings"], imu_warnings(record))
        await until_quiet(daemon)
        changed, now = await b.changed(), await b.ground.whole_list()
        print(changed)
        # At a boot the firmware measures its gyros anew.
        assert_as_recorded(record, changed, GYRO_FAMILY if gyr_cal else ())
        if record["state"] == "done":
            b.assert_right(now, BOOT_LIMIT_DEG_H if gyr_cal else GYRO_LIMIT_DEG_H)
        else:
            assert record["reason"]
            if phase != "settling":
                assert not {*OUR_ACCELS} & changed.keys()
                now |= _true_accels(b)
            elif gyr_cal:
                # Only the boot has spoilt what was complete; the accelerometers keep what was seen to be right.
                outcomes = {record["imus"][0]["written"][name]["outcome"] for name in OUR_ACCELS}
                assert outcomes == {"verified"}
            if gyr_cal:
                b.assert_right(now, BOOT_LIMIT_DEG_H)


def _true_accels(b: ArduPilotBench) -> dict[str, float]:
    return dict(zip(OUR_ACCELS, b.vehicle.true_bias(1, b.vehicle.now_s).accel_m_s2.tolist(), strict=True))


@pytest.mark.parametrize("phase", ["measuring", "writing", "writing_fine_offsets", "verifying"])
async def test_a_second_ground_station_that_writes_the_same_offset_is_noticed(tmp_path: Path, phase: str) -> None:
    theirs = float(np.float32(0.01))
    async with bench(tmp_path) as b, b.daemon() as daemon:
        await b.ground.get("INS_GYROFFS_X")
        calibrating = asyncio.create_task(calibrated(daemon))
        async with asyncio.timeout(PHASE_WITHIN_S):
            await PHASES[phase](b, daemon)
        b.ground.send_put("INS_GYROFFS_X", theirs)
        record = await calibrating
        print(phase, record["state"], record["reason"], record["warnings"], imu_warnings(record))
        await until_quiet(daemon)
        changed, now = await b.changed(), await b.ground.whole_list()
        print(changed)
        if record["state"] == "done":
            b.assert_right(now)
            assert_as_recorded(record, changed)
        else:  # theirs or the old one; all others are as before
            assert changed in ({}, {"INS_GYROFFS_X": (b.before["INS_GYROFFS_X"], theirs)})


@pytest.mark.parametrize("seed", [1, 2])
async def test_with_a_fifth_of_all_packets_lost_the_result_is_right_or_refused(tmp_path: Path, seed: int) -> None:
    async with bench(tmp_path) as b, b.daemon() as daemon:
        b.link._random.seed(seed)
        b.link.loss = 0.2
        record = await calibrated(daemon)
        await until_quiet(daemon)
        print(record["state"], record["duration_s"], record["reason"], record["warnings"], imu_warnings(record))
        assert b.link.lost > 0.15 * (b.link.lost + b.link.passed)
        changed, now = await b.changed(), await b.ground.whole_list()
        print(changed)
        assert_as_recorded(record, changed)
        if record["state"] == "done":
            b.assert_right(now)
            answer = await daemon.ask("undo")
            print(answer)
            await until_quiet(daemon)
            assert answer["state"] == "done", answer
        assert await b.changed() == {}


@pytest.mark.parametrize("phase", ["writing", "firmware_calibrating", "writing_fine_offsets", "verifying"])
async def test_a_daemon_that_dies_in_the_middle_puts_everything_back_when_it_lives_again(
    tmp_path: Path, phase: str
) -> None:
    async with bench(tmp_path) as b:
        async with b.daemon() as daemon:
            calibrating = asyncio.create_task(calibrated(daemon))
            async with asyncio.timeout(PHASE_WITHIN_S):
                await PHASES[phase](b, daemon)
            daemon.kill()
            with contextlib.suppress(RuntimeError, AssertionError):
                await calibrating
        await asyncio.sleep(3.0)
        print(await b.changed())
        async with b.daemon() as daemon:
            await until_quiet(daemon)
            assert await b.changed() == {}
