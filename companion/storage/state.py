"""State files: written atomically, with a checksum, validated when read, and set aside if they are unusable.

Whatever a state file contains, it cannot end or block the daemon, and it is accepted as a whole or not at all. A FIFO,
a device or a folder in place of a file is not even opened. The checksum, the last key of the JSON object, is the
SHA-256 of the bytes before it. A file without a checksum, from an earlier version, is accepted if its content is valid.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import logging
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import msgspec

from companion import formats
from companion.errors import StorageError
from companion.messages import message


def file_error(path: Path, done: str, reason: OSError | Exception | str) -> StorageError:
    """Make the one-line error for a file or folder; `done` is what failed: "read", "written", "used", ..."""
    words = getattr(reason, "strerror", None) or reason
    return StorageError(message("file_not_usable", path=path, done=done, reason=words))


def write_atomically(path: Path, data: bytes, *, mode: int = 0o600, parents: bool = False) -> None:
    """Replace a file's content so that a power cut at any byte leaves the old or the new content.

    Steps: temporary file in the same folder, fsync, rename, fsync of the folder. The folder is created only if its
    parent exists, so that a typo in a path creates no tree. `parents` creates the whole path. Raises StorageError.
    """
    try:
        path.parent.mkdir(parents=parents, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        try:
            with os.fdopen(descriptor, "wb") as file:
                os.fchmod(file.fileno(), mode)
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise file_error(path, "written", error) from error


def remove_durably(path: Path) -> None:
    """Remove a file, if there is one, so that it stays removed after a power cut; raises StorageError in one line."""
    try:
        path.unlink(missing_ok=True)
        if path.parent.is_dir():
            sync_folder(path.parent)
    except OSError as error:
        raise file_error(path, "removed", error) from error


def sync_folder(folder: Path) -> None:
    """Flush created, renamed and removed entries of a folder to the disk; raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


logger = logging.getLogger(__name__)

MOST_BYTES: Final = 2_000_000
"""Largest accepted state file. The largest that we write, the bias history of eight IMUs, has up to 1.7 MB."""

ASIDE: Final = ".unusable"
MOST_ASIDE: Final = 3  # Most unusable files stored of each name; a further one replaces the last

UNREADABLE: Final = (ValueError, RecursionError, OverflowError, msgspec.MsgspecError)
"""Exceptions that may occur when arbitrary bytes are decoded as JSON of a given type."""

_SEAL: Final = re.compile(rb',\s*"sha256":\s*"([0-9a-f]{64})"\s*\}\s*\Z')
_SEAL_BYTES: Final = 120

T = TypeVar("T")


