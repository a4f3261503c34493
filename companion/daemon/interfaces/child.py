"""One child process of the daemon: started, watched, and restarted when it ends or falls silent.

The code that runs in the child is `companion.links.system.process`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable
from typing import Final

import msgspec

from companion.errors import LinkError
from companion.formats import Object
from companion.links.system.connection import Reconnection
from companion.links.system.process import OUT_OF_MEMORY, REPORT_EVERY_S, ChildSettings
from companion.messages import message

logger = logging.getLogger(__name__)

FIRST_REPORT_S: Final = 60.0
"""Longest wait for the first report: a small board with a cold SD card imports the child's libraries slowly."""
SILENT_S: Final = 5.0 * REPORT_EVERY_S
END_WITHIN_S: Final = 3.0
"""Longest wait for the end of a child: the MQTT process publishes the last state and "offline" before it ends."""
WORTH_S: Final = 30.0
REPORT_LIMIT: Final = 256 * 1024


class Child:
    """Keeps `python -m MODULE` running; `run` is its task."""

    def __init__(self, name: str, module: str, settings: ChildSettings) -> None:
        self._name, self._module, self._settings = name, module, settings
        self._report: Object | None = None
        self.process_id: int | None = None
        self._restart = Reconnection(name, worth_s=WORTH_S, first_s=0.5, cap_s=4.0)

    def status(self) -> Object:
        if self._report is not None:
            return self._report
        return {"good": False, "summary": self._restart.last_error or "starting"}

    async def run(self) -> None:
        await self._restart.keep(self._once)

    async def _once(self) -> str:
        try:
            # A session of its own keeps Ctrl-C in the terminal from the child: the daemon handles it.
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", self._module, stdin=PIPE, stdout=PIPE, limit=REPORT_LIMIT, start_new_session=True
            )
        except OSError as error:
            reason = f"cannot be started: {error.strerror or error}"
            raise LinkError(message("process_failed", fault=reason)) from error
        self.process_id = process.pid
        try:
            assert process.stdin is not None
            process.stdin.write(msgspec.json.encode(self._settings) + b"\n")
            return message("process_failed", fault=await self._watch(process))
        finally:
            self._report = self.process_id = None
            ending = asyncio.ensure_future(_end(process))
            try:
                await asyncio.shield(ending)
            except asyncio.CancelledError:
                # The daemon stops while it ends a failed child: finish that first, or the child would live on.
                await ending
                raise

    async def _watch(self, process: Process) -> str:
        reading = asyncio.get_running_loop().create_task(self._read(process))
        try:
            silent_s, heard = 0.0, self._report
            while not reading.done():
                await asyncio.wait([reading], timeout=REPORT_EVERY_S)
                # Count waits instead of reading the clock: the daemon itself may have been stopped.
                silent_s, heard = (silent_s + REPORT_EVERY_S if heard is self._report else 0.0), self._report
                if silent_s >= (SILENT_S if heard is not None else FIRST_REPORT_S):
                    _kill(process)
                    return f"gave no sign of life for {silent_s:.0f} s: ended"
            return await reading
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    async def _read(self, process: Process) -> str:
        assert process.stdout is not None
        try:
            while line := await process.stdout.readline():
                if self._report is None:
                    self._restart.up(f"process {process.pid} runs")
                self._report = msgspec.json.decode(line, type=dict[str, object])
        except ValueError as error:
            _kill(process)
            return f"sent an unreadable report: {error}"
        return _ended(await process.wait())


StartChild = Callable[[str, str, ChildSettings], Child]


async def _end(process: Process) -> None:
    # Read the output to its end: unread data would keep the pipe open and `wait` from returning.
    drained = asyncio.ensure_future(_drain(process))
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
    # asyncio.timeout will not do: before Python 3.11.4 it cannot expire in a cancelled task.
    ended = asyncio.ensure_future(process.wait())
    if not (await asyncio.wait([ended], timeout=END_WITHIN_S))[0]:
        _kill(process)
        await ended
    if process.stdin is not None:
        process.stdin.close()
    await drained


async def _drain(process: Process) -> None:
    while process.stdout is not None and await process.stdout.read(REPORT_LIMIT):
        pass


def _kill(process: Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.kill()


def _ended(code: int) -> str:
    if code == OUT_OF_MEMORY:
        return "needed more memory than it may have"
    return f"ended with code {code}" if code >= 0 else f"was ended by {signal.Signals(-code).name}"
