"""Reads a recording from its beginning as far as it goes: a file may end anywhere, and the power may have been cut.

The library's readers want the end of the file, or stop with an exception at the first cut; and a replay is to be a
hundred times faster than what it replays. The records are those of the MCAP specification, version 0.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.errors import StorageError

MAGIC: Final = b"\x89MCAP0\r\n"
_CHANNEL, _MESSAGE, _CHUNK, _ATTACHMENT, _METADATA, _DATA_END = 0x04, 0x05, 0x06, 0x09, 0x0C, 0x0F
_HEAD: Final = struct.Struct("<BQ")
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_WHOLE_HEAD: Final = _HEAD.size + _MESSAGE_HEAD.size
_LOG_TIME: Final = _HEAD.size + 6
"""Where in a message it stands: behind the numbers of its channel and its own."""
_LENGTH: Final = struct.Struct("<I")
_LONG: Final = struct.Struct("<Q")
MOST_BYTES: Final = 16 * 1024 * 1024
"""Of a record in the file, and of a chunk unpacked; ours have a state of some MB at most."""
MOST_TIMES: Final = 100
"""All chunks together unpack to so many times the file at most, and one chunk's worth; ours to four times."""
MOST_TOPICS: Final = 1024

AT_ONCE: Final = 8
"""Records that are given together to the thread that unpacks them: to hand one over costs half of unpacking it."""
AT_ONCE_BYTES: Final = 2 * 1024 * 1024
"""The last of them may be beyond that, unpacked; a chunk is a second or less."""
GROUPS_AHEAD: Final = 2
"""Unpacked before they are asked for."""

_Record = tuple[int, int, int]
"""Its kind, where its content begins, where it ends."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message on a topic; `data` is JSON."""

    topic: str
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages that follow each other, as far as somebody wants them; (n,) of each."""

    numbers: NDArray[np.int64]
    """Of the topic of each: its place in `Recording.topics`."""
    log_times_ns: NDArray[np.uint64]
    data: list[bytes]


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
        self.topics: list[str] = []
        """That were met so far."""
        self._places: dict[str, int] = {}
        self._number_of = np.full(1 << 16, -1)
        """The number of a channel's topic; negative where it is not known or not wanted."""
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
        for item in self.runs():
            if isinstance(item, Messages):
                topics = [self.topics[number] for number in item.numbers.tolist()]
                yield from map(Message, topics, item.log_times_ns.tolist(), item.data)
            else:
                yield item

    def runs(self, wanted: Callable[[str], bool] | None = None) -> Iterator[Messages | Metadata | Attachment]:
        """The same, many messages at once.

        Args:
            wanted: says of a topic, once, whether its messages are; None: all are.
        """
        self._wanted = wanted or (lambda topic: True)
        try:
            yield from self._file(memoryview(self._data))
        except (_DamagedError, struct.error, UnicodeDecodeError) as error:
            self.cut_short = str(error)

    def _file(self, data: memoryview) -> Iterator[Messages | Metadata | Attachment]:
        """What is in a file; a thread unpacks the next chunks meanwhile, which needs no interpreter."""
        records, damage = _outermost(data), None
        room = MOST_BYTES + MOST_TIMES * len(data)
        waiting: deque[tuple[list[_Record], Future[list[bytes | Exception | None]]]] = deque()
        with ThreadPoolExecutor(max_workers=1) as thread:
            while True:
                while damage is None and len(waiting) < GROUPS_AHEAD:
                    group, damage = _group(data, records)
                    waiting.append((group, thread.submit(_unpack, data, group)))
                if not waiting:
                    break
                group, unpacking = waiting.popleft()
                for (kind, at, end), chunk in zip(group, unpacking.result(), strict=False):
                    if isinstance(chunk, Exception):
                        raise chunk
                    if chunk is not None:
                        room -= len(chunk)
                        if room < 0:
                            raise _DamagedError(f"damaged: unpacks to more than {MOST_TIMES} times its size")
                        yield from self._chunk(chunk)
                    elif kind == _MESSAGE:
                        yield self._messages(bytes(data[at - _HEAD.size : end]), np.zeros(1, dtype=np.int64))
                    else:
                        yield from self._other(kind, data[at:end])
        if isinstance(damage, _DamagedError):
            raise damage

    def _chunk(self, data: bytes) -> Iterator[Messages | Metadata | Attachment]:
        """What is in a chunk."""
        at, size = 0, len(data)
        while at < size:
            kind, at, end = _record(data, at)
            if kind == _MESSAGE:
                starts = _chain(data, at - _HEAD.size)
                yield self._messages(data, starts)
                _, _, end = _record(data, int(starts[-1]))
            elif kind == _DATA_END:
                return
            else:
                yield from self._other(kind, data[at:end])
            at = end

    def _other(self, kind: int, data: Any) -> Iterator[Metadata | Attachment]:
        """What a record that is neither message nor chunk has in it."""
        if kind == _CHANNEL:
            number = int.from_bytes(data[:2], "little")
            topic = _text(data, 4)[0]
            place = self._places.setdefault(topic, len(self.topics))
            if place == len(self.topics):
                if place == MOST_TOPICS:
                    raise _DamagedError(f"damaged: more than {MOST_TOPICS} topics")
                self.topics.append(topic)
            self._number_of[number] = place if self._wanted(topic) else -1
        elif kind == _METADATA:
            yield _metadata(data)
        elif kind == _ATTACHMENT:
            yield _attachment(data)

    def _messages(self, data: bytes, starts: NDArray[np.int64]) -> Messages:
        """Those of the messages that begin there whose topics are known and wanted."""
        numbers = self._number_of[_anywhere(data, "<u2")[starts + _HEAD.size]]
        chosen = numbers >= 0
        starts = starts[chosen]
        begins = (starts + _WHOLE_HEAD).tolist()
        ends = (starts + _HEAD.size + _anywhere(data, "<u8")[starts + 1].astype(np.int64)).tolist()
        return Messages(
            numbers[chosen],
            _anywhere(data, "<u8")[starts + _LOG_TIME],
            [data[begin:end] for begin, end in zip(begins, ends, strict=True)],
        )


