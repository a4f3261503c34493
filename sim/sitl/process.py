"""A firmware binary as a child process: its own folder, process group, log and ports, and a clean end."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import os
import shutil
import signal
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

LOOPBACK = "127.0.0.1"


def free_udp_port() -> int:
    """Return a free UDP port of the loopback address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def free_tcp_window(size: int) -> int:
    """Return the first of `size` consecutive TCP ports that are free."""
    for _ in range(50):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.bind((LOOPBACK, 0))
            first = int(probe.getsockname()[1])
        if first + size < 65536 and all(port_free(port, socket.SOCK_STREAM) for port in range(first, first + size)):
            return first
    raise OSError(f"no {size} free TCP ports in a row")


def port_free(port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:  # as servers do: connections in their last wait do not count
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def ports_free(ports: Iterable[tuple[int, socket.SocketKind]]) -> bool:
    return all(port_free(port, kind) for port, kind in ports)


def unlocked(path: Path) -> bool:
    """Return True if no other process holds a record lock (fcntl, not flock) on a file."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDWR)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        finally:
            os.close(descriptor)
    return True


GOODBYE_S = 2.0
"""Time between SIGTERM and SIGKILL."""
LOG_LINES = 12
_PR_SET_PDEATHSIG = 1
_LOG_TAIL_BYTES = 8192


class BinaryError(RuntimeError):
    """A binary that is missing, cannot run, or has died; the message is for people."""


def check_binary(path: Path, option: str = "--binary") -> Path:
    """Return the absolute path of an executable; raise BinaryError if it is missing or not executable."""
    path = path.expanduser()
    found = path if path.parent != Path() or path.exists() else Path(shutil.which(str(path)) or path)
    if not found.is_file():
        raise BinaryError(f"{option}: found no file {path}; give the path of the firmware's binary")
    if not os.access(found, os.X_OK):
        raise BinaryError(f"{option}: {path} is not executable; try chmod +x")
    return found.absolute()


class FirmwareProcess:
    """One run of a binary; `start` again for a power cycle: the folder keeps the stored state.

    Args:
        command: the binary and its arguments.
        folder: its existing working directory. Output goes to `firmware.log` there, appended.
        environment: added to ours.
    """

    def __init__(self, command: Sequence[str], folder: Path, *, environment: Mapping[str, str] | None = None) -> None:
        self.command, self.folder = list(command), folder
        self.environment = dict(environment or {})
        self.log = folder / "firmware.log"
        self._process: asyncio.subprocess.Process | None = None
        self._libc = ctypes.CDLL(None)

    @property
    def pid(self) -> int | None:
        return self._process.pid if self.running and self._process is not None else None

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.returncode is None

    async def start(self) -> None:
        if self.running:
            raise RuntimeError(f"{self.command[0]} runs already")
        with self.log.open("ab") as log:
            try:
                self._process = await asyncio.create_subprocess_exec(
                    *self.command,
                    cwd=self.folder,
                    env={**os.environ, **self.environment},
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=log,
                    stderr=asyncio.subprocess.STDOUT,
                    start_new_session=True,
                    preexec_fn=self._die_with_us,
                )
            except OSError as error:
                raise BinaryError(f"{self.command[0]}: cannot be run: {error.strerror}") from None

    async def stop(self) -> None:
        """Kill the firmware and all its children, as a power cut does: nothing more is saved."""
        process = self._process
        if process is None:
            return
        self._signal(signal.SIGTERM)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GOODBYE_S):
                await process.wait()
        self._signal(signal.SIGKILL)  # also what is left of the group when the leader has gone
        await process.wait()
        self._process = None

    async def wait(self) -> None:
        """Wait until the process ends, then raise a BinaryError with the last lines of its log."""
        assert self._process is not None
        code = await self._process.wait()
        raise BinaryError(self._obituary(code))

    async def until(self, condition: Callable[[], bool], within_s: float, what: str) -> None:
        """Wait for a condition; raise BinaryError if the process dies first, or after `within_s`."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + within_s
        while not condition():
            if not self.running:
                code = None if self._process is None else self._process.returncode
                raise BinaryError(self._obituary(code))
            if loop.time() > deadline_s:
                raise BinaryError(
                    f"{Path(self.command[0]).name}: {what}: not within {within_s:g} s.{self._last_words()}"
                )
            await asyncio.sleep(0.02)

    def log_tail(self, lines: int = LOG_LINES) -> list[str]:
        """Return the last lines of the process log, without blank lines."""
        try:
            with self.log.open("rb") as log:
                log.seek(max(0, self.log.stat().st_size - _LOG_TAIL_BYTES))
                text = log.read().decode(errors="replace")
        except OSError:
            return []
        return [line for line in text.splitlines() if line.strip()][-lines:]

    def _obituary(self, code: int | None) -> str:
        if code is None:
            return f"{Path(self.command[0]).name} does not run"
        how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        return f"{Path(self.command[0]).name} ended with {how}.{self._last_words()}"

    def _last_words(self) -> str:
        tail = self.log_tail()
        return "" if not tail else " Its last words:\n  " + "\n  ".join(tail)

    def _signal(self, number: signal.Signals) -> None:
        """Signal the process group, whose id is the leader's process id."""
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def _die_with_us(self) -> None:
        """Run in the child: have it killed when the simulator is killed (Linux)."""
        self._libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
