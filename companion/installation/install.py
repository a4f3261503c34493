"""Installs and removes the files of the systemd service, repeatably; files that the owner has changed stay."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import companion
from companion.errors import CompanionError
from companion.storage.state import remove_durably, write_atomically

EXECUTABLE: Final = "/opt/companion/bin/companion"

_STAMP: Final = "# Put here by `companion install-service`; sha256 of what follows: "
_STAMPED: Final = re.compile(re.escape(_STAMP).encode() + rb"([0-9a-f]{64})\n")


SERVICE: Final = "companion.service"
UNITS: Final = (SERVICE, "companion-setup.service")
RULES: Final = "rules.d/70-companion.rules"
MODULES: Final = "modules-load.d/companion.conf"
SAMPLE: Final = "companion.toml"
SHIPPED: Final = {
    **{unit: f"lib/systemd/system/{unit}" for unit in UNITS},
    RULES: f"lib/udev/{RULES}",
    MODULES: f"lib/{MODULES}",
    SAMPLE: "companion.toml.sample",
}
"""Target path of each file of the source folder `systemd/`. Targets in lib/ are below the installation's prefix (owners
change units by `systemctl edit`, in /etc); all others are below /etc/companion, which belongs to the owner."""


def folder() -> Path:
    """Return the folder with the service's files, in a wheel or a checkout; raise CompanionError if there is none."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "systemd", here.parents[1] / "systemd"):
        if (candidate / SERVICE).is_file():
            return candidate
    raise CompanionError(f"the files of the service are not beside {here}: the installation is not complete")


def content(shipped: str, *, executable: str = EXECUTABLE) -> bytes:
    """Return a service file that starts `executable`; raise CompanionError for a path that a unit cannot contain."""
    text = (folder() / shipped).read_text(encoding="utf-8")
    if shipped in UNITS:
        if not re.fullmatch(r"/[\w.+/@-]+", executable):
            raise CompanionError(f"{executable!r} cannot stand in a unit; allowed: an absolute path without spaces")
        text = text.replace(f"ExecStart={EXECUTABLE} ", f"ExecStart={executable} ")
    return text.encode()


def stamped(data: bytes) -> bytes:
    return f"{_STAMP}{hashlib.sha256(data).hexdigest()}\n".encode() + data


def is_untouched(data: bytes) -> bool:
    """Return True if some version of the companion wrote this file content and nobody has changed it since."""
    match = _STAMPED.match(data)
    return match is not None and hashlib.sha256(data[match.end() :]).hexdigest().encode() == match[1]


MODE: Final = 0o644
COMMAND_TIMEOUT_S: Final = 120.0
HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - named, not used
"""Folders that the systemd unit hides from the service, by ProtectHome and PrivateTmp."""

PACKAGED: Final = "packaged-by"
"""File that marks a Python environment from our Debian package, which installs the service itself."""
_START_PACKAGED: Final = "sudo systemctl enable --now companion"
UDEV_RUNS: Final = Path("/run/udev/control")

Outcome = Literal["written", "updated", "unchanged", "kept", "removed", "absent", "done", "failed", "skipped"]
Run = Callable[[Sequence[str]], str | None]


@dataclass(frozen=True, slots=True)
class InstallStep:
    what: str
    outcome: Outcome
    words: str = ""

    def line(self) -> str:
        return f"{self.outcome:9}  {self.what}" + (f": {self.words}" if self.words else "")


@dataclass(frozen=True, slots=True)
class Installation:
    root: Path
    prefix: Path
    executable: str

    @property
    def is_this_machine(self) -> bool:
        return self.root == Path("/")

    def path(self, shipped: str) -> Path:
        target = SHIPPED[shipped]
        base = str(self.prefix).lstrip("/") if target.startswith("lib/") else "etc/companion"
        return self.root / base / target


PREFIX: Final = Path("/usr/local")


def own_executable() -> str:
    return str(Path(sys.executable).with_name("companion"))


def install(target: Installation, run: Run | None = None) -> Iterator[InstallStep]:
    """Install the service step by step; raise CompanionError without root, or if a Debian package provides it."""
    if target.is_this_machine:
        _check_not_packaged(_START_PACKAGED)
        _check_user("install-service")
        _check_reach(target.executable)
    for shipped in SHIPPED:
        yield _put(target.path(shipped), stamped(content(shipped, executable=target.executable)))
    yield _configuration(target, "yours; what is new is in companion.toml.sample", "sudo companion setup makes it")
    if target.is_this_machine:
        yield from _activate(run or _run)


def start_service(run: Run | None = None) -> Iterator[InstallStep]:
    """Start the service now and at every boot, after installing it if need be; raise CompanionError without root."""
    if _is_packaged():
        for command in ("enable", "restart"):
            yield _command(run or _run, "systemctl", command, "companion.service")
        return
    yield from install(Installation(Path("/"), PREFIX, own_executable()), run)


def how_to_start() -> str:
    return _START_PACKAGED if _is_packaged() else "sudo companion service install"