def _record(data: Any, at: int) -> _Record:
    """The record that begins at `at`: its kind, where its content begins, where it ends."""
    size = len(data)
    if size - at < _HEAD.size:
        raise _DamagedError(f"cut at byte {size}")
    kind, length = _HEAD.unpack_from(data, at)
    at += _HEAD.size
    if kind == 0 or at + length > size:
        raise _DamagedError(f"cut at byte {size}" if kind else f"nothing but zeros from byte {at} on")
    if kind == _MESSAGE and length < _MESSAGE_HEAD.size:
        raise _DamagedError("damaged: a message is shorter than its head")
    return kind, at, at + length


def _outermost(data: Any) -> Iterator[_Record]:
    """The records of a file, as `_record` gives them, until the end of its data."""
    at, size = len(MAGIC), len(data)
    if size < at:
        raise _DamagedError(f"cut in its first {at} bytes")
    while at < size:
        kind, begin, at = _record(data, at)
        if kind == _DATA_END:
            return
        if at - begin > MOST_BYTES:
            raise _too_large(begin, at - begin)
        yield kind, begin, at
    raise _DamagedError(f"cut at byte {size}")


def _too_large(at: int, size: int) -> _DamagedError:
    return _DamagedError(f"damaged at byte {at}: found {size} bytes in one piece; allowed: {MOST_BYTES}")


def _group(data: Any, records: Iterator[_Record]) -> tuple[list[_Record], Exception | None]:
    """The next records, and what came instead of one more: the end, or a cut."""
    group: list[_Record] = []
    size = 0
    while len(group) < AT_ONCE and size < AT_ONCE_BYTES:
        try:
            kind, at, end = next(records)
        except (StopIteration, _DamagedError) as error:
            return group, error
        group.append((kind, at, end))
        if kind == _CHUNK and end - at >= _CHUNK_HEAD.size:
            size += _CHUNK_HEAD.unpack_from(data, at)[2]
    return group, None


def _unpack(data: Any, group: list[_Record]) -> list[bytes | Exception | None]:
    """What is in the chunks among these records, as far as they are sound; in its place what is wrong with one."""
    found: list[bytes | Exception | None] = []
    decompress = _decompressor()
    for kind, at, end in group:
        try:
            found.append(_chunk(data[at:end], at, decompress) if kind == _CHUNK else None)
        except (_DamagedError, StorageError, struct.error, UnicodeDecodeError) as error:
            return [*found, error]
    return found


