"""A disk that refuses, is slow, or loses its power at any byte of any write."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

Refusal = Literal["full", "read-only", "fsync"]

_REAL = {name: getattr(os, name) for name in ("open", "replace", "unlink", "mkdir", "fsync", "fdatasync")}


class Disk:
    """Stands between the process and the files below `root`, as long as it is `mounted`.

    Nothing is really synced: what a power cut leaves is decided by `snapshot`, not by the machine that this runs on.
    """

    def __init__(self, root: Path, chance: random.Random) -> None:
        self.root, self._chance = str(root), chance
        self.refuses: Refusal | None = None
        self.operations = 0
        self.refused = 0
        self.cut_at: int | None = None
        """The power goes at this operation."""
        self.on_cut: Callable[[], None] = lambda: None

    @contextlib.contextmanager
    def mounted(self) -> Iterator[None]:
        """Take the place of the operating system's calls."""
        for name in _REAL:
            setattr(os, name, self._call(name))
        try:
            yield
        finally:
            for name, real in _REAL.items():
                setattr(os, name, real)

    def _call(self, name: str) -> Callable[..., Any]:
        real = _REAL[name]

        def call(first: Any, *others: Any, **options: Any) -> Any:
            path = self._path(first)
            if path is None:
                return real(first, *others, **options)
            writes = name != "open" or bool(others and others[0] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            if writes:
                self._refuse(name, path)
            if writes and name not in ("open", "mkdir"):
                self._operate(name, path, others)
            return None if name in ("fsync", "fdatasync") else real(first, *others, **options)

        return call

    def _path(self, what: Any) -> str | None:
        if isinstance(what, int):
            try:
                what = os.readlink(f"/proc/self/fd/{what}")
            except OSError:
                return None
        path = os.fspath(what)
        return path if isinstance(path, str) and path.startswith(self.root) else None

    def _refuse(self, name: str, path: str) -> None:
        code = None
        if self.refuses == "read-only":
            code = errno.EROFS
        elif self.refuses == "full" and name in ("fsync", "fdatasync"):
            code = errno.ENOSPC  # what flush would have met: the bytes find no room
        elif self.refuses == "fsync" and name in ("fsync", "fdatasync"):
            code = errno.EIO
        if code is not None:
            self.refused += 1
            raise OSError(code, os.strerror(code), path)

    def _operate(self, name: str, path: str, others: tuple[Any, ...]) -> None:
        self.operations += 1
        if self.cut_at is None or self.operations < self.cut_at:
            return
        self.cut_at = None
        after = name == "replace" and self._chance.random() < 0.5
        if after:
            _REAL["replace"](path, others[0])
            # The caller does it once more; the file has to be there for that.
            shutil.copyfile(others[0], path)
        torn = path if name in ("fsync", "fdatasync") and os.path.isfile(path) else None
        self.torn = (torn, self._chance.random())
        self.on_cut()

    torn: tuple[str | None, float] = (None, 1.0)

    def snapshot(self, folder: Path, target: Path) -> None:
        """Copy the state of `folder` after a power cut at this instant: a file being synced is cut short."""
        if folder.is_dir():
            shutil.copytree(folder, target)
        torn, share = self.torn
        if torn is not None:
            copy = target / Path(torn).relative_to(folder)
            if copy.is_file():
                size = copy.stat().st_size
                with copy.open("r+b") as file:
                    file.truncate(int(share * (size + 1)))
        self.torn = (None, 1.0)
