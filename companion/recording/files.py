"""MCAP files of a recording: a single file, or a ring of files. Write them in a thread, not on the event loop.

A file cut off anywhere stays readable: each chunk is compressed independently, and every `write`, once a second,
finishes a chunk and syncs it to the disk. Writing raises StorageError, in one line, if the disk fails.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Final

from companion import __version__
from companion.errors import StorageError
from companion.messages import message
from companion.recording import messages
from companion.recording.messages import Message, Start

CHUNK_BYTES: Final = 256 * 1024  # Size of a chunk, above the bytes of one second of a busy aircraft
RESERVE_BYTES: Final = 32 * 1024 * 1024
"""Free space on the disk that recordings must leave for undo values and calibration records."""
LEAST_FREE: Final = 0.1
"""Fraction of the disk that a recording on request must leave free, because its files are never deleted."""
PARTS: Final = 8
"""Least number of files in a full ring, so that the deletion of the oldest one loses only a small part."""

FOLDER_MODE: Final = 0o700

_NAME = re.compile(r"(\d{6,})\.mcap")


@dataclasses.dataclass(frozen=True, slots=True)
class Beginning:
    """Header data of a new recording file."""

    t_s: float
    offset_ns: int
    """UTC minus the daemon's monotonic clock, fixed at start so that corrections of the host's clock make no jump."""
    config: bytes  # JSON
    states: Sequence[Message]  # state messages that apply at time `t_s`


def free_bytes(folder: Path) -> int:
    return shutil.disk_usage(folder).free


def disk_shortage(folder: Path) -> str | None:
    """Return a text if the disk is too full for a recording on request; None if it has room, or that is unknown."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return None
    if usage.free >= LEAST_FREE * usage.total:
        return None
    return f"less than {LEAST_FREE * 100:.0f} % of the disk free ({usage.free / 1e9:.1f} of {usage.total / 1e9:.1f} GB)"


def open_new(path: Path) -> IO[bytes]:
    """Create a new file that only its owner can read: a recording contains positions and signatures."""
    return open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o600))


def is_available() -> bool:
    from importlib.util import find_spec

    return find_spec("mcap") is not None and find_spec("zstandard") is not None


def _failed(path: Path, step: str, reason: OSError | str) -> StorageError:
    words = reason if isinstance(reason, str) else reason.strerror or reason
    return StorageError(message("recording_fails", path=path, step=step, reason=words))