def uninstall(target: Installation, run: Run | None = None) -> Iterator[InstallStep]:
    """Remove the service, not configuration and records; CompanionError without root, or if a Debian package has it."""
    if target.is_this_machine:
        _check_not_packaged("sudo apt remove companion")
        _check_user("uninstall-service")
        if systemd_runs():
            yield _command(run or _run, "systemctl", "disable", "--now", "companion.service")
            yield _command(run or _run, "systemctl", "stop", "companion-setup.service")
    for shipped in SHIPPED:
        yield _take(target.path(shipped))
    yield _configuration(target, "yours")
    if target.is_this_machine:
        yield from _reload(run or _run)
    state = target.root / "var/lib/private/companion"
    if state.is_dir():
        yield InstallStep(str(state), "kept", "records and values for undo; remove it if they are not wanted any more")


def _put(path: Path, wanted: bytes) -> InstallStep:
    found = _read(path)
    if found == wanted:
        return InstallStep(str(path), "unchanged")
    if found is not None and not is_untouched(found):
        return InstallStep(str(path), "kept", "changed by hand; remove it to get the new one")
    write_atomically(path, wanted, mode=MODE, parents=True)
    return InstallStep(str(path), "written" if found is None else "updated")


def _configuration(target: Installation, there: str, absent: str = "") -> InstallStep:
    path = target.path(SAMPLE).with_name("companion.toml")
    return InstallStep(str(path), "kept", there) if path.exists() else InstallStep(str(path), "absent", absent)


def _take(path: Path) -> InstallStep:
    found = _read(path)
    if found is None:
        return InstallStep(str(path), "absent")
    if not is_untouched(found):
        return InstallStep(str(path), "kept", "changed by hand")
    remove_durably(path)
    return InstallStep(str(path), "removed")


def _read(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CompanionError(f"{path}: cannot be read: {error.strerror or error}") from None


# --- this machine


def _is_packaged() -> bool:
    return (Path(sys.prefix) / PACKAGED).exists()


def _check_not_packaged(instead: str) -> None:
    if _is_packaged():
        raise CompanionError(f"this companion is a Debian package, and its service came with it: {instead}")


def _check_user(command: str) -> None:
    if os.geteuid() != 0:
        raise CompanionError(f"this needs root: sudo {own_executable()} {command}")


def _check_reach(executable: str) -> None:
    """Raise CompanionError if the service could not read and run this installation from its own user account."""
    package = Path(companion.__file__).parent
    for path in (Path(executable), package, Path(sys.base_prefix)):
        why = unreachable(path)
        if why is not None:
            raise CompanionError(
                f"{why}; install the companion where everybody may look, for example:"
                " sudo python3 -m venv /opt/companion && sudo /opt/companion/bin/pip install ."
            )
    if not os.access(executable, os.X_OK):
        raise CompanionError(f"{executable}: no such program; name it with --executable")


def unreachable(path: Path) -> str | None:
    """Return the reason why the service's user account cannot read a path, in one line; None: it can."""
    resolved = path.resolve()
    for hidden in HIDDEN:
        if resolved.is_relative_to(hidden):
            return f"{resolved} is below {hidden}, where the service may not look"
    for node in (resolved, *resolved.parents):
        try:
            mode = node.stat().st_mode
        except OSError:
            continue
        if not mode & 0o001 or (node == resolved and not mode & 0o004):
            return f"{node} is closed to everybody but its owner (mode {mode & 0o7777:04o})"
    return None


def _activate(run: Run) -> Iterator[InstallStep]:
    if not systemd_runs():
        yield InstallStep("systemd", "skipped", "does not run here: nothing was started")
        return
    yield from _reload(run)
    yield _command(run, "systemctl", "enable", "companion.service")
    yield _command(run, "systemctl", "restart", "companion.service")


def _reload(run: Run) -> Iterator[InstallStep]:
    if not systemd_runs():
        return
    yield _command(run, "systemctl", "daemon-reload")
    yield _command(run, "systemctl", "restart", "systemd-modules-load.service")
    if not UDEV_RUNS.exists():
        yield InstallStep("udev", "skipped", "does not run here: its rules hold from the next start on")
    else:
        yield _command(run, "udevadm", "control", "--reload")
        subsystems = ("--subsystem-match=tty", "--subsystem-match=usb-serial")
        yield _command(run, "udevadm", "trigger", *subsystems)


def systemd_runs() -> bool:
    return Path("/run/systemd/system").is_dir()


def is_service() -> bool:
    """Return True if this system runs systemd and has the companion's unit in one of systemd's folders."""
    folders = ("/etc", "/usr/local/lib", "/usr/lib", "/lib")
    return systemd_runs() and any(Path(folder, "systemd/system", SERVICE).exists() for folder in folders)


def _command(run: Run, *words: str) -> InstallStep:
    line = " ".join(words)
    why = run(words)
    return InstallStep(line, "done") if why is None else InstallStep(line, "failed", why)


def _run(words: Sequence[str]) -> str | None:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return None
    return " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
