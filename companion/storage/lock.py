"""One daemon to a storage directory: two would take each other's journal for an interrupted write."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.storage.state import read_regular

logger = logging.getLogger(__name__)

PID_FILE: Final = "daemon.pid"
"""File with the holder's process id, for messages only: what counts is the lock."""


@contextlib.contextmanager
def only_daemon(directory: Path) -> Iterator[None]:
    """Hold the directory for this process; the kernel lets go of it however the process ends.

    It is the directory itself that is locked: whoever may not write there can still find out, and no file has to be
    there or be right. Where it can be neither made nor locked (a network file system), the daemon goes on without.

    Raises:
        StorageError: another daemon holds it.
    """
    pid = directory / PID_FILE
    try:
        directory.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        yield  # the ledger says why nothing can be kept, and nothing is written
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise StorageError(f"{directory}: another daemon{_process(pid)} works with this directory") from None
    except OSError as error:
        logger.warning("%s: cannot be locked: %s; run one daemon only", directory, error.strerror or error)
    _note(pid)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            pid.unlink()
        os.close(descriptor)


def _note(pid: Path) -> None:
    with contextlib.suppress(OSError):
        # Made anew: to write into what lies there, a FIFO say, could take for ever.
        pid.unlink(missing_ok=True)
        with open(os.open(pid, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "w", encoding="ascii") as file:
            file.write(f"{os.getpid()}\n")


def _process(pid: Path) -> str:
    try:
        return f" (process {int(read_regular(pid, 20))})"
    except (OSError, ValueError):
        return ""
