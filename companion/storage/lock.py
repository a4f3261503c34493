"""One daemon to a storage directory: two would take each other's journal for an interrupted write."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from companion.errors import StorageError

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def only_daemon(directory: Path) -> Iterator[None]:
    """Hold the directory for this process; the kernel lets go of it however the process ends.

    It is the directory itself that is locked: whoever may not write there can still find out, and no file has to be
    there or be right. Where it can be neither made nor locked (a network file system), the daemon goes on without.

    Raises:
        StorageError: another daemon holds it.
    """
    try:
        directory.mkdir(exist_ok=True)
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        yield  # the ledger says why nothing can be kept, and nothing is written
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise StorageError(f"{directory}: another daemon works with this directory") from None
    except OSError as error:
        logger.warning("%s: cannot be locked: %s; run one daemon only", directory, error.strerror or error)
    try:
        yield
    finally:
        os.close(descriptor)
