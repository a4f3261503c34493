"""The alignment in force: one file, whole or not there."""

from __future__ import annotations

from pathlib import Path

from companion.calibration.alignment.align_record import FORMAT_VERSION, AlignmentRecord, check
from companion.storage.state import StateFile


class AlignmentStore(StateFile[AlignmentRecord]):
    """`alignment.json` in the storage directory."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory / "alignment.json", AlignmentRecord, check, FORMAT_VERSION)
