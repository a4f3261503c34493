"""Waiting for an event with a time limit."""

from __future__ import annotations

import asyncio


async def comes(event: asyncio.Event, within_s: float) -> bool:
    """Wait until an event is set; False: it was not in time."""
    if event.is_set():
        return True
    # Not asyncio.timeout, which cannot expire in a cancelled task before Python 3.11.4: clean-ups wait here too.
    waiting = asyncio.ensure_future(event.wait())
    try:
        return bool((await asyncio.wait([waiting], timeout=within_s))[0])
    finally:
        waiting.cancel()
