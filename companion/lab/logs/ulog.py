"""PX4's log (.ulg), read by pyulog, which holds all messages of the topics in memory."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.errors import StorageError
from companion.lab.logs.log import DROPOUTS, PARAMETERS, US, Block

MAGIC: Final = b"ULog\x01\x12\x35"
_MOST_TIMES: Final = 4
"""Most times that a file is read: damage can lead pyulog back to where it was, again and again."""
_NEEDS_MORE: Final = (
    "a log of PX4 needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)

Topics = Mapping[str, tuple[str, ...]]
"""Fields to read by topic; arrays element by element: `gyro_rad[0]`."""


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
