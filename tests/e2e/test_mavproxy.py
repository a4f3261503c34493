"""MAVProxy as an independent ground station: what docs/ground_stations.md tells people to type, typed."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.support.ground_line import ground_line
from tests.support.namespaces import OWN_SHARED_MEMORY, has_shared_memory

MAVPROXY = Path(sys.executable).with_name("mavproxy.py")
DOCS = Path(__file__).parents[2] / "docs/ground_stations.md"
MODULES = "link,cmdlong,param"
"""The default ones that matter here; with them it needs none of the packages that draw maps."""

pytestmark = [
    pytest.mark.skipif(
        not MAVPROXY.exists(), reason="MAVProxy is not installed: pip install --no-deps MAVProxy (120 MB)"
    ),
    pytest.mark.real_clock,
]


class MavProxy:
    """A running MAVProxy: type lines, wait for what it prints."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.printed = ""

    async def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")
        await self._process.stdin.drain()

    async def prints(self, pattern: str, *, after: int = 0, within_s: float = 90.0) -> str:
        """Wait until it has printed this, at or after a place in what was printed."""
        assert self._process.stdout is not None
        try:
            async with asyncio.timeout(within_s):
                while (found := re.compile(pattern).search(self.printed, after)) is None:
                    data = await self._process.stdout.read(4096)
                    assert data, f"it ended without {pattern!r}:\n{self.printed}"
                    self.printed += data.decode(errors="replace")
        except TimeoutError:
            raise AssertionError(f"never printed {pattern!r}:\n{self.printed}") from None
        return found[0]

    async def prints_when_asked(self, line: str, pattern: str) -> None:
        """Type a question again until this is the answer: it says nothing when a parameter has been set."""
        for _ in range(20):
            place = len(self.printed)
            await self.type(line)
            answer = await self.prints(r"CMP_\w+\s+[\d.]+", after=place)
            if re.match(pattern, answer):
                return
            await asyncio.sleep(0.2)
        raise AssertionError(f"{line!r} never answered {pattern!r}:\n{self.printed}")


@contextlib.asynccontextmanager
async def mavproxy(folder: Path, port: int, modules: str = MODULES) -> AsyncIterator[MavProxy]:
    # It needs semaphores, which lie in shared memory.
    memory = () if has_shared_memory() else OWN_SHARED_MEMORY
    process = await asyncio.create_subprocess_exec(
        *memory, sys.executable, str(MAVPROXY), f"--master=udpout:127.0.0.1:{port}", "--no-state",
        f"--default-modules={modules}", cwd=folder,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "HOME": str(folder)},
    )  # fmt: skip
    try:
        yield MavProxy(process)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()


def typed_lines(first: str) -> list[str]:
    """The indented block of the MAVProxy section that begins with a line."""
    section = DOCS.read_text().partition("## MAVProxy\n")[2].partition("\n## ")[0]
    blocks = [block.split("\n    ") for block in re.findall(r"(?:^ {4}\S.*\n)+", section, re.MULTILINE)]
    (block,) = [block for block in blocks if block[0].strip() == first]
    return [line.strip() for line in block]


async def test_what_the_documentation_says_to_type(tmp_path: Path) -> None:
    choose, calibrate, show, push, back = typed_lines("vehicle 1:191")
    load, everybody, message = typed_lines("module load message")
    async with ground_line(tmp_path, "ardupilot") as line, mavproxy(tmp_path, line.port) as station:
        autopilot = line.scenario.autopilot
        before = autopilot.parameter("INS_ACCOFFS_X")
        await station.prints(r"Detected vehicle 1:191")
        await station.prints(r"Received \d+ parameters", within_s=30.0)

        await station.type(choose)
        await station.prints(r"Set vehicle 1:191")
        await station.type(calibrate)
        await station.prints(r"Got COMMAND_ACK: USER_1: IN_PROGRESS", within_s=30.0)
        await station.prints(r"AP: Calibration started: keep the aircraft still")
        await station.prints(r"Got COMMAND_ACK: USER_1: ACCEPTED", within_s=60.0)
        figures = await station.prints(r"AP: \.\.\. sigma [\d.]+ deg/h(?: warming)?, [\d.]+ mg")
        record = (await line.daemon.ask("history"))["records"][0]
        assert record["state"] == "done"
        assert figures.endswith(record["reason"])
        assert autopilot.parameter("INS_ACCOFFS_X") != before

        place = len(station.printed)
        await station.type(show)
        await station.prints(r"CMP_STATE\s+1\.0", after=place)
        await station.type(push.replace(" 1", " 0"))
        await station.prints_when_asked("param show CMP_PUSH", r"CMP_PUSH\s+0\.0")
        await station.type(push)
        await station.prints_when_asked("param show CMP_PUSH", r"CMP_PUSH\s+1\.0")
        await station.type(back)
        await station.prints(r"Set vehicle 1:1 ", after=place)

        autopilot.arm()
        await asyncio.sleep(1.5)  # until the heartbeat says so
        await station.type(load)
        await station.prints(r"Loaded module message")
        await station.type(everybody)
        place = len(station.printed)
        await station.type(message)
        await station.prints(r"Got COMMAND_ACK: USER_1: DENIED", after=place)
        await station.prints(r"AP: Calibration refused: armed: disarm first", after=place)
