"""Reads a recording from its beginning as far as it goes: a file may end anywhere, and the power may have been cut.

Records are those of the MCAP specification, version 0, and all but messages are read by the `mcap` library. Its own
reader of whole streams makes an object of every message, wanted or not, which alone costs more than a whole replay
does; and it believes every length that a file says.
"""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from companion.errors import StorageError

MAGIC: Final = b"\x89MCAP0\r\n"
_CHANNEL, _MESSAGE, _CHUNK, _ATTACHMENT, _METADATA, _DATA_END = 0x04, 0x05, 0x06, 0x09, 0x0C, 0x0F
_HEAD: Final = struct.Struct("<BQ")
_WHOLE_HEAD: Final = struct.Struct("<BQHIQQ")
"""Bytes before a message's data: the record's header and its own."""
MOST_BYTES: Final = 16 * 1024 * 1024
"""The most bytes of a record, and of a chunk unpacked; ours have less than one MiB."""
MOST_TIMES: Final = 100
"""The most that all chunks together may unpack to, in sizes of the file, beside one chunk; ours reach four."""
MOST_TOPICS: Final = 1024
_NEEDS_MORE: Final = (
    "a recording needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)


class Message(msgspec.Struct, frozen=True, gc=False):
    """One message on a topic; `data` is JSON."""

    topic: str
    data: bytes


class Metadata(msgspec.Struct, frozen=True):
    """A named table of texts."""

    name: str
    table: dict[str, str]


class Attachment(msgspec.Struct, frozen=True):
    """A named file."""

    name: str
    data: bytes


Item = Message | Metadata | Attachment


class _DamagedError(Exception):
    """What follows cannot be read; its argument says why."""


def is_text(path: Path) -> bool:
    """Whether a file is no recording but looks like a log in text.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
    return bool(head) and not MAGIC.startswith(head) and b"\0" not in head


class Recording:
    """An MCAP file, read once from front to end.

    Raises:
        StorageError: one line: it cannot be read, is empty, or is nothing of this kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut_short: str | None = None
        """After reading: why it ended before its end, in words; None when it is whole."""
        self._topics: set[str] = set()
        self._topic_of: dict[int, str] = {}
        """By channel, of those that are wanted."""
        try:
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
                if not head:
                    raise StorageError(f"{path}: the file is empty")
                if not MAGIC.startswith(head):
                    raise StorageError(f"{path}: not a recording (MCAP), nor any log that is known")
                self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            raise StorageError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None

    def __iter__(self) -> Iterator[Item]:
        """Everything in the order of writing, until the end or a cut."""
        return self.items(lambda topic: True)

    def items(self, wanted: Callable[[str], bool]) -> Iterator[Item]:
        """The same, without the messages on topics that are not wanted."""
        try:
            import zstandard as _  # noqa: F401 - says here whether it is there
            from mcap.exceptions import EndOfFile
        except ImportError:
            raise StorageError(_NEEDS_MORE) from None
        try:
            yield from self._file(wanted)
        except (_DamagedError, EndOfFile, struct.error, OverflowError, UnicodeDecodeError) as error:
            self.cut_short = str(error) or "damaged: a record ends too early"

    def _file(self, wanted: Callable[[str], bool]) -> Iterator[Item]:
        data, size = self._data, len(self._data)
        at, room = len(MAGIC), MOST_BYTES + MOST_TIMES * size
        if size < at:
            raise _DamagedError(f"cut in its first {at} bytes")
        while at < size:
            kind, begin, at = _record(data, at)
            if kind == _DATA_END and data[size - len(MAGIC) :] == MAGIC:
                return
            if at - begin > MOST_BYTES:
                raise _too_large(begin, at - begin)
            if kind == _CHUNK:
                chunk = _unpacked(data[begin:at], begin)
                room -= len(chunk)
                if room < 0:
                    raise _DamagedError(f"damaged: unpacks to more than {MOST_TIMES} times its size")
                yield from self._records(chunk, wanted)
            else:
                yield from self._records(data[begin - _HEAD.size : at], wanted)
        raise _DamagedError(f"cut at byte {size}")

    def _records(self, data: bytes, wanted: Callable[[str], bool]) -> Iterator[Item]:
        from mcap import records

        at, size, topic_of = 0, len(data), self._topic_of
        while at < size:
            if data[at] == _MESSAGE and size - at >= _WHOLE_HEAD.size:
                # A million of these: no call, and no object of those that nobody wants.
                _, length, channel, *_ = _WHOLE_HEAD.unpack_from(data, at)
                begin, at = at + _WHOLE_HEAD.size, at + _HEAD.size + length
                if not begin <= at <= size:
                    raise _DamagedError("damaged: a message does not end where it should")
                if channel in topic_of:
                    yield Message(topic_of[channel], data[begin:at])
                continue
            kind, begin, at = _record(data, at)
            if kind == _MESSAGE:
                raise _DamagedError("damaged: a message does not end where it should")
            if kind == _CHANNEL:
                self._channel(records.Channel.read(_stream(data[begin:at])), wanted)
            elif kind == _METADATA:
                table = records.Metadata.read(_stream(data[begin:at]))
                yield Metadata(table.name, table.metadata)
            elif kind == _ATTACHMENT:
                file = records.Attachment.read(_stream(data[begin:at]))
                yield Attachment(file.name, file.data)

    def _channel(self, channel: Any, wanted: Callable[[str], bool]) -> None:
        self._topics.add(channel.topic)
        if len(self._topics) > MOST_TOPICS:
            raise _DamagedError(f"damaged: more than {MOST_TOPICS} topics")
        self._topic_of.pop(channel.id, None)
        if wanted(channel.topic):
            self._topic_of[channel.id] = channel.topic


def _record(data: Any, at: int) -> tuple[int, int, int]:
    """The record that begins at `at`: its kind, where its content begins, where it ends."""
    size = len(data)
    if size - at < _HEAD.size:
        raise _DamagedError(f"cut at byte {size}")
    kind, length = _HEAD.unpack_from(data, at)
    at += _HEAD.size
    if kind == 0 or at + length > size:
        raise _DamagedError(f"cut at byte {size}" if kind else f"nothing but zeros from byte {at} on")
    return kind, at, at + length


def _too_large(at: int, size: int) -> _DamagedError:
    return _DamagedError(f"damaged at byte {at}: found {size} bytes in one piece; allowed: {MOST_BYTES}")


def _stream(data: bytes) -> Any:
    from mcap.data_stream import ReadDataStream

    return ReadDataStream(io.BytesIO(data))


def _unpacked(data: bytes, at: int) -> bytes:
    """The records in a chunk, checked."""
    from mcap.records import Chunk

    chunk = Chunk.read(_stream(data))
    size, packed = chunk.uncompressed_size, chunk.data
    if size > MOST_BYTES:
        raise _too_large(at, size)
    if chunk.compression == "zstd":
        try:
            packed = decompressed(packed, size)
        except ValueError:
            raise _DamagedError(f"damaged at byte {at}") from None
    elif chunk.compression:
        raise _DamagedError(f"compressed by {chunk.compression}, which is not read here")
    if len(packed) != size or (chunk.uncompressed_crc and zlib.crc32(packed) != chunk.uncompressed_crc):
        raise _DamagedError(f"damaged at byte {at}")
    return bytes(packed)


def decompressed(packed: bytes, most: int) -> bytes:
    """What zstd has packed: what a frame says of itself is not believed.

    Raises:
        ValueError: it is damaged, or of more than so many bytes.
    """
    import zstandard

    try:
        # What a frame says is made room for, whatever the limit is.
        if zstandard.frame_content_size(packed) > most:
            raise ValueError(f"unpacks to more than {most} bytes")
        return bytes(zstandard.ZstdDecompressor(max_window_size=MOST_BYTES).decompress(packed, max_output_size=most))
    except zstandard.ZstdError as error:
        raise ValueError(f"cannot be unpacked: {error}") from None
