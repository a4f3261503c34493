"""How far the time in our signatures has come, kept over a restart and a power cut."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from companion.storage.atomic import write_atomically

FILE: Final = "mavlink-signing-time.json"
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class SigningTime(msgspec.Struct, frozen=True):
    """What was used, and when. Ticks are 10 us since 2015."""

    ticks: int
    reserved: int
    """None beyond this may have been used before the next one was written."""
    uptime_s: float
    """Of the board, when this was written."""
    boot_id: str
    """Which start of the board it was; empty: unknown."""


def this_boot() -> str:
    """Of the running kernel; empty where it cannot be had."""
    # The service's unit hides the file, and hands the id over instead.
    handed = os.environ.get("COMPANION_BOOT_ID", "")
    if handed:
        return handed.replace("-", "")
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip().replace("-", "")
    except OSError:
        return ""


def load(directory: Path) -> SigningTime | None:
    """What was kept; None where nothing is, or nothing that can be read."""
    try:
        found = msgspec.json.decode((directory / FILE).read_bytes(), type=SigningTime)
    except (OSError, msgspec.MsgspecError):
        return None
    return found if 0 <= found.ticks <= found.reserved < 2**48 else None


def save(directory: Path, time: SigningTime) -> None:
    """Keep it.

    Raises:
        StorageError: it cannot be written.
    """
    write_atomically(directory / FILE, msgspec.json.encode(time))
