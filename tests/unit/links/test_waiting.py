"""A clean-up waits with a time limit, too."""

from __future__ import annotations

import asyncio

from companion.links.system.events import comes


async def test_a_clean_up_of_a_cancelled_task_waits_no_longer_than_it_says() -> None:
    """Before Python 3.11.4 `asyncio.timeout` raises CancelledError there, and the rest of the clean-up is lost."""
    came: list[bool] = []

    async def work() -> None:
        try:
            await asyncio.sleep(60.0)
        finally:
            came.append(await comes(asyncio.Event(), 1.0))

    task = asyncio.create_task(work())
    await asyncio.sleep(0.0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert came == [False]
