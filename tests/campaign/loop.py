"""The event loop of the campaign: virtual time, no threads, and of every task whose it is."""

from __future__ import annotations

import asyncio
import contextvars
import os
import socket
import weakref
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from tests.campaign import loopback
from tests.support.virtual_time import VirtualTimeLoop

T = TypeVar("T")

OWNER: contextvars.ContextVar[str] = contextvars.ContextVar("owner", default="stage")
"""Inherited by every task and callback: which daemon started it, directly or not."""

_owners: weakref.WeakKeyDictionary[asyncio.Task[Any], str] = weakref.WeakKeyDictionary()


class CampaignLoop(VirtualTimeLoop):
    """Virtual time; what would go to a thread is done on the spot, since threads live on the real clock."""

    def __init__(self) -> None:
        super().__init__()
        self.set_task_factory(_owned)

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        future: asyncio.Future[Any] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:  # noqa: BLE001 - handed to whoever awaits it
            future.set_exception(error)
        return future

    async def sock_connect(self, sock: socket.socket, address: Any) -> None:
        """Connect as asyncio does; ports of `loopback` are within this process."""
        if not loopback.leads_here(address):
            await super().sock_connect(sock, address)
            return
        with loopback.connect(address[1]) as end:
            os.dup2(end.fileno(), sock.fileno())
        os.set_blocking(sock.fileno(), False)


def _owned(loop: asyncio.AbstractEventLoop, work: Any, **options: Any) -> asyncio.Task[Any]:
    task: asyncio.Task[Any] = asyncio.Task(work, loop=loop, **options)
    _owners[task] = OWNER.get()
    return task


def tasks_of(owner: str) -> list[asyncio.Task[Any]]:
    return [task for task in asyncio.all_tasks() if _owners.get(task) == owner]


def run_on_campaign_loop(main: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=CampaignLoop) as runner:
        return runner.run(main)
