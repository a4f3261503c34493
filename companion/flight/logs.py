"""A log of either firmware."""

from __future__ import annotations

from pathlib import Path

from companion.errors import StorageError
from companion.flight import ardupilot_log, px4_log
from companion.flight.log import Boot
from companion.replay.autopilot_logs import Progress, read_ulog, reader_of

_ENCRYPTED = b"ULogEnc"


def read(path: Path, progress: Progress) -> list[Boot]:
    """Each start of the autopilot in it.

    Raises:
        StorageError: one line: it cannot be read, or is another file.
    """
    try:
        reader = reader_of(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    if reader is None:
        with path.open("rb") as file:
            if file.read(len(_ENCRYPTED)) == _ENCRYPTED:
                raise StorageError(f"{path}: encrypted by PX4: decrypt it first (Tools/log_encryption of PX4)")
        raise StorageError(f"{path}: no log of ArduPilot (.bin) or PX4 (.ulg)")
    boots = px4_log.read(path, progress) if reader is read_ulog else ardupilot_log.read(path, progress)
    if not any(boot.imus for boot in boots):
        raise StorageError(f"{path}: no samples of an IMU in it")
    return boots
