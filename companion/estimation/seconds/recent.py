"""The latest rows of figures as an array that nobody has to put together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.physics.frames import Floats


class Recent:
    """At most `keep` rows; the oldest go first."""

    def __init__(self, keep: int, columns: int) -> None:
        self._keep = keep
        self._table = np.empty((2 * keep, columns))
        self._first = self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    def append(self, row: Sequence[float] | Floats) -> None:
        """Take the next row, (c,)."""
        if self._end == len(self._table):
            # Every `keep` rows: all that count go to the front.
            rows = self.rows
            self._table[: len(rows)] = rows
            self._first, self._end = 0, len(rows)
        self._table[self._end] = row
        self._end += 1
        self._first = max(self._first, self._end - self._keep)

    @property
    def rows(self) -> Floats:
        """(n, c), the latest last; to be looked at at once, it changes with the next row."""
        return self._table[self._first : self._end]

    def clear(self) -> None:
        """Forget all."""
        self._first = self._end = 0