def _decompressor() -> Callable[[Any, int], bytes] | None:
    """Unpacks to so many bytes at most, or raises `_DamagedError`; None where the library is not installed."""
    try:
        import zstandard
    except ImportError:
        return None
    unpack = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES).decompress

    def decompress(packed: Any, size: int) -> bytes:
        try:
            # What a frame says of itself is made room for, whatever the limit is.
            if zstandard.frame_content_size(packed) > size:
                raise _DamagedError
            return unpack(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise _DamagedError from error

    return decompress


def _anywhere(data: Any, kind: str) -> NDArray[Any]:
    """The numbers that begin at each byte."""
    size = np.dtype(kind).itemsize
    return np.ndarray((max(len(data) - size + 1, 0),), kind, data, strides=(1,))


def _chain(data: bytes, at: int) -> NDArray[np.int64]:
    """Where the messages begin that follow each other in a chunk, from a whole one on at `at`.

    Each says where the next one is; but what looks like the beginning of one nearly always is, and can be looked for
    everywhere at once.
    """
    looks = np.frombuffer(data, np.uint8)[at : len(data) - _WHOLE_HEAD + 1] == _MESSAGE
    # So many messages would not fit in: of what is all beginnings, nothing is gained by looking everywhere.
    if np.count_nonzero(looks) <= len(data) // _WHOLE_HEAD:
        found: NDArray[np.int64] = at + np.flatnonzero(looks)
        heads = _anywhere(data, "<u8")[found + 1]
        likely = (heads >= _MESSAGE_HEAD.size) & (heads < MOST_BYTES)
        found, ends = found[likely], found[likely] + _HEAD.size + heads[likely].astype(np.int64)
        if bool((ends[:-1] == found[1:]).all()) and ends[-1] <= len(data):
            return found
    return np.fromiter(_one_by_one(data, at), dtype=np.int64)


def _one_by_one(data: Any, at: int) -> Iterator[int]:
    """The same by going from each to the next."""
    with contextlib.suppress(_DamagedError):
        while _record(data, at)[0] == _MESSAGE:
            yield at
            at = _record(data, at)[2]


def _chunk(data: Any, at: int, decompress: Callable[[Any, int], bytes] | None) -> bytes:
    """The records in a chunk, unpacked and checked."""
    _, _, size, crc = _CHUNK_HEAD.unpack_from(data, 0)
    compression, start = _text(data, _CHUNK_HEAD.size)
    (length,) = _LONG.unpack_from(data, start)
    packed = data[start + 8 : start + 8 + length]
    if size > MOST_BYTES:
        raise _too_large(at, size)
    if compression == "zstd":
        if decompress is None:
            raise StorageError("a recording needs more than is installed: pip install 'companion[recording]'")
        try:
            packed = decompress(packed, size)
        except _DamagedError:
            raise _DamagedError(f"damaged at byte {at}") from None
    elif compression:
        raise _DamagedError(f"compressed by {compression}, which is not read here")
    if len(packed) != size or (crc and zlib.crc32(packed) != crc):
        raise _DamagedError(f"damaged at byte {at}")
    return bytes(packed)


def _text(data: Any, at: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    (length,) = _LENGTH.unpack_from(data, at)
    end = at + 4 + length
    if end > len(data):
        raise _DamagedError("damaged: a text ends beyond its record")
    return str(bytes(data[at + 4 : end]), "utf-8"), end


def _metadata(data: Any) -> Metadata:
    name, at = _text(data, 0)
    (length,) = _LENGTH.unpack_from(data, at)
    at += 4
    end, table = at + length, {}
    while at < end:
        key, at = _text(data, at)
        table[key], at = _text(data, at)
    return Metadata(name, table)


def _attachment(data: Any) -> Attachment:
    name, at = _text(data, 16)
    _, at = _text(data, at)
    (length,) = _LONG.unpack_from(data, at)
    return Attachment(name, bytes(data[at + 8 : at + 8 + length]))
