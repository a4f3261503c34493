"""Common parts of the companion's processes: logs, the service manager, and the main function of a child process.

A child of the daemon (`daemon/interfaces/child.py`) reads its settings from stdin, one line of JSON, and ends when
stdin ends. It writes its status to stdout, one JSON object a line, at least every `REPORT_EVERY_S`, and its log to the
daemon's stderr.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import logging
import os
import resource
import signal
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Protocol, Self, TextIO

import msgspec

from companion.config.sections import Config
from companion.formats import Object, printable
from companion.links.system.connection import Budget
from companion.messages import message

logger = logging.getLogger(__name__)

# The journal reads the level from "<N>" at the beginning of a line; `journalctl -p warning` needs it.
_PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

LINES_PER_S: Final = 0.1
BURST: Final = 10.0


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Log handler that limits the rate of lines per place in the code and level; `clock`: monotonic seconds."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._budgets: dict[tuple[str, int, int], Budget] = {}
        self._left_out: Counter[tuple[str, int, int]] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        now_s = self._clock()
        place = record.pathname, record.lineno, record.levelno
        budget = self._budgets.setdefault(place, Budget(LINES_PER_S, BURST))
        if budget.left(now_s) < 1.0:
            self._left_out[place] += 1
            return
        budget.spend(1, now_s)
        if left_out := self._left_out.pop(place, 0):
            record = copy.copy(record)
            record.msg = f"{record.getMessage()} (after {left_out} more like this, left out)"
            record.args = ()
        super().emit(record)


class OneLineFormatter(logging.Formatter):
    """Formatter that writes one line per message, even if the message quotes line ends; tracebacks have more lines."""

    def format(self, record: logging.LogRecord) -> str:
        said = copy.copy(record)
        said.msg, said.args = printable(record.getMessage()), None
        return "\n".join(map(printable, super().format(said).splitlines()))


class JournalFormatter(OneLineFormatter):
    """Formatter for journald, which adds the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{_PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines() or [""])


def set_up_logs(level: str) -> None:
    handler = LimitedHandler(sys.stderr)
    if goes_to_journal(sys.stderr):
        handler.setFormatter(JournalFormatter("%(levelname)s %(message)s"))
    else:
        handler.setFormatter(OneLineFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler])


def goes_to_journal(stream: TextIO) -> bool:
    """Check that JOURNAL_STREAM names `stream`; a process with redirected output inherits the variable too."""
    named = os.environ.get("JOURNAL_STREAM")
    if named is None:
        return False
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return named == f"{status.st_dev}:{status.st_ino}"


class ServiceManager:
    """Client of systemd's notify socket, if `address` is set; `watchdog_s`: longest time between two WATCHDOG=1."""

    def __init__(self, address: str | None, watchdog_s: float | None = None) -> None:
        self._address = address or ""
        self.watchdog_s = watchdog_s if address is not None else None
        self._socket: socket.socket | None = None
        self._status = ""
        self._warned = False
        if address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            # A service manager that does not read must not block the daemon.
            self._socket.settimeout(0.0)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ, process_id: int | None = None) -> Self:
        address = environment.get("NOTIFY_SOCKET") or None
        if address is not None and address[0] not in "/@":
            reason = f"NOTIFY_SOCKET: found {address!r}; allowed: a path or @NAME"
            logger.warning("%s", message("systemd_not_notified", reason=reason))
            address = None
        try:
            watchdog_us = int(environment.get("WATCHDOG_USEC") or 0)
            for_us = int(environment.get("WATCHDOG_PID") or 0) in (0, process_id or os.getpid())
        except ValueError:
            reason = "WATCHDOG_USEC or WATCHDOG_PID is not a whole number"
            logger.warning("%s", message("systemd_not_notified", reason=reason))
            return cls(address)
        return cls(address, watchdog_us * 1e-6 if for_us and watchdog_us > 0 else None)

    @property
    def listens(self) -> bool:
        return self._socket is not None

    def status(self, words: str) -> bool:
        line = " ".join(words.split())
        if line == self._status:
            return True
        sent = self.notify(f"STATUS={line}")
        if sent:
            self._status = line
        return sent

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def notify(self, line: str) -> bool:
        if self._socket is None:
            return False
        # A name with "@" is an abstract socket; for the kernel it begins with a zero byte.
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(line.encode(), address)
        except OSError as error:
            level, why = logging.DEBUG if self._warned else logging.WARNING, error.strerror or error
            logger.log(level, "%s", message("systemd_not_notified", reason=f"{self._address}: {why}"))
            self._warned = True
            return False
        return True


REPORT_EVERY_S: Final = 1.0
NICENESS: Final = 19  # the daemon must answer an arming request within 20 ms, however busy its children are
OUT_OF_MEMORY: Final = 12  # exit code of a child that needed more than its limit: ENOMEM
STACK_BYTES: Final = 1024 * 1024
"""Stack size of a thread. The default of 8 MiB would count as data and use up the memory limit."""
OOM_SCORE: Final = "900"
"""Score with which the kernel, out of memory, kills a child process before other processes."""


class ChildSettings(msgspec.Struct, frozen=True):
    """Settings that the daemon sends to a child process: the active configuration and the log level."""

    config: Config
    log_level: str = "INFO"
    only_listening: str | None = None


class ChildWork(Protocol):
    async def run(self) -> None:
        """Work until cancelled."""

    def status(self) -> Object:
        """Return `good`, `summary` and the other values that `companion status --json` shows."""


def run_child(make: Callable[[ChildSettings], ChildWork], *, memory_mib: int) -> None:
    """Run a child process until its daemon ends. A child that allocates more than `memory_mib` of data ends itself."""
    limit = memory_mib * 1024 * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    threading.stack_size(STACK_BYTES)
    # The service's unit or a container may forbid the niceness or the score.
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE, encoding="ascii")
    line = sys.stdin.buffer.readline()
    if not line:
        return  # the daemon ended before it could ask for anything
    settings = msgspec.json.decode(line, type=ChildSettings)
    set_up_logs(settings.log_level)
    try:
        try:
            asyncio.run(_run(make(settings)))
        except* MemoryError:
            # Out of memory: no allocation is possible from here on.
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
        if not working.cancelling():  # a second cancellation would break off what the work does at its end
            working.cancel()

    loop.add_signal_handler(signal.SIGTERM, end)
    loop.add_reader(sys.stdin, end)
    await asyncio.wait([working, reporting], return_when=asyncio.FIRST_COMPLETED)
    end()
    reporting.cancel()
    for result in await asyncio.gather(working, reporting, return_exceptions=True):
        if isinstance(result, Exception):
            raise result


def _on_error(loop: asyncio.AbstractEventLoop, context: Object) -> None:
    """Log an error that reached the event loop; end the process if any callback ran out of memory."""
    if isinstance(context.get("exception"), MemoryError):
        os._exit(OUT_OF_MEMORY)
    loop.default_exception_handler(context)


async def _report(work: ChildWork) -> None:
    while True:
        try:
            sys.stdout.buffer.write(msgspec.json.encode(work.status()) + b"\n")
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # its daemon was killed: stdin has ended
        await asyncio.sleep(REPORT_EVERY_S)
