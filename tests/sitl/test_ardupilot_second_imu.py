"""The second IMU of a real ArduPilot, whose telemetry is integers that hide its gyro bias (autopilots 9.3.1)."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.sitl.ardupilot_bench import (
    QUICK,
    SECOND_ACCELS,
    SECOND_GYROS,
    assert_as_recorded,
    bench,
    calibrated,
    imu_warnings,
    until_quiet,
)

pytestmark = pytest.mark.sitl

SECOND = """
[[imu]]
name = "fc2"
source = "autopilot"
instance = 2
profile = "icm42688p"
"""
DITHERED_WITHIN_S = 400.0
"""80 s of dither and as much again for the rest; a busy machine simulates at half speed."""
DITHER = "\n[push]\ndither = true\n"


def test_integers_that_hide_the_second_gyro_are_not_calibrated_and_the_words_say_why(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path) as b, b.daemon(SECOND + QUICK) as daemon:
            record = await calibrated(daemon)
            print(record["state"], record["duration_s"], record["reason"], record["warnings"], imu_warnings(record))
            await until_quiet(daemon)
            now, changed = await b.ground.whole_list(), await b.changed()
            print(changed)
            assert_as_recorded(record, changed)
            words = " ".join([record["reason"], *imu_warnings(record)])
            assert "dither" in words, record
            if record["state"] == "done":
                b.assert_right(now)
                second = next(imu for imu in record["imus"] if imu["name"] == "fc2")
                assert not {*SECOND_GYROS} & second["written"].keys()
            else:
                assert changed == {}

    asyncio.run(main())


def test_offset_dither_tells_the_second_imu_and_restores_what_it_stepped(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path) as b, b.daemon(SECOND + QUICK + DITHER) as daemon:
            record = await calibrated(daemon, DITHERED_WITHIN_S)
            print(record["state"], record["duration_s"], record["reason"], record["warnings"], imu_warnings(record))
            assert record["state"] == "done", record
            now, changed = await b.ground.whole_list(), await b.changed()
            b.assert_right(now)
            b.assert_right(now, instance=2)
            assert_as_recorded(record, changed)
            assert {*SECOND_GYROS, *SECOND_ACCELS} <= changed.keys()
            assert (await daemon.undo())["state"] == "done"
            assert await b.changed() == {}

    asyncio.run(main())