class RecordingFile:
    def __init__(self, path: Path) -> None:
        from mcap.writer import CompressionType, IndexType, Writer

        self.path = path
        self.messages = 0
        self._file: IO[bytes] | None = None
        try:
            self._file = open_new(path)
        except FileExistsError:
            raise _failed(path, "created", "exists already") from None
        except FileNotFoundError:
            raise _failed(path, "created", f"there is no folder {path.parent}") from None
        except OSError as error:
            raise _failed(path, "created", error) from None
        # No index of messages: it would need memory for one entry per message.
        self._writer: Any = Writer(
            self._file,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            index_types=IndexType.CHUNK | IndexType.ATTACHMENT | IndexType.METADATA,
        )
        self._channels: dict[str, int] = {}
        self._begun: Beginning | None = None

    @property
    def bytes_written(self) -> int:
        return 0 if self._file is None else int(self._file.tell())

    def write(self, batch: Sequence[Message], beginning: Beginning, *, continues: bool = False) -> None:
        """Append messages, finish the chunk and sync it to disk. The first call writes the header `beginning` first."""
        if self._file is None:
            return
        try:
            if free_bytes(self.path.parent) < RESERVE_BYTES:
                raise OSError(errno.ENOSPC, f"less than {RESERVE_BYTES >> 20} MB free on the disk")
            if self._begun is None:
                self._begin(beginning, Start(continues=continues))
            for recorded in batch:
                self._add(*recorded)
            self._writer.flush()
            self._sync()
        except OSError as error:
            self._abandon()
            raise _failed(self.path, "written", error) from error
        except BaseException:
            self._abandon()
            raise

    def close(self) -> None:
        if self._file is None:
            return
        try:
            self._writer.finish()
            self._sync()
        except OSError as error:
            raise _failed(self.path, "finished", error) from error
        finally:
            self._abandon()

    def _begin(self, beginning: Beginning, start: Start) -> None:
        self._begun = beginning
        offset = str(beginning.offset_ns)
        table = {"format": messages.FORMAT_VERSION, "companion": __version__, "offset_ns": offset}
        self._writer.start(profile="", library=f"companion {__version__}")
        started_ns = self._ns(beginning.t_s)
        self._writer.add_metadata(messages.METADATA, table)
        self._writer.add_attachment(started_ns, started_ns, messages.CONFIG, "application/json", beginning.config)
        self._add(messages.START, beginning.t_s, messages.encode(start))
        for state in beginning.states:
            self._add(*state)

    def _ns(self, t_s: float) -> int:
        """Convert a time on the daemon's clock to UTC in ns; a replay subtracts the same integer offset again."""
        return 0 if self._begun is None else max(0, round(t_s * 1e9) + self._begun.offset_ns)

    def _add(self, topic: str, t_s: float, data: bytes) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._writer.register_channel(topic, messages.encoding(topic), 0)
            self._channels[topic] = channel
        at_ns = self._ns(t_s)
        self.messages += 1
        self._writer.add_message(channel, at_ns, data, at_ns, self.messages & 0xFFFFFFFF)

    def _sync(self) -> None:
        if self._file is not None:
            self._file.flush()
            try:
                os.fdatasync(self._file.fileno())
            except OSError as error:
                if error.errno != errno.EINVAL:  # raised for a pipe, which needs no sync
                    raise

    def _abandon(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()


def unused_path(folder: Path) -> Path:
    """Create the folder, and return an unused path in it for a recording that was requested without a name."""
    try:
        folder.mkdir(FOLDER_MODE, exist_ok=True)
        numbers = [int(path.stem[5:]) for path in folder.glob("kept-*.mcap") if path.stem[5:].isdecimal()]
    except OSError as error:
        raise _failed(folder, "created", error) from error
    return folder / f"kept-{max(numbers, default=0) + 1:03d}.mcap"


def create_on_request(path: Path) -> RecordingFile:
    if (shortage := disk_shortage(path.parent)) is not None:
        raise _failed(path, "created", shortage)
    return RecordingFile(path)


class Ring:
    """Ring of recording files: the oldest are deleted. File names are numbers, because the wall clock may be wrong."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self.folder, self.most_bytes = folder, most_bytes
        self.bytes_in_all = 0
        self._current: RecordingFile | None = None
        self._continues = False  # True: the next file begins where the previous one ended

    @property
    def path(self) -> Path | None:
        return None if self._current is None else self._current.path

    @property
    def is_full(self) -> bool:
        return self._current is not None and self._current.bytes_written >= self.most_bytes // PARTS

    def write(self, batch: Sequence[Message], beginning: Beginning) -> None:
        try:
            if self._current is None:
                self._next()
            else:
                self._make_room()
            if self._current is not None:
                self._current.write(batch, beginning, continues=self._continues)
            self._continues = True
            self._make_room()
        except StorageError:
            self._current, self._continues = None, False
            raise
        except OSError as error:
            with contextlib.suppress(StorageError):
                self.close()
            self._continues = False
            raise _failed(self.folder, "written", error) from error

    def close(self) -> None:
        current, self._current = self._current, None
        if current is not None:
            current.close()

    def _next(self) -> None:
        self.close()
        self.folder.mkdir(FOLDER_MODE, exist_ok=True)
        self._make_room()
        numbers = [number for number, _, _ in self._files()]
        self._current = RecordingFile(self.folder / f"{max(numbers, default=0) + 1:06d}.mcap")

    def _files(self) -> list[tuple[int, Path, int]]:
        found = []
        for entry in os.scandir(self.folder):
            match = _NAME.fullmatch(entry.name)
            if match is not None:
                with contextlib.suppress(FileNotFoundError):
                    found.append((int(match[1]), Path(entry.path), entry.stat().st_size))
        return sorted(found)

    def _make_room(self) -> None:
        files = self._files()
        in_all = sum(size for _, _, size in files)
        present = self.path
        # Reserve room for the file that will be created next.
        limit = self.most_bytes - (self.most_bytes // PARTS if present is None else 0)
        for _, path, size in files:
            if (in_all <= limit and free_bytes(self.folder) >= RESERVE_BYTES) or path == present:
                break
            path.unlink(missing_ok=True)
            in_all -= size
        self.bytes_in_all = in_all
