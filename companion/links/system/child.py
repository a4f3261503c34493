"""A child process of the daemon (`companion.daemon.interfaces.child`): how it starts, reports and ends.

It reads its settings from stdin, one line of JSON, and ends when stdin ends. It writes its status to stdout, one JSON
object a line, at least every `REPORT_EVERY_S`, and its log to the daemon's stderr.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol

import msgspec

from companion.config.sections import Config
from companion.formats import Object
from companion.links.system.logs import set_up

logger = logging.getLogger(__name__)

REPORT_EVERY_S: Final = 1.0
NICENESS: Final = 19
"""The daemon answers an arming request within 20 ms whatever its children are busy with."""
OUT_OF_MEMORY: Final = 12
"""Exit code of a child that needed more than its limit: ENOMEM."""
STACK_BYTES: Final = 1024 * 1024
"""Stack of a thread: it counts as data, and the usual 8 MiB would use up the limit."""
OOM_SCORE: Final = "900"
"""Score by which the kernel, out of memory, ends a child before anything else on the board."""


class ChildSettings(msgspec.Struct, frozen=True):
    """Settings that the daemon hands to a child: the configuration in force, and the level of the log."""

    config: Config
    log_level: str = "INFO"
    only_listening: str | None = None


class ChildWork(Protocol):
    """Work of a child process."""

    async def run(self) -> None:
        """Work until cancelled."""

    def status(self) -> Object:
        """Return `good`, `summary` and whatever else `companion status --json` shows."""


def run_child(make: Callable[[ChildSettings], ChildWork], *, memory_mib: int) -> None:
    """Run a child process until its daemon ends; an allocation beyond `memory_mib` of data ends the child."""
    limit = memory_mib * 1024 * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    threading.stack_size(STACK_BYTES)
    # The service's unit, or a container, may forbid either.
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE, encoding="ascii")
    line = sys.stdin.buffer.readline()
    if not line:
        return  # the daemon ended before it could ask for anything
    settings = msgspec.json.decode(line, type=ChildSettings)
    set_up(settings.log_level)
    try:
        try:
            asyncio.run(_run(make(settings)))
        except* MemoryError:
            # Nothing that allocates may follow.
            os._exit(OUT_OF_MEMORY)
    except Exception:
        logger.exception("the process failed")
        sys.exit(1)


async def _run(work: ChildWork) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(_on_error)
    working = loop.create_task(work.run(), name="work")
    reporting = loop.create_task(_report(work), name="report")

    def end() -> None:
        loop.remove_reader(sys.stdin)
        working.cancel()

    loop.add_signal_handler(signal.SIGTERM, end)
    loop.add_reader(sys.stdin, end)
    await asyncio.wait([working, reporting], return_when=asyncio.FIRST_COMPLETED)
    for task in (working, reporting):
        task.cancel()
    for result in await asyncio.gather(working, reporting, return_exceptions=True):
        if isinstance(result, Exception):
            raise result


def _on_error(loop: asyncio.AbstractEventLoop, context: Object) -> None:
    """Log an error that reached the event loop; end where memory ran out, in whichever callback."""
    if isinstance(context.get("exception"), MemoryError):
        os._exit(OUT_OF_MEMORY)
    loop.default_exception_handler(context)


async def _report(work: ChildWork) -> None:
    while True:
        sys.stdout.buffer.write(msgspec.json.encode(work.status()) + b"\n")
        sys.stdout.buffer.flush()
        await asyncio.sleep(REPORT_EVERY_S)
