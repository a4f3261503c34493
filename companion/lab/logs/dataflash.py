"""ArduPilot's dataflash log (.bin): AP_Logger/LogStructure.h; the letters of its formats are pymavlink's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.lab.logs.blocks import PARAMETERS, Block, Kept, Progress, columns, nobody, pieces

MAGIC: Final = b"\xa3\x95\x80"
"""It begins with what says how such beginnings are made."""
_HEAD: Final = MAGIC[:2]
_FMT: Final = np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")])
_CLOCK: Final = "TimeUS"
_PARAMETER: Final = "PARM"

Fields = Mapping[str, tuple[str, tuple[str, ...]]]
"""By message: the field with its instance, or nothing, and those to read."""


class _Kind:
    """What a format message says of others."""

    def __init__(self, length: int, kept: Kept | None, factors: Mapping[str, float]) -> None:
        self.length = length
        """With its head."""
        self.kept = kept
        """None: nobody wants them."""
        self.factors = factors


def dataflash(path: Path, fields: Fields, progress: Progress = nobody) -> Iterator[Block | None]:
    """These messages and the parameters; None where another log begins in the same file.

    Raises:
        StorageError: one line: it cannot be read.
    """
    kinds: dict[bytes, _Kind] = {MAGIC: _Kind(_FMT.itemsize + 3, None, {})}
    left = b""
    for piece in pieces(path, progress):
        # So the last message is followed by a head, as any other.
        data = left + (piece or _HEAD)
        at, end = 0, len(data)
        while at + 3 <= end:
            kind = kinds.get(data[at : at + 3])
            after = end if kind is None else at + kind.length
            if kind is not None and after + 2 > end and piece:
                break
            if kind is None or data[after : after + 2] != _HEAD:
                # Damage: whatever is not followed by another message is none.
                at = data.find(_HEAD, at + 1)
                at = end - 1 if at < 0 else at
                continue
            if kind.kept is not None:
                kind.kept.data += data[at + 3 : after]
            elif data[at + 2] == MAGIC[2]:
                head, learnt = _learn(data[at + 3 : after], fields)
                if head == MAGIC or head in kinds:
                    yield from _flush(kinds, fields)
                if head == MAGIC:
                    yield None
                elif learnt is not None:
                    kinds[head] = learnt
            at = after
        left = data[at:]
        yield from _flush(kinds, fields)


def _learn(data: bytes, fields: Fields) -> tuple[bytes, _Kind | None]:
    """The head of the messages that a format message is about; None: it cannot be."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    number, length, *said = np.frombuffer(data, _FMT)[0].tolist()
    name, letters, labels = (text.split(b"\0")[0].decode("latin-1") for text in said)
    head = _HEAD + bytes((number,))
    if length <= len(head):
        return head, None
    if name not in fields and name != _PARAMETER:
        return head, _Kind(length, None, {})
    parts, factors = [], {}
    for letter, label in zip(letters, labels.split(","), strict=False):
        code, factor, _ = FORMAT_TO_STRUCT.get(letter, ("", None, None))
        parts.append((label, f"S{code[:-1]}" if code.endswith("s") else f"<{code}"))
        factors[label] = 1.0 if factor is None else factor
    try:
        layout = np.dtype(parts)
    except (TypeError, ValueError):
        return head, _Kind(length, None, {})
    key, wanted = fields.get(name, ("Name", ("Value",)))
    kinds = {label: layout[label].kind for label in layout.names or ()}
    texts = {label for label in (_CLOCK, *wanted) if kinds.get(label) == "S"}
    good = layout.itemsize + len(head) == length and _CLOCK in kinds and not texts
    good = good and kinds.get(key, "u") in ("S" if name == _PARAMETER else "iu")
    return head, _Kind(length, Kept(name, 0, layout) if good else None, factors)


def _flush(kinds: Mapping[bytes, _Kind], fields: Fields) -> Iterator[Block]:
    for kind in kinds.values():
        if kind.kept is None or not kind.kept.data:
            continue
        name, messages = kind.kept.name, kind.kept.taken()
        if name == _PARAMETER:
            texts = tuple(text.decode("latin-1") for text in messages["Name"].tolist())
            yield Block(PARAMETERS, 0, columns(messages, _CLOCK, ("Value",)), texts)
            continue
        key, wanted = fields[name]
        rows = columns(messages, _CLOCK, wanted) * [1.0, *(kind.factors.get(each, 1.0) for each in wanted)]
        if key not in (messages.dtype.names or ()):
            yield Block(name, 0, rows)
            continue
        instances = messages[key]
        for instance in np.unique(instances).tolist():
            yield Block(name, int(instance), rows[instances == instance])
