"""The event loop of the campaign: virtual time, no threads, and of every task whose it is."""

from __future__ import annotations

import asyncio
import contextvars
import selectors
import weakref
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from tests.support.virtual_time import MOST_TURNS_A_SECOND

T = TypeVar("T")

OWNER: contextvars.ContextVar[str] = contextvars.ContextVar("owner", default="stage")
"""Inherited by every task and callback: which daemon started it, directly or not."""

_owners: weakref.WeakKeyDictionary[asyncio.Task[Any], str] = weakref.WeakKeyDictionary()


class _JumpingSelector(selectors.EpollSelector):
    """As that of tests.support.virtual_time, for many descriptors: all of them are of this process."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 1000.0
        self._second_began_s = self.now_s
        self._turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._turns += 1
        if self.now_s - self._second_began_s >= 1.0:
            self._second_began_s, self._turns = self.now_s, 0
        elif self._turns > MOST_TURNS_A_SECOND:
            msg = f"livelock: {self._turns} turns of the loop within one second of virtual time"
            raise RuntimeError(msg)
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            msg = "deadlock: every task waits for something that no timer will bring"
            raise RuntimeError(msg)
        self.now_s += max(timeout, 1e-9)
        return ready


class CampaignLoop(asyncio.SelectorEventLoop):
    """Virtual time; what would go to a thread is done on the spot, since threads live on the real clock."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)
        self.set_task_factory(_owned)

    def time(self) -> float:
        return self._jumping.now_s

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Call at once; the future is done."""
        future: asyncio.Future[Any] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 - handed to whoever awaits it
            future.set_exception(error)
        return future


def _owned(loop: asyncio.AbstractEventLoop, work: Any, **options: Any) -> asyncio.Task[Any]:
    task: asyncio.Task[Any] = asyncio.Task(work, loop=loop, **options)
    _owners[task] = OWNER.get()
    return task


def tasks_of(owner: str) -> list[asyncio.Task[Any]]:
    """What of an owner still runs."""
    return [task for task in asyncio.all_tasks() if _owners.get(task) == owner]


def run_on_campaign_loop(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end."""
    with asyncio.Runner(loop_factory=CampaignLoop) as runner:
        return runner.run(main)
