"""PX4's log (.ulg): the user guide's "ULog File Format"."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.errors import StorageError
from companion.replay.blocks import DROPOUTS, PARAMETERS, US, Block, Kept, Progress, columns, nobody, pieces

MAGIC: Final = b"ULog\x01\x12\x35"
_START: Final = struct.Struct("<8xQ")
_FLAGS: Final = struct.Struct("<16x2xc8xB7sQ")
_HEADER: Final = struct.Struct("<HB")
_SUBSCRIPTION: Final = struct.Struct("<BH")
_KNOWN: Final = frozenset(b"BFIMPQARDLCSO")
_FOLLOWS: Final = frozenset((b"", *(bytes((kind,)) for kind in _KNOWN)))
"""What is not followed by another message or the end is damaged."""
_TOLD: Final = frozenset(b"FAPO")
_LARGEST: Final = 65535
_MAY_BEGIN: Final = re.compile(b"(?=" + re.escape(MAGIC) + b"|..D..)", re.DOTALL)
"""Matches where a log or a data message may begin."""
_CLOCK: Final = "timestamp"
_TYPES: Final = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "?", "char": "u1",
}  # fmt: skip

Topics = Mapping[str, tuple[str, ...]]
"""By topic the fields to read, of arrays element by element: `gyro_rad[0]`."""


def ulog(path: Path, topics: Topics, progress: Progress = nobody) -> Iterator[Block | None]:
    """These topics, the parameters and the dropouts; None where another log begins in the same file.

    Raises:
        StorageError: one line: it cannot be read, or is of a later format.
    """
    left, log = b"", _Log(topics)
    for piece in pieces(path, progress, _appended(path)):
        data = left + piece
        at, end = 0, len(data)
        while at + 5 <= end:
            kept = log.heads.get(data[at : at + 5])
            size, kind = _HEADER.unpack_from(data, at)
            after = at + 3 + size
            if after + len(MAGIC) > end and piece and kind in _KNOWN:
                break
            follows = data[after + 2 : after + 3] in _FOLLOWS or data.startswith(MAGIC, after)
            if kind not in _KNOWN or after > end or not follows:
                if data.startswith(MAGIC, at):
                    if end < at + _START.size:
                        break
                    yield from log.flush()
                    yield None
                    log = _Log(topics, _START.unpack_from(data, at)[0] * US)
                    at += _START.size
                    continue
                at = log.resume(data, at + 1)
                continue
            if kept is not None:
                if not kept.data:
                    log.waiting.append(kept)
                kept.data += data[at + 5 : at + 5 + kept.layout.itemsize]
            elif kind in _TOLD:
                yield from log.take(kind, data[at + 3 : after])
            at = after
        left = data[at:]
        yield from log.flush()


class _Log:
    """What of one log is known so far."""

    def __init__(self, topics: Topics, start_s: float = 0.0) -> None:
        self._topics = topics
        self._now_s = start_s
        self._layouts: dict[str, tuple[np.dtype[np.void], int]] = {}
        self._subscribed: dict[int, tuple[bytes, ...]] = {}
        """Keys of `heads` by the number of a subscription."""
        self._parameters: list[tuple[float, str, float]] = []
        self._dropouts: list[tuple[float, float]] = []
        self.heads: dict[bytes, Kept] = {}
        """By the first five bytes of a message."""
        self.waiting: list[Kept] = []
        """Those that hold messages; a flush visits no others, whatever a log subscribes to."""

    def take(self, kind: int, body: bytes) -> Iterator[Block]:
        """A format, a subscription, a parameter or a dropout; what cannot be one is passed over."""
        try:
            if kind == ord("F"):
                name, _, fields = body.decode("latin-1").partition(":")
                if name in self._topics:
                    self._layouts.pop(name, None)
                    self._layouts[name] = _layout(fields, self._topics[name])
            elif kind == ord("A"):
                instance, number = _SUBSCRIPTION.unpack_from(body)
                if number in self._subscribed:
                    yield from self.flush()
                self._subscribe(number, body[_SUBSCRIPTION.size :].decode("latin-1"), instance)
            elif kind == ord("P"):
                yield from self.flush()
                key = body[1 : 1 + body[0]].decode("latin-1")
                what, _, name = key.partition(" ")
                value = np.frombuffer(body[1 + body[0] :], _TYPES[what])
                self._parameters.append((self._now_s, name, float(value[0])))
            else:
                self._dropouts.append((self._now_s, float(int.from_bytes(body[:2], "little"))))
        except (KeyError, IndexError, ValueError, TypeError, struct.error):
            return

    def _subscribe(self, number: int, name: str, instance: int) -> None:
        for head in self._subscribed.pop(number, ()):
            del self.heads[head]
        if name in self._layouts:
            layout, padding = self._layouts[name]
            kept = Kept(name, instance, layout)
            sizes = {layout.itemsize, layout.itemsize + padding}
            heads = tuple(struct.pack("<HcH", size + 2, b"D", number) for size in sizes)
            self._subscribed[number] = heads
            self.heads.update(dict.fromkeys(heads, kept))

    def resume(self, data: bytes, start: int) -> int:
        """Return the place after damage of the next message that is known, or where the search goes on."""
        for found in _MAY_BEGIN.finditer(data, start):
            at = found.start()
            if data[at : at + 5] in self.heads or data.startswith(MAGIC, at):
                return at
        return max(len(data) - len(MAGIC), start)

    def flush(self) -> Iterator[Block]:
        """All that waits."""
        latest = []
        for kept in self.waiting:
            rows = columns(kept.taken(), _CLOCK, self._topics[kept.name])
            latest.append(rows[-1, 0])
            yield Block(kept.name, kept.instance, rows)
        self.waiting = []
        if latest:
            # One of them may be damaged.
            self._now_s = float(np.median(latest))
        if self._parameters:
            times, names, values = zip(*self._parameters, strict=True)
            self._parameters = []
            yield Block(PARAMETERS, 0, np.column_stack([times, values]), names)
        if self._dropouts:
            yield Block(DROPOUTS, 0, np.array(self._dropouts))
            self._dropouts = []


def _layout(fields: str, wanted: tuple[str, ...]) -> tuple[np.dtype[np.void], int]:
    """Return the clock and the wanted fields of a topic, and how many bytes at its end need not be there.

    Arrays are never spread out: a format of 20 bytes can declare an array of 65,000 elements.

    Raises:
        KeyError, ValueError, TypeError: no such topic can be read.
    """
    places: dict[str, tuple[str, int, int | None]] = {}
    padded = size = 0
    for field in filter(None, fields.split(";")):
        kind, name = field.split(" ")
        kind, _, length = kind.rstrip("]").partition("[")
        count = int(length) if length else None
        if name in places or (count or 0) < 0:
            raise ValueError(field)
        places[name] = _TYPES[kind], padded, count
        padded += np.dtype(_TYPES[kind]).itemsize * (1 if count is None else count)
        size = size if name.startswith("_padding") else padded
    found: dict[str, tuple[str, int]] = {}
    for each in (_CLOCK, *wanted):
        name, _, element = each.rstrip("]").partition("[")
        code, at, count = places.get(name, ("", 0, None))
        if code and (count is None) == (not element) and int(element or 0) < (1 if count is None else count):
            found[each] = code, at + int(element or 0) * np.dtype(code).itemsize
    if _CLOCK not in found or padded + 2 > _LARGEST:
        raise ValueError(fields)
    codes, offsets = zip(*found.values(), strict=True)
    return np.dtype({"names": [*found], "formats": codes, "offsets": offsets, "itemsize": size}), padded - size


def _appended(path: Path) -> int | None:
    """Where what was written after a crash begins: that is about the crash.

    Raises:
        StorageError: one line: it cannot be read, or is of a later format.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_FLAGS.size)
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(head) < _FLAGS.size:
        return None
    kind, flags, others, offset = _FLAGS.unpack(head)
    if kind != b"B":
        return None
    if flags & ~1 or any(others):
        raise StorageError(f"{path}: of a later format of PX4's logs than is known here")
    return offset if flags and offset > len(head) else None
