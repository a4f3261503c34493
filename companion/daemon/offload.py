"""Work that is done where it holds nobody up, the estimate of the rolling window above all.

It costs the loop milliseconds on a desktop and tens of them on a small board; an autopilot that asks whether it may arm
waits with its commander stopped (autopilots 5.2).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Final

from companion.calibration.collector.rolling import RollingCollector, Window

Offload = Callable[..., Awaitable[Any]]
"""Runs a blocking call elsewhere: `asyncio.to_thread` in the daemon."""


TICK_S: Final = 0.2
"""How often the seconds that are over end, also of sources that say nothing."""


async def keep_ticking(collector: RollingCollector) -> None:
    """Tell the collector the time until cancelled: the only one in the daemon who does."""
    while True:
        collector.tick(asyncio.get_running_loop().time())
        await asyncio.sleep(TICK_S)


async def catch_up(collector: RollingCollector, offload: Offload, *, since_s: float | None = None) -> None:
    """Let the collector know what its window holds by now, if that is not known yet."""
    work = collector.pending(asyncio.get_running_loop().time(), since_s=since_s)
    if work is not None:
        collector.accept(work, await offload(work.run))


async def window(collector: RollingCollector, offload: Offload, *, since_s: float | None = None) -> Window:
    """`RollingCollector.window` as of now.

    Raises:
        CalibrationRefusedError: as there.
    """
    await catch_up(collector, offload, since_s=since_s)
    return collector.window(asyncio.get_running_loop().time(), since_s=since_s)
