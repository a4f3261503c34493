"""The real daemon as its own process, and its command line: for demonstrations and tests on a real clock."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

READY_WITHIN_S: Final = 40.0
POLL_S: Final = 0.1
LINE_LIMIT: Final = 2**25

Record = dict[str, Any]


async def status_of(config: Path) -> Record | None:
    """Return the status from the control socket of the daemon with this configuration; None without an answer."""
    with contextlib.suppress(OSError):
        reader, writer = await asyncio.open_unix_connection(_socket_of(config), limit=LINE_LIMIT)
        with contextlib.closing(writer):
            writer.write(b'{"command": "status"}\n')
            if line := await reader.readline():
                status: Record | None = json.loads(line).get("status")
                return status
    return None


def _socket_of(config: Path) -> Path:
    control = tomllib.loads(config.read_text(encoding="utf-8")).get("control", {})
    return Path(control.get("socket", "/run/companion/control.sock"))


class CompanionProcess:
    """Run `companion run` with the `companion.toml` of a folder; its log becomes `daemon.log` there.

    An async context manager: starts on entering, stops in order on leaving.

    Args:
        folder: folder of the configuration and the log.
        environment: variables beside our own.
        entry: Python's arguments in place of `-m companion`.
    """

    def __init__(
        self, folder: Path, *, environment: Mapping[str, str] | None = None, entry: Sequence[str] = ("-m", "companion")
    ) -> None:
        self.folder, self._environment, self._entry = folder, {**os.environ, **(environment or {})}, entry
        self._process: asyncio.subprocess.Process | None = None

    def command(self, *words: str) -> list[str]:
        return [sys.executable, *self._entry, "-c", str(self.folder / "companion.toml"), *words]

    def log(self) -> str:
        return (self.folder / "daemon.log").read_text(encoding="utf-8", errors="replace")

    async def __aenter__(self) -> Self:
        with (self.folder / "daemon.log").open("wb") as log:
            self._process = await asyncio.create_subprocess_exec(
                *self.command("run"), stderr=log, env=self._environment
            )
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        assert self._process is not None
        if self._process.returncode is None:
            self._process.terminate()
        await self._process.wait()

    def kill(self) -> None:
        self.signal(signal.SIGKILL)

    def signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    async def ended(self, within_s: float) -> int:
        """Wait for the end of the process; return its exit code, negative if a signal killed it."""
        assert self._process is not None
        async with asyncio.timeout(within_s):
            return await self._process.wait()

    async def status(self) -> Record | None:
        """Return the daemon's status; None without an answer."""
        return await status_of(self.folder / "companion.toml")

    async def ready(self, within_s: float = READY_WITHIN_S) -> None:
        """Wait until the daemon answers and knows that the aircraft is disarmed."""
        assert self._process is not None
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + within_s
        while loop.time() < deadline_s:
            await asyncio.sleep(POLL_S)
            if self._process.returncode is not None:
                raise RuntimeError(f"the daemon ended:\n{self.log()}")
            status = await self.status()
            if status is not None and status["vehicle"]["armed"] == "disarmed":
                return
        raise TimeoutError(f"the daemon is not ready after {within_s:g} s:\n{self.log()}")

    async def ask(self, *words: str) -> Record:
        """Run a command with --json and return its output."""
        process = await asyncio.create_subprocess_exec(
            *self.command(*words, "--json"), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL
        )
        output, _ = await process.communicate()
        if not output.strip():
            raise RuntimeError(f"companion {words[0]} printed nothing (exit code {process.returncode})")
        answer: Record = json.loads(output)
        return answer

    async def calibrate(self, within_s: float, *, progress: int | None = None) -> Record:
        """Run `companion calibrate --json`; return the record. Progress goes to stderr or `progress`."""
        words = ("calibrate", "--timeout", str(within_s), "--json")
        process = await asyncio.create_subprocess_exec(
            *self.command(*words), stdout=asyncio.subprocess.PIPE, stderr=progress
        )
        output, _ = await process.communicate()
        if not output.strip():
            raise RuntimeError(f"companion calibrate printed no record (exit code {process.returncode}):\n{self.log()}")
        record: Record = json.loads(output)
        return record
