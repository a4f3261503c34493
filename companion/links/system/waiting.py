"""Waiting for an event, but not for ever."""

from __future__ import annotations

import asyncio


async def comes(event: asyncio.Event, within_s: float) -> bool:
    """Wait until an event is set; False: it was not in time."""
    try:
        async with asyncio.timeout(within_s):
            await event.wait()
    except TimeoutError:
        return False
    return True
