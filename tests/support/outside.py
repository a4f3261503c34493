"""Folders outside the tests' own, in which a run must leave nothing new; and a home folder for the run."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

DEPTHS: Final = {"/": 1, "/etc": 2, "/var": 2, "/run": 1}
"""Folders watched, with the number of levels: system services make files of their own further down."""
HOME_DEPTHS: Final = {".": 1, ".cache": 1, ".config": 1, ".local/share": 1, ".local/state": 1}
"""Folders watched below the home folder, with the number of levels."""
OF_OTHERS: Final = re.compile(
    r"/var/log/|/var/mail/|/var/tmp/systemd-private-|/run/[^/]*(\.pid|\.lock)$|/run/(motd|reboot-required)|/[^/]*history$"
)
"""Files that the system, or a person in a shell, makes at any time."""


def _below(folder: Path, depth: int) -> Iterator[str]:
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return  # absent, or not ours to read: then no test can write there
    for entry in entries:
        yield entry.path
        if depth > 1 and entry.is_dir(follow_symlinks=False):
            yield from _below(Path(entry.path), depth - 1)


def present(home: Path) -> set[str]:
    """Paths in the watched folders, without those of others."""
    depths = {Path(name): depth for name, depth in DEPTHS.items()}
    depths |= {home / name: depth for name, depth in HOME_DEPTHS.items()}
    return {path for folder, depth in depths.items() for path in _below(folder, depth) if not OF_OTHERS.search(path)}


class Outside:
    """Compares the watched folders after a run with those before, and lends the run a home folder.

    Programs that tests start keep caches and settings there (a browser, pip), and are to find none.
    """

    def __init__(self) -> None:
        self.home = Path(pwd.getpwuid(os.getuid()).pw_dir)
        self.left: list[str] = []
        """New paths, once compared."""
        self._before = present(self.home)
        self._lent = tempfile.mkdtemp(prefix="companion-home-")
        os.environ["HOME"] = self._lent
        for name in [name for name in os.environ if name.startswith("XDG_")]:
            del os.environ[name]

    def compare(self) -> list[str]:
        """Find the paths that were not there before the run."""
        self.left = sorted(present(self.home) - self._before)
        return self.left

    def close(self) -> None:
        shutil.rmtree(self._lent, ignore_errors=True)
