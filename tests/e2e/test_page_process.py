"""The page's real process beside a calibration: it ends well whatever happens to the page, and the page returns."""

from __future__ import annotations

import asyncio
import re
import resource
import socket
from pathlib import Path

import pytest

from companion.daemon.interfaces.child import Child
from companion.estimation.machine import State
from tests.e2e.test_child_processes import beside, calibrated, rig_of
from tests.support.page import parsed

pytestmark = pytest.mark.real_clock

SECTION = '[web]\nbind = "127.0.0.1:0"\n'


def port_of(page: Child) -> int | None:
    """The page's port; None while it is not open."""
    found = re.search(r":(\d+)/$", str(page.status().get("url")))
    return None if found is None else int(found[1])


async def opened(page: Child, before: int | None = None) -> int:
    """The port, once another process than before has opened it."""
    async with asyncio.timeout(60.0):
        while (port := port_of(page)) is None or page.process_id in (None, before):
            await asyncio.sleep(0.02)
    return port


async def answer(port: int) -> int:
    """The status of the answer to somebody who opens the page."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    try:
        async with asyncio.timeout(30.0):
            return parsed(await reader.read()).status
    finally:
        writer.close()


def starved(process_id: int, port: int) -> None:
    """Leave no memory for the next request, and ask for the page."""
    resource.prlimit(process_id, resource.RLIMIT_DATA, (1 << 20, 1 << 20))
    with socket.create_connection(("127.0.0.1", port)) as asking:
        asking.sendall(b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99\r\n\r\n")


async def test_the_page_runs_out_of_memory_and_returns(tmp_path: Path) -> None:
    """tests/e2e/test_child_processes.py has a child that is stopped or killed."""
    rig = rig_of(tmp_path, SECTION)
    async with beside(rig) as page:
        port, struck = await opened(page), page.process_id
        assert struck is not None
        assert await calibrated(rig, State.COLLECTING, lambda: starved(struck, port)) == "done"
        assert await answer(await opened(page, struck)) == 200
