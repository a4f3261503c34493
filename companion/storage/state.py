"""Files of state: JSON with a checksum of its own, read with suspicion, and set aside where it cannot be used.

No content of such a file may end or hold up the daemon, or be half believed. What lies in its place and is no regular
file (a FIFO, a device, a folder) is not even opened. The checksum is the last key of the object, the SHA-256 of the
bytes before it; a file from before there were checksums is believed as far as its content goes.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import logging
import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import msgspec

from companion import formats
from companion.errors import StorageError
from companion.storage.atomic import remove_durably, write_atomically

logger = logging.getLogger(__name__)

MOST_BYTES: Final = 1_000_000
"""More is none of ours: the largest, with the earlier biases, has some 240 kB."""

ASIDE: Final = ".unusable"
MOST_ASIDE: Final = 3
"""Of each name; the last one makes room."""

UNREADABLE: Final = (ValueError, RecursionError, OverflowError, msgspec.MsgspecError)
"""What reading any bytes as JSON of a type may raise."""

_SEAL: Final = re.compile(rb',\s*"sha256":\s*"([0-9a-f]{64})"\s*\}\s*\Z')
_SEAL_BYTES: Final = 120

T = TypeVar("T")


def read_regular(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """The content of a regular file, or of a link to one; never waits for anybody.

    Raises:
        FileNotFoundError: there is none.
        OSError: it cannot be read, is no regular file, or a longer one.
    """
    # Looked at before it is opened: a device may do something when it is.
    _require_regular(path.stat())
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY), "rb") as file:
        _require_regular(os.fstat(file.fileno()))
        data = file.read(most_bytes + 1) or b""
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"more than {most_bytes} bytes")
    return data


def _require_regular(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "not a regular file")


def sealed(data: bytes) -> bytes:
    """A JSON object with its checksum as the last key, and a new line."""
    body = data.rstrip()[:-1].rstrip()
    gap, end = (b"\n  ", b"\n") if b"\n" in body else (b"", b"")
    return body + b"," + gap + b'"sha256":"' + hashlib.sha256(body).hexdigest().encode() + b'"' + end + b"}\n"


def unsealed(data: bytes) -> bytes:
    """The JSON without its checksum, which fits; as it is where there is none.

    Raises:
        msgspec.ValidationError: it does not fit.
    """
    seal = _SEAL.search(data, max(0, len(data) - _SEAL_BYTES))
    if seal is None:
        return data
    body = data[: seal.start()]
    if hashlib.sha256(body).hexdigest().encode() != seal[1]:
        raise msgspec.ValidationError("its checksum does not fit: damaged, or changed by hand")
    return body + b"}"


class StateFile(Generic[T]):
    """One such file.

    Args:
        path: where.
        kind: its type, as msgspec takes it.
        check: raises msgspec.ValidationError where what was found, or is to be kept, cannot be.
    """

    def __init__(
        self, path: Path, kind: Any, check: Callable[[T], None] = lambda _: None, newest: int | None = None
    ) -> None:
        self.path = path
        self._kind, self._check, self._newest = kind, check, newest
        self.unusable: str | None = None
        """What `take` has met last, in one line; None where all was well."""

    def read(self) -> T | None:
        """What is kept, if anything.

        Raises:
            StorageError: it cannot be used: where and why, in one line.
        """
        try:
            found: T = formats.decode(unsealed(read_regular(self.path)), self._kind, self._newest)
            self._check(found)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        except UNREADABLE as error:
            raise StorageError(f"{self.path}: cannot be used: {error}") from error
        return found

    def take(self) -> T | None:
        """What is kept, for the daemon: what cannot be used is set aside, said once, and counts as nothing."""
        self.unusable = None
        try:
            return self.read()
        except StorageError as error:
            self.unusable = f"{error}; {set_aside(self.path)}"
            logger.warning("%s", self.unusable)
            return None

    def write(self, value: T) -> None:
        """Keep this in the place of what was kept.

        Raises:
            StorageError: it could not be written, or is nothing that may be; what was there before still is.
        """
        try:
            self._check(value)
            data = sealed(msgspec.json.encode(value))
        except UNREADABLE as error:
            raise StorageError(f"{self.path}: not written: {error}") from error
        write_atomically(self.path, data)

    def clear(self) -> None:
        """Keep nothing any more.

        Raises:
            StorageError: the file could not be removed.
        """
        remove_durably(self.path)


def set_aside(path: Path) -> str:
    """Rename what cannot be used, so that it is neither met again nor lost; what became of it, in words."""
    names = [f"{path.name}{ASIDE}", *(f"{path.name}{ASIDE}-{number}" for number in range(2, MOST_ASIDE + 1))]
    name = next((name for name in names if not os.path.lexists(path.with_name(name))), names[-1])
    with contextlib.suppress(OSError):
        os.replace(path, path.with_name(name))
        return f"set aside as {name}"
    return "it cannot be set aside either"
