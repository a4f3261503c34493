"""PX4's log (.ulg): the user guide's "ULog File Format"."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.calibration.noise.robust import median
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
                # Damage: on with the next message that can only be one.
                found = log.again.search(data, at + 1)
                at = max(end - len(MAGIC), at + 1) if found is None else found.start()
                continue
            if kept is not None:
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
        self._formats: dict[str, str] = {}
        self._kept: dict[int, Kept] = {}
        self._parameters: list[tuple[float, str, float]] = []
        self._dropouts: list[tuple[float, float]] = []
        self.heads: dict[bytes, Kept] = {}
        """By the first five bytes of a message."""
        self.again = re.compile(re.escape(MAGIC))
        """Finds one of these."""

    def take(self, kind: int, body: bytes) -> Iterator[Block]:
        """A format, a subscription, a parameter or a dropout; what cannot be one is passed over."""
        try:
            if kind == ord("F"):
                name, _, fields = body.decode("latin-1").partition(":")
                if name in self._topics:
                    self._formats[name] = fields
            elif kind == ord("A"):
                yield from self.flush()
                instance, number = _SUBSCRIPTION.unpack_from(body)
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
        if (before := self._kept.pop(number, None)) is not None:
            self.heads = {head: kept for head, kept in self.heads.items() if kept is not before}
        if name in self._formats:
            layout, padding = _layout(self._formats[name])
            kept = self._kept[number] = Kept(name, instance, layout)
            for more in {0, padding}:
                self.heads[struct.pack("<HcH", layout.itemsize + more + 2, b"D", number)] = kept
        self.again = re.compile(b"|".join(map(re.escape, (MAGIC, *self.heads))))

    def flush(self) -> Iterator[Block]:
        """All that waits."""
        latest = []
        for kept in self._kept.values():
            if kept.data:
                rows = columns(kept.taken(), _CLOCK, self._topics[kept.name])
                latest.append(rows[-1, 0])
                yield Block(kept.name, kept.instance, rows)
        if latest:
            # One of them may be damaged.
            self._now_s = float(median(latest))
        if self._parameters:
            times, names, values = zip(*self._parameters, strict=True)
            self._parameters = []
            yield Block(PARAMETERS, 0, np.column_stack([times, values]), names)
        if self._dropouts:
            yield Block(DROPOUTS, 0, np.array(self._dropouts))
            self._dropouts = []


def _layout(fields: str) -> tuple[np.dtype[np.void], int]:
    """Of a topic without others nested in it, and how many bytes at its end need not be there.

    Raises:
        KeyError, ValueError, TypeError: it cannot be.
    """
    parts: list[tuple[str, str]] = []
    for field in filter(None, fields.split(";")):
        kind, name = field.split(" ")
        kind, _, count = kind.rstrip("]").partition("[")
        if count and len(parts) + int(count) > _LARGEST:
            raise ValueError(field)
        parts += [(f"{name}[{k}]", _TYPES[kind]) for k in range(int(count))] if count else [(name, _TYPES[kind])]
    padded = np.dtype(parts).itemsize
    while parts and parts[-1][0].startswith("_padding"):
        parts.pop()
    layout = np.dtype(parts)
    if _CLOCK not in (layout.names or ()) or padded + 2 > _LARGEST:
        raise ValueError(fields)
    return layout, padded - layout.itemsize


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
