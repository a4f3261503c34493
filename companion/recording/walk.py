"""Reads a recording from its beginning as far as it goes: a file may end anywhere, and the power may have been cut.

The library's readers want the end of the file, or stop with an exception at the first cut; and a replay is to be a
hundred times faster than what it replays. The records are those of the MCAP specification, version 0.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from companion.errors import StorageError

MAGIC: Final = b"\x89MCAP0\r\n"
_CHANNEL, _MESSAGE, _CHUNK, _ATTACHMENT, _METADATA, _DATA_END = 0x04, 0x05, 0x06, 0x09, 0x0C, 0x0F
_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_LENGTH: Final = struct.Struct("<I")
_LONG: Final = struct.Struct("<Q")
MOST_CHUNK_BYTES: Final = 64 * 1024 * 1024
"""A chunk that claims more than this is damaged: ours have a state of some MB at most."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message on a topic; `data` is JSON."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Metadata:
    """A named table of texts."""

    name: str
    table: dict[str, str]


@dataclass(frozen=True, slots=True)
class Attachment:
    """A named file."""

    name: str
    data: bytes


class _DamagedError(Exception):
    """What follows cannot be read; its argument says why."""


class Recording:
    """An MCAP file, read once from front to end.

    Args:
        path: the file.

    Raises:
        StorageError: one line: it cannot be read, is empty, or is nothing of this kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_short: str | None = None
        """After reading: why it ended before its end, in words; None when it is whole."""
        self._topics: dict[int, str] = {}
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
                if not head:
                    raise StorageError(f"{path}: the file is empty")
                if not MAGIC.startswith(head):
                    raise StorageError(f"{path}: not a recording (MCAP)")
                self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise StorageError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None

    def __iter__(self) -> Iterator[Message | Metadata | Attachment]:
        """Everything in the order of writing, until the end or a cut."""
        try:
            yield from self._records(memoryview(self._data), len(MAGIC), outermost=True)
        except (_DamagedError, struct.error, UnicodeDecodeError) as error:
            self.cut_short = str(error)

    def _records(self, data: Any, at: int, *, outermost: bool) -> Iterator[Message | Metadata | Attachment]:
        size = len(data)
        if size < at:
            raise _DamagedError(f"cut in its first {at} bytes")
        while at < size:
            if size - at < _HEAD.size:
                raise _DamagedError(f"cut at byte {size}")
            kind, length = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            end = at + length
            if kind == 0 or end > size:
                raise _DamagedError(f"cut at byte {size}" if kind else f"nothing but zeros from byte {at} on")
            if kind == _MESSAGE:
                topic, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(data, at)
                known = self._topics.get(topic)
                if known is not None:
                    yield Message(known, log_time_ns, bytes(data[at + _MESSAGE_HEAD.size : end]))
            elif kind == _CHUNK and outermost:
                yield from self._records(_chunk(data[at:end], at), 0, outermost=False)
            elif kind == _CHANNEL:
                number = int.from_bytes(data[at : at + 2], "little")
                self._topics[number] = _text(data, at + 4)[0]
            elif kind == _METADATA:
                yield _metadata(data, at)
            elif kind == _ATTACHMENT:
                yield _attachment(data, at)
            elif kind == _DATA_END:
                return
            at = end
        if outermost:
            raise _DamagedError(f"cut at byte {size}")


def _chunk(data: Any, at: int) -> bytes:
    """The records in a chunk, unpacked and checked."""
    _, _, size, crc = _CHUNK_HEAD.unpack_from(data, 0)
    compression, start = _text(data, _CHUNK_HEAD.size)
    (length,) = _LONG.unpack_from(data, start)
    packed = bytes(data[start + 8 : start + 8 + length])
    if size > MOST_CHUNK_BYTES:
        raise _DamagedError(f"damaged at byte {at}")
    if compression == "zstd":
        try:
            import zstandard
        except ImportError:
            raise StorageError("a recording needs more than is installed: pip install 'companion[recording]'") from None
        try:
            packed = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except zstandard.ZstdError:
            raise _DamagedError(f"damaged at byte {at}") from None
    elif compression:
        raise _DamagedError(f"compressed by {compression}, which is not read here")
    if len(packed) != size or (crc and zlib.crc32(packed) != crc):
        raise _DamagedError(f"damaged at byte {at}")
    return packed


def _text(data: Any, at: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    (length,) = _LENGTH.unpack_from(data, at)
    end = at + 4 + length
    if end > len(data):
        raise _DamagedError("damaged: a text ends beyond its record")
    return str(bytes(data[at + 4 : end]), "utf-8"), end


def _metadata(data: Any, at: int) -> Metadata:
    name, at = _text(data, at)
    (length,) = _LENGTH.unpack_from(data, at)
    at += 4
    end, table = at + length, {}
    while at < end:
        key, at = _text(data, at)
        table[key], at = _text(data, at)
    return Metadata(name, table)


def _attachment(data: Any, at: int) -> Attachment:
    name, at = _text(data, at + 16)
    _, at = _text(data, at)
    (length,) = _LONG.unpack_from(data, at)
    return Attachment(name, bytes(data[at + 8 : at + 8 + length]))
