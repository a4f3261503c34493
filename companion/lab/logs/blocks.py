"""A log of an autopilot in blocks: what its messages say, piece by piece, so that memory does not grow with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.errors import StorageError
from companion.physics.frames import Floats

_PIECE: Final = 1 << 22
US: Final = 1e-6
PARAMETERS: Final = "parameters"
DROPOUTS: Final = "dropouts"
"""How long the autopilot could not write, ms."""

Progress = Callable[[float], None]
"""Told how much of a file has been read, from 0 to 1."""


def nobody(_share: float) -> None:
    """Nobody wants to know."""


class Block(NamedTuple):
    """Some messages of one kind and instance, in the order of the file."""

    name: str
    """`PARAMETERS`: those of the autopilot, whatever the format calls them."""
    instance: int
    rows: Floats
    """(n, 1 + fields): the autopilot's clock in s, and the fields that were asked for; NaN: this log has no such."""
    texts: tuple[str, ...] = ()
    """The names of parameters; their values are the one field."""


class Kept:
    """Messages of one kind that wait for the end of a piece."""

    def __init__(self, name: str, instance: int, layout: np.dtype[np.void]) -> None:
        self.name, self.instance, self.layout = name, instance, layout
        self.data = bytearray()

    def taken(self) -> NDArray[np.void]:
        """All of them; they wait no longer."""
        found = np.frombuffer(bytes(self.data), self.layout)
        self.data.clear()
        return found


def columns(messages: NDArray[np.void], clock: str, fields: tuple[str, ...]) -> Floats:
    """(n, 1 + fields), the clock in s; NaN where a layout has no such field."""
    there = messages.dtype.names or ()
    found = np.full((len(messages), 1 + len(fields)), np.nan)
    found[:, 0] = messages[clock] * US
    with np.errstate(invalid="ignore"):  # damaged
        for k, name in enumerate(fields, 1):
            if name in there:
                found[:, k] = messages[name]
    return found


def pieces(path: Path, progress: Progress, end: int | None = None) -> Iterator[bytes]:
    """A file's bytes up to `end`; an empty piece is the last one.

    Raises:
        StorageError: one line: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            size = max(path.stat().st_size if end is None else end, 1)
            while piece := file.read(min(_PIECE, size - file.tell())):
                yield piece
                progress(min(file.tell() / size, 1.0))
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    yield b""
