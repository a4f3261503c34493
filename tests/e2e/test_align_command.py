"""`companion align` as a person types it: real processes in real time, Ctrl-C, and a terminal that is closed."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path

import pytest

from tests.e2e.test_commands import DONE, FAILED, companion, flight_line

pytestmark = pytest.mark.real_clock


async def begun(config: str, *more: str) -> asyncio.subprocess.Process:
    """An alignment of which the first stand is being measured."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "-c", config, "align", "zero", *more),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stderr is not None
    async with asyncio.timeout(40.0):
        await process.stderr.readuntil(b"1 of 3: measuring")
    return process


async def test_ctrl_c_a_closed_terminal_and_who_has_to_wait(tmp_path: Path) -> None:
    async with flight_line(tmp_path) as line:
        config = str(line.config)
        first = await begun(config, "--json")
        busy = await companion("-c", config, "calibrate")
        assert busy.code == FAILED
        assert "a gradienter alignment is running (1 of 3" in busy.err
        busy = await companion("-c", config, "align", "forget")
        assert busy.code == FAILED
        first.send_signal(signal.SIGINT)
        async with asyncio.timeout(40.0):
            out, _ = await first.communicate()
        assert first.returncode == FAILED
        assert json.loads(out)["state"] == "cancelled"

        # It goes on without whoever asked for it, until its time is over; a cancel finds it.
        second = await begun(config, "--timeout", "60")
        second.kill()
        await second.wait()
        status = (await companion("-c", config, "status", "--json")).json
        assert status["reason"].startswith("1 of 3: ")
        assert status["readings"]["gradienter_x_deg"] is not None
        assert status["readings"]["compass_deg"] is not None
        cancelled = await companion("-c", config, "cancel", "--json")
        assert cancelled.json == {"state": "cancelled", "reason": "cancelled by companion cancel; nothing written"}

        third = await companion("-c", config, "align", "zero", "--timeout", "4", "--json")
        assert third.code == FAILED
        assert third.json["state"] == "failed"
        assert third.json["reason"].startswith("not finished in the time given: 1 of 3")
        none = await companion("-c", config, "align", "show")
        assert none.code == DONE
        assert "no alignment is kept" in none.out
