"""A real systemd to run the service under, on machines that have none running: process 1 of namespaces of its own.

It shares the network and the devices of this machine and nothing else: its files are an overlay that is forgotten.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import site
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Final

SYSTEMD: Final = Path("/lib/systemd/systemd")
PROJECT: Final = Path(__file__).resolve().parents[2]
BOOT: Final = Path(__file__).with_name("boot_systemd.sh")
NAMESPACES: Final = ("--mount", "--pid", "--cgroup", "--uts", "--ipc", "--fork", "--kill-child")
BOOTED_WITHIN_S: Final = 30.0


def why_not() -> str | None:
    """Why none can be booted here; None when one can."""
    if os.geteuid() != 0:
        return "booting a systemd in namespaces needs root"
    if not SYSTEMD.exists() or shutil.which("nsenter") is None:
        return "systemd is not here (Debian: apt-get install systemd)"
    if _packages() is None:
        return "our packages are in no folder that a service could use"
    if _cgroups() is None:
        return "this kernel has no cgroup2 mounted"
    tried = subprocess.run(["unshare", *NAMESPACES, "true"], capture_output=True, text=True, check=False)
    return f"no namespaces for a systemd: {tried.stderr.strip()}" if tried.returncode else None


def _cgroups() -> Path | None:
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2" and os.access(place, os.W_OK):
            return Path(place)
    return None


class Machine:
    def __init__(self, process_id: int) -> None:
        self._process_id = process_id

    async def run(self, *words: str, check: bool = True, stdin: str = "") -> tuple[int, str, str]:
        """Run a command there; exit code, stdout and stderr.

        Raises:
            RuntimeError: it failed, and `check`.
        """
        enter = ("nsenter", f"--target={self._process_id}", "--mount", "--pid", "--cgroup", "--uts", "--ipc", "--")
        process = await asyncio.create_subprocess_exec(
            *enter,
            *words,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env={"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "LANG": "C.UTF-8"},
        )
        out, error = await process.communicate(stdin.encode())
        code = process.returncode or 0
        if check and code != 0:
            _, said, _ = await self.run("journalctl", "--no-pager", "--lines=20", "--unit=companion", check=False)
            raise RuntimeError(f"{' '.join(words)}: exit code {code}: {out.decode()} {error.decode()}\n{said}")
        return code, out.decode(), error.decode()

    async def write(self, path: str, text: str) -> None:
        await self.run("install", "-D", "-m", "644", "/dev/stdin", path, stdin=text)

    async def show(self, unit: str, *names: str) -> dict[str, str]:
        _, out, _ = await self.run("systemctl", "show", unit, *(f"--property={name}" for name in names))
        return dict(line.partition("=")[::2] for line in out.splitlines())


@contextlib.asynccontextmanager
async def booted(folder: Path) -> AsyncIterator[Machine]:
    """Boot one and end it.

    Raises:
        TimeoutError: it did not come up; its console is in the message.
    """
    base, packages = _cgroups(), _packages()
    assert base is not None
    assert packages is not None
    group = base / f"companion-test-{os.getpid()}"
    group.mkdir()
    place, console = folder / "machine", folder / "console"
    place.mkdir()
    with console.open("wb") as out:
        process = await asyncio.create_subprocess_exec(
            # The group first: the namespace then begins there, and what systemd makes can be removed again.
            "sh", "-c", f'echo $$ >{group}/cgroup.procs; exec unshare "$@"', "sh", *NAMESPACES,
            str(BOOT), str(place), str(PROJECT), sys.base_prefix, packages, stdout=out, stderr=out,
        )  # fmt: skip
    try:
        machine = Machine(await _first_process(process, console))
        await _until_up(machine)
        yield machine
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()  # and with it process 1, and with that everything in its namespace
        await process.wait()
        await _remove(group)


async def _first_process(process: asyncio.subprocess.Process, console: Path) -> int:
    """The child of unshare, once it is systemd."""
    try:
        async with asyncio.timeout(BOOTED_WITHIN_S):
            while True:
                if process.returncode is not None:
                    raise TimeoutError
                child = _systemd_below(process.pid)
                if child is not None:
                    return child
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise TimeoutError(f"systemd did not start: {console.read_text(errors='replace')}") from None  # noqa: ASYNC240


def _systemd_below(parent: int) -> int | None:
    children = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    if children and os.path.basename(os.readlink(f"/proc/{children[0]}/exe")) == "systemd":
        return int(children[0])
    return None


def _packages() -> str | None:
    """The folder of the packages that we run with."""
    return next((path for path in site.getsitepackages() if Path(path, "numpy").is_dir()), None)


async def _until_up(machine: Machine) -> None:
    async with asyncio.timeout(BOOTED_WITHIN_S):
        while True:
            _, out, _ = await machine.run("systemctl", "is-active", "booted.target", check=False)
            if out.strip() == "active":
                return
            await asyncio.sleep(0.1)


async def _remove(group: Path) -> None:
    """Remove a cgroup and all below it; its processes are being killed."""
    async with asyncio.timeout(10.0):
        while not _removed(group):
            await asyncio.sleep(0.05)


def _removed(group: Path) -> bool:
    for folder, _, _ in os.walk(group, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(folder)
    return not group.exists()
