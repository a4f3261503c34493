"""How far the time in our signatures has come, kept over a restart and a power cut."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from companion.storage.state import StateFile

FILE: Final = "mavlink-signing-time.json"
MOST_UPTIME_S: Final = 3.2e9
"""A century."""
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


def kept_in(directory: Path) -> StateFile[SigningTime]:
    """What is kept in a storage directory."""
    return StateFile(directory / FILE, SigningTime, _check)


def _check(found: SigningTime) -> None:
    if not 0 <= found.ticks <= found.reserved < 2**48 or not 0.0 <= found.uptime_s < MOST_UPTIME_S:
        raise msgspec.ValidationError(f"ticks {found.ticks} to {found.reserved} at {found.uptime_s:g} s cannot be")
