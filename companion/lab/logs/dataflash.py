"""ArduPilot's dataflash log (.bin): AP_Logger/LogStructure.h; the letters of its formats are pymavlink's.

Messages come out in blocks, piece by piece, so that memory does not grow with the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.errors import StorageError
from companion.lab.logs.log import PARAMETERS, US, Block

MAGIC: Final = b"\xa3\x95\x80"
"""Beginning of a file: the head of a format message that describes format messages."""
_HEAD: Final = MAGIC[:2]
_FMT: Final = np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")])
_CLOCK: Final = "TimeUS"
_PARAMETER: Final = "PARM"
_PIECE: Final = 1 << 22

Fields = Mapping[str, tuple[str, tuple[str, ...]]]
"""Field with the instance, or nothing, and fields to read, by message."""


class _Kind:
    """Layout of one kind of message, and the messages of it that wait for the end of a piece."""

    def __init__(self, length: int, name: str = "", layout: np.dtype[np.void] | None = None) -> None:
        self.length = length
        """Length with the head."""
        self.name = name
        self.layout = layout
        """None: not to be read."""
        self.factors: dict[str, float] = {}
        self.data = bytearray()

    def blocks(self, fields: Fields) -> Iterator[Block]:
        """Give the waiting messages, by instance."""
        if self.layout is None or not self.data:
            return
        messages = np.frombuffer(bytes(self.data), self.layout)
        self.data.clear()
        key, wanted = fields.get(self.name, ("Name", ("Value",)))
        there = messages.dtype.names or ()
        rows = np.full((len(messages), 1 + len(wanted)), np.nan)
        rows[:, 0] = messages[_CLOCK] * US
        with np.errstate(invalid="ignore"):  # damaged
            for k, name in enumerate(wanted, 1):
                if name in there:
                    rows[:, k] = messages[name] * self.factors.get(name, 1.0)
        if self.name == _PARAMETER:
            texts = tuple(text.decode("latin-1") for text in messages["Name"].tolist())
            yield Block(PARAMETERS, 0, rows, texts)
        elif key not in there:
            yield Block(self.name, 0, rows)
        else:
            for instance in np.unique(messages[key]).tolist():
                yield Block(self.name, int(instance), rows[messages[key] == instance])


def dataflash(path: Path, fields: Fields) -> Iterator[Block | None]:
    """Give these messages and the parameters; None where another log begins in the same file."""
    kinds: dict[bytes, _Kind] = {MAGIC: _Kind(_FMT.itemsize + 3)}
    left = b""
    for piece in _pieces(path):
        # So the last message is followed by a head, as any other.
        data = left + (piece or _HEAD)
        at, end = 0, len(data)
        while at + 3 <= end:
            kind = kinds.get(data[at : at + 3])
            after = end if kind is None else at + kind.length
            if kind is not None and after + 2 > end and piece:
                break
            if kind is None or data[after : after + 2] != _HEAD:
                # Damage: bytes that no other message follows are no message.
                at = data.find(_HEAD, at + 1)
                at = end - 1 if at < 0 else at
                continue
            if kind.layout is not None:
                kind.data += data[at + 3 : after]
            elif data[at + 2] == MAGIC[2]:
                head, described = _described(data[at + 3 : after], fields)
                if head == MAGIC or head in kinds:
                    for each in kinds.values():
                        yield from each.blocks(fields)
                if head == MAGIC:
                    yield None
                elif described is not None:
                    kinds[head] = described
            at = after
        left = data[at:]
        for each in kinds.values():
            yield from each.blocks(fields)


def _pieces(path: Path) -> Iterator[bytes]:
    """Give the bytes of a file; an empty piece is the last one."""
    try:
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_PIECE), b"")
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    yield b""


def _described(data: bytes, fields: Fields) -> tuple[bytes, _Kind | None]:
    """Give the head and the kind of the messages that a format message describes; None: it cannot be one."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    number, length, *said = np.frombuffer(data, _FMT)[0].tolist()
    name, letters, labels = (text.split(b"\0")[0].decode("latin-1") for text in said)
    head = _HEAD + bytes((number,))
    if length <= len(head):
        return head, None
    kind = _Kind(length, name)
    if name not in fields and name != _PARAMETER:
        return head, kind
    parts = []
    for letter, label in zip(letters, labels.split(","), strict=False):
        code, factor, _ = FORMAT_TO_STRUCT.get(letter, ("", None, None))
        parts.append((label, f"S{code[:-1]}" if code.endswith("s") else f"<{code}"))
        kind.factors[label] = 1.0 if factor is None else factor
    try:
        layout = np.dtype(parts)
    except (TypeError, ValueError):
        return head, kind
    key, wanted = fields.get(name, ("Name", ("Value",)))
    types = {label: layout[label].kind for label in layout.names or ()}
    good = layout.itemsize + len(head) == length and _CLOCK in types
    good = good and "S" not in {types.get(label) for label in (_CLOCK, *wanted)}
    if good and types.get(key, "u") in ("S" if name == _PARAMETER else "iu"):
        kind.layout = layout
    return head, kind
