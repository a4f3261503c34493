"""Logs of autopilots as blocks of numbers: ArduPilot's dataflash (.bin) and PX4's ULog (.ulg).

Dataflash: AP_Logger/LogStructure.h; the letters of its formats are pymavlink's. Its messages come out piece by piece,
so that memory does not grow with the file. A ULog is read by pyulog, which holds all messages of the topics in memory.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from companion.errors import StorageError
from companion.physics.frames import Floats

US: Final = 1e-6
PARAMETERS: Final = "parameters"
DROPOUTS: Final = "dropouts"
"""Name of the blocks with the times in which the autopilot could not write, ms."""
DATAFLASH_MAGIC: Final = b"\xa3\x95\x80"
"""Beginning of a dataflash log: the head of a format message that describes format messages."""
ULOG_MAGIC: Final = b"ULog\x01\x12\x35"
_HEAD: Final = DATAFLASH_MAGIC[:2]
_FMT: Final = np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")])
_CLOCK: Final = "TimeUS"
_PARAMETER: Final = "PARM"
_PIECE: Final = 1 << 22

Fields = Mapping[str, tuple[str, tuple[str, ...]]]
"""Field with the instance, or nothing, and fields to read, by message."""
_MOST_TIMES: Final = 4
"""Most times that a file is read: damage can lead pyulog back to where it was, again and again."""
_NEEDS_MORE: Final = (
    "a log of PX4 needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)

Topics = Mapping[str, tuple[str, ...]]
"""Fields to read by topic; arrays element by element: `gyro_rad[0]`."""


class Block(NamedTuple):
    """Messages of one kind and instance, in the order of the file."""

    name: str
    """`PARAMETERS`: parameters of the autopilot, whatever the format calls them."""
    instance: int
    rows: Floats
    """(n, 1 + fields): the autopilot's clock in s, and the fields to read; NaN: this log has no such field."""
    texts: tuple[str, ...] = ()
    """Names of parameters; their values are the one field."""


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
    kinds: dict[bytes, _Kind] = {DATAFLASH_MAGIC: _Kind(_FMT.itemsize + 3)}
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
            elif data[at + 2] == DATAFLASH_MAGIC[2]:
                head, described = _described(data[at + 3 : after], fields)
                if head == DATAFLASH_MAGIC or head in kinds:
                    for each in kinds.values():
                        yield from each.blocks(fields)
                if head == DATAFLASH_MAGIC:
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


class _Counted(io.BufferedReader):
    """A file of which only so much can be read."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = _MOST_TIMES * path.stat().st_size + (1 << 20)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read so many bytes."""
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise StorageError("its messages lead back to where they began")
        return data


def ulog(path: Path, topics: Topics) -> Iterator[Block]:
    """Give these topics, the parameters and the dropouts."""
    try:
        from pyulog import ULog
    except ImportError:
        raise StorageError(_NEEDS_MORE) from None
    try:
        # It prints what is damaged to stdout, where an answer may stand.
        with _Counted(path) as file, contextlib.redirect_stdout(None):
            log = ULog(file, [*topics])
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # noqa: BLE001 - pyulog raises anything of a damaged file
        raise StorageError(f"{path}: not a readable log of PX4: {' '.join(str(error).split())[:200]}") from None
    told = [(log.start_timestamp, name, value) for name, value in log.initial_parameters.items()]
    told = [each for each in (*told, *log.changed_parameters) if isinstance(each[2], int | float)]
    if told:
        rows = np.array([(t_us * US, value) for t_us, _, value in told], dtype=np.float64)
        yield Block(PARAMETERS, 0, rows, tuple(name for _, name, _ in told))
    if log.dropouts:
        yield Block(DROPOUTS, 0, np.array([(each.timestamp * US, each.duration) for each in log.dropouts]))
    for each in log.data_list:
        times_s = each.data.get("timestamp", np.zeros(0)) * US
        columns = [each.data.get(name, np.full(len(times_s), np.nan)) for name in topics[each.name]]
        if len(times_s):
            yield Block(each.name, each.multi_id, np.column_stack([times_s, *columns]).astype(np.float64))
