"""Logs of the autopilot on the companion's disk: `.part` behind the name until they are whole.

Nothing here is called on the event loop.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.storage.state import sync_folder

logger = logging.getLogger(__name__)

MOST_BYTES: Final = 1_000_000_000
"""Of all logs together; the oldest make room."""
RESERVE_BYTES: Final = 32 * 1024 * 1024
"""Left free on the disk: records and the values for undo are worth more than any log."""
PART: Final = ".part"
_UNUSUAL: Final = re.compile(r"[^A-Za-z0-9_.-]")


class LogFile:
    """One log, as much of it as is here. What touches the disk raises StorageError, in one line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_name(path.name + PART)
        self._at = path if path.is_file() else self._part
        with _on_disk(self._at):
            self.bytes = self._at.stat().st_size if self._at.is_file() else 0

    @property
    def is_whole(self) -> bool:
        """Whether it was fetched to the end that it had then."""
        return self._at == self.path

    def tail(self, most: int) -> bytes:
        """Its last bytes."""
        if not self.bytes:
            return b""
        with _on_disk(self._at), self._at.open("rb") as file:
            file.seek(max(0, self.bytes - most))
            return file.read(most)

    def begin(self, size: int) -> None:
        """Make room for a log of that size; what is here already stays, and counts as half written from here on."""
        folder, lacks = self.path.parent, size - self.bytes
        with _on_disk(folder):
            folder.mkdir(0o700, exist_ok=True)
            others = sorted((each for each in folder.iterdir() if each != self._at), key=lambda at: at.stat().st_mtime)
            sizes = {each: each.stat().st_size for each in others}
            going = []
            while others and size + sum(sizes[each] for each in others) > MOST_BYTES:
                going.append(others.pop(0))
            free = shutil.disk_usage(folder).free - RESERVE_BYTES + sum(sizes[each] for each in going)
            room = min(free, MOST_BYTES - self.bytes)
            if lacks > room:
                rest = f"{lacks / 1e6:.1f} MB needed, {max(room, 0) / 1e6:.1f} MB free"
                raise StorageError(f"{folder}: no room for the log: {rest}")
            for oldest in going:
                oldest.unlink()
                logger.warning("%s: removed, as the logs take more than %d MB", oldest, MOST_BYTES // 1_000_000)
            if self.is_whole:
                os.replace(self.path, self._part)
                self._at = self._part

    def append(self, data: bytes) -> None:
        """Write more, onto the disk itself."""
        with _on_disk(self._part), open(os.open(self._part, os.O_RDWR | os.O_CREAT, 0o600), "r+b") as file:
            file.truncate(self.bytes)
            file.seek(self.bytes)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self.bytes += len(data)

    def cut(self, size: int) -> None:
        """Forget what is behind that many bytes."""
        with _on_disk(self._part):
            if self._part.exists():
                os.truncate(self._part, size)
        self.bytes = size

    def finish(self) -> None:
        """It is whole."""
        with _on_disk(self._part):
            os.replace(self._part, self.path)
            sync_folder(self.path.parent)
        self._at = self.path


def named(folder: Path, name: str) -> Iterator[LogFile]:
    """The places for a log of that name, the first one first: another log, such as another aircraft's, may have it."""
    plain = Path(_UNUSUAL.sub("_", name)[-100:].lstrip(".") or "log")
    for number in itertools.count(1):
        yield LogFile(folder / (plain.name if number == 1 else f"{plain.stem}-{number}{plain.suffix}"))


@contextlib.contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(f"{path}: the log cannot be kept: {error.strerror or error}") from error
