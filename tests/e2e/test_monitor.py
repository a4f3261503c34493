"""`companion status --watch` as a person runs it: on a terminal, in a pipe, and while the daemon comes and goes."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import pty
import re
import signal
import struct
import sys
import termios
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.test_commands import DONE, FlightLine, _end, _until_disarmed, companion, flight_line

pytestmark = pytest.mark.real_clock

COLUMNS, ROWS = 80, 24


class Watched:
    """A monitor under way, and what it has printed; `ours` is the end that we read."""

    def __init__(self, process: asyncio.subprocess.Process, ours: int) -> None:
        self.process = process
        self.text = ""
        self._ours, self._more, self._ended = ours, asyncio.Event(), False
        asyncio.get_running_loop().add_reader(ours, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._ours, 65536)
        except OSError:
            data = b""  # a terminal ends so when its last writer is gone
        self._ended = not data
        if self._ended:
            self.close()
        self.text += data.decode(errors="replace")
        self._more.set()

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._ours)

    async def until(self, seen: Callable[[str], Any], within_s: float = 150.0) -> None:
        """Wait until something has been printed."""
        async with asyncio.timeout(within_s):
            while not seen(self.text):
                assert not self._ended, f"it ended: {self.text}"
                self._more.clear()
                await self._more.wait()

    async def interrupt(self) -> int:
        """Ctrl-C; the exit code."""
        self.process.send_signal(signal.SIGINT)
        async with asyncio.timeout(40.0):
            return await self.process.wait()


@contextlib.asynccontextmanager
async def monitor(config: Path, *words: str, terminal: bool = False) -> AsyncIterator[Watched]:
    ours, theirs = pty.openpty() if terminal else os.pipe()
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES", "NO_COLOR")}
    if terminal:
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "-c", str(config), "status", "--watch", *words),
        stdout=theirs,
        stderr=theirs,
        env={**environment, "TERM": "xterm"},
    )
    os.close(theirs)
    watched = Watched(process, ours)
    try:
        yield watched
    finally:
        await _end(process)
        watched.close()
        os.close(ours)


@contextlib.asynccontextmanager
async def restarted(line: FlightLine) -> AsyncIterator[None]:
    again = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", "-c", str(line.config), "run", stderr=asyncio.subprocess.PIPE
    )
    try:
        await _until_disarmed(line.config)
        yield
    finally:
        await _end(again)


def objects(text: str) -> list[Any]:
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def words(text: str) -> list[str]:
    return [found["headline"]["word"] if "headline" in found else found["state"] for found in objects(text)]


async def test_in_a_pipe_and_on_a_terminal_through_a_calibration_and_a_restart(tmp_path: Path) -> None:
    async with flight_line(tmp_path) as line, contextlib.AsyncExitStack() as stack:
        as_json = await stack.enter_async_context(monitor(line.config, "--json"))
        as_lines = await stack.enter_async_context(monitor(line.config))
        drawn = await stack.enter_async_context(monitor(line.config, terminal=True))
        await as_json.until(lambda text: "NOT CALIBRATED" in words(text))
        await as_lines.until(lambda text: "NOT CALIBRATED: not calibrated yet" in text)
        await drawn.until(lambda text: "N O T   C A L I B R A T E D" in text)

        await companion("-c", str(line.config), "calibrate", "--no-wait", "--json")
        await as_json.until(lambda text: any(word.startswith("MEASURING") for word in words(text)))
        await drawn.until(lambda text: re.search(r"M E A S U R I N G .*\[#+\.*\] \d+ %", text, re.DOTALL))
        await companion("-c", str(line.config), "cancel")
        await as_lines.until(lambda text: "last calibration: cancelled" in text)

        assert line.daemon is not None
        line.daemon.kill()
        await line.daemon.communicate()
        await as_json.until(lambda text: words(text)[-1] == "unreachable")
        await as_lines.until(lambda text: "NO DAEMON" in text)
        await drawn.until(lambda text: "N O   D A E M O N" in text)
        before = len(objects(as_json.text)), len(as_lines.text), len(drawn.text)
        async with restarted(line):
            await as_json.until(lambda text: "NOT CALIBRATED" in words(text)[before[0] :])
            await as_lines.until(lambda text: "NOT CALIBRATED" in text[before[1] :])
            await drawn.until(lambda text: "N O T   C A L I B R A T E D" in text[before[2] :])
            for watched in (as_json, as_lines, drawn):
                assert await watched.interrupt() == DONE
                assert "Traceback" not in watched.text

        # A pipe gets lines with words in them, a terminal what fits, and its cursor back.
        assert "\x1b" not in as_lines.text + as_json.text
        printed = [line[9:] for line in as_lines.text.splitlines()]
        assert len(printed) < 60, printed
        assert all(re.match(r"\d\d:\d\d:\d\d ", line) for line in as_lines.text.splitlines())
        await drawn.until(lambda text: text.endswith("\x1b[?25h\r\n"))
        for frame in drawn.text.split("\x1b[H")[1:]:
            plain = re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]", "", frame.partition("\x1b[J")[0]).split("\r\n")
            assert len(plain) <= ROWS
            assert max(map(len, plain)) <= COLUMNS