def read_regular(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Read a regular file, or a link to one, without blocking; raises OSError, also for a file above `most_bytes`."""
    # Check before opening: opening a device may have an effect.
    _require_regular(path.stat())
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY), "rb") as file:
        _require_regular(os.fstat(file.fileno()))
        data = file.read(most_bytes + 1) or b""
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"more than {most_bytes} bytes")
    return data


def named_in(folder: Path, kind: re.Pattern[str]) -> list[str]:
    """List what the first group of `kind` matches in file names, sorted; [] without the folder. Raises StorageError."""
    try:
        names = [entry.name for entry in folder.iterdir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise file_error(folder, "listed", error) from error
    return sorted(match[1] for match in map(kind.fullmatch, names) if match)


def numbers_in(folder: Path, kind: re.Pattern[str]) -> list[int]:
    """List the numbers in all file names that match `kind`, ascending; raises StorageError."""
    return sorted(map(int, named_in(folder, kind)))


def _require_regular(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "not a regular file")


def sealed(data: bytes) -> bytes:
    body = data.rstrip()[:-1].rstrip()
    gap, end = (b"\n  ", b"\n") if b"\n" in body else (b"", b"")
    return body + b"," + gap + b'"sha256":"' + hashlib.sha256(body).hexdigest().encode() + b'"' + end + b"}\n"


def unsealed(data: bytes) -> bytes:
    """Return JSON without its checksum, if it has one; raise msgspec.ValidationError if the checksum is wrong."""
    seal = _SEAL.search(data, max(0, len(data) - _SEAL_BYTES))
    if seal is None:
        return data
    body = data[: seal.start()]
    if hashlib.sha256(body).hexdigest().encode() != seal[1]:
        raise msgspec.ValidationError("its checksum does not fit: damaged, or changed by hand")
    return body + b"}"


class StateFile(Generic[T]):
    """One state file. `check` raises msgspec.ValidationError for impossible content, on reading and on writing."""

    def __init__(
        self,
        path: Path,
        kind: Any,
        check: Callable[[T], None] = lambda _: None,
        newest: int | None = None,
        mode: int = 0o600,
    ) -> None:
        self.path, self._mode = path, mode
        self._kind, self._check, self._newest = kind, check, newest
        self.unusable: str | None = None  # one-line error of the last `load`; None: no error

    def read(self) -> T | None:
        """Read the file; return None if there is none. Raises StorageError in one line."""
        try:
            return self._of(read_regular(self.path))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise file_error(self.path, "read", error) from error
        except UNREADABLE as error:
            raise file_error(self.path, "used", error) from error

    def _of(self, data: bytes) -> T:
        if len(data) > MOST_BYTES:
            raise msgspec.ValidationError(f"more than {MOST_BYTES} bytes")
        found: T = formats.decode(unsealed(data), self._kind, self._newest)
        self._check(found)
        return found

    def load(self) -> T | None:
        """Read the file; if it is unusable, log that, rename it so that it is not read again, and return None."""
        self.unusable = None
        try:
            return self.read()
        except StorageError as error:
            self.unusable = f"{error}; {set_aside(self.path)}"
            logger.warning("%s", self.unusable)
            return None

    def write(self, value: T) -> None:
        """Replace the content; after a StorageError the old content remains."""
        try:
            data = sealed(msgspec.json.encode(value))
            # Check first: never replace a readable file by an unreadable one.
            self._of(data)
        except UNREADABLE as error:
            raise StorageError(f"{error} ({self.path.name})") from error
        write_atomically(self.path, data, mode=self._mode)

    def clear(self) -> None:
        """Remove the file; raises StorageError."""
        remove_durably(self.path)


def set_aside(path: Path) -> str:
    """Rename an unusable file, so that it is neither read again nor lost; return a text about the result."""
    names = [f"{path.name}{ASIDE}", *(f"{path.name}{ASIDE}-{number}" for number in range(2, MOST_ASIDE + 1))]
    name = next((name for name in names if not os.path.lexists(path.with_name(name))), names[-1])
    with contextlib.suppress(OSError):
        os.replace(path, path.with_name(name))
        return f"renamed to {name}"
    return "it cannot be renamed either"


class _Entries(msgspec.Struct, Generic[T], frozen=True):
    entries: list[T]


class BoundedList(Generic[T]):
    """File with the latest `keep` entries of a list, oldest first. All methods but `read` raise StorageError."""

    def __init__(self, path: Path, kind: type[T], keep: int) -> None:
        # Files of versions without checksums hold only the list.
        self._file: StateFile[_Entries[T] | list[T]] = StateFile(path, _Entries[kind] | list[kind])  # type: ignore[valid-type]
        self._keep = keep

    def read(self) -> list[T]:
        """Return the latest entries; an unusable file is set aside and counts as empty."""
        return _listed(self._file.load())[-self._keep :]

    def all(self) -> list[T]:
        """Return all entries; raises StorageError for an unusable file."""
        return _listed(self._file.read())

    def append(self, entry: T) -> None:
        self.write([*self.read(), entry][-self._keep :])

    def write(self, entries: list[T]) -> None:
        self._file.write(_Entries(entries))


def _listed(found: _Entries[T] | list[T] | None) -> list[T]:
    return found.entries if isinstance(found, _Entries) else found or []


@contextlib.contextmanager
def only_daemon(directory: Path) -> Iterator[None]:
    """Lock a storage directory for this process; the kernel unlocks it when the process ends for any reason.

    Two daemons would read each other's journal as an interrupted write. The directory itself is locked, so that no
    lock file is needed. If it cannot be created or locked (network file system), the daemon continues without a lock.
    Raises StorageError if another daemon has locked the directory.
    """
    try:
        directory.mkdir(exist_ok=True)
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        yield  # the write journal reports why nothing can be saved, and no parameter is written
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise file_error(directory, "used", "another daemon works with this directory") from None
    except OSError as error:
        logger.warning("%s", file_error(directory, "locked", error))
    try:
        yield
    finally:
        os.close(descriptor)
