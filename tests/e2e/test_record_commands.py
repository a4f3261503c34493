"""Recording and replaying as a person does it: real processes and threads, in real time, and a power cut."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.e2e.test_commands import DONE, FAILED, NO_DAEMON, companion, flight_line, until_status

pytestmark = pytest.mark.real_clock

LONGER_THAN_A_WINDOW_S = 8.0


async def test_record_calibrate_pull_the_plug_replay(tmp_path: Path) -> None:
    async with flight_line(tmp_path) as line:
        config, mine = str(line.config), tmp_path / "mine.mcap"
        recording = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "companion", "-c", config, "log", "record", str(mine), "--json"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        assert recording.stderr is not None
        async with asyncio.timeout(20.0):
            await recording.stderr.readuntil(b" MB")  # it says how it goes
        second = await companion("-c", config, "log", "record")
        assert second.code == FAILED
        assert f"already recording to {mine}" in second.err, second
        assert f"recording to {mine}" in (await companion("-c", config, "status")).out

        # A calibration that began before would not be recomputed.
        await until_status(
            line.config, "recording", lambda status: status["recording"]["file"]["seconds"] > LONGER_THAN_A_WINDOW_S
        )
        done = await companion("-c", config, "calibrate", "--timeout", "60", "--json")
        assert done.code == DONE, done.err
        await asyncio.sleep(2.1)  # what a power cut may cost

        recording.send_signal(signal.SIGINT)
        async with asyncio.timeout(40.0):
            out, _ = await recording.communicate()
        assert recording.returncode == DONE
        told = json.loads(out)
        assert (told["state"], told["reason"], told["file"]) == ("done", "stopped", str(mine))
        assert told["bytes"] == mine.stat().st_size or told["bytes"] > 10_000
        assert told["lost"] == 0
        again = await companion("-c", config, "log", "record", str(mine))
        assert again.code == FAILED
        assert "recording cannot be created: exists already" in again.err
        nothing = await companion("-c", config, "log", "record", "--stop")
        assert nothing.code == FAILED
        assert "nothing is being recorded" in nothing.err

        assert line.daemon is not None
        line.daemon.kill()
        await line.daemon.wait()
        ring = sorted((tmp_path / "state" / "recordings").glob("0*.mcap"))
        assert ring
        for path in (mine, ring[0]):
            replay = await companion("log", "replay", str(path), "--json")
            assert replay.code == DONE, (replay.out[-2000:], replay.err)
            (found,) = replay.json["calibrations"]
            assert found["differences"] == []
            assert found["not_recomputed"] is None
            for again, before in zip(found["record"]["imus"], done.json["imus"], strict=True):
                off = np.subtract(again["gyro_bias_rad_s"], before["gyro_bias_rad_s"])
                assert (np.abs(off) <= 0.01 * np.array(before["gyro_sigma_use_rad_s"])).all()
        gone = await companion("-c", config, "log", "record")
        assert gone.code == NO_DAEMON
