"""A serial line between two programs, as fast as its baud rate and no faster."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import AsyncIterator
from pathlib import Path

_TICK_S = 0.005
_BITS = 10.0


@contextlib.asynccontextmanager
async def serial_line(baud: int, folder: Path) -> AsyncIterator[tuple[Path, Path]]:
    """Two ports in a folder, which exists: what is written to one can be read from the other.

    What the line has not carried waits in the writer's driver (4 kB), and then the writer waits.
    """
    ends = [os.openpty() for _ in range(2)]
    ports = (folder / "line-a", folder / "line-b")
    for (master, slave), port in zip(ends, ports, strict=True):
        tty.setraw(slave)
        os.set_blocking(master, False)
        port.symlink_to(os.ttyname(slave))
    (one, _), (other, _) = ends
    carrying = [asyncio.create_task(_carry(baud, *way), name="serial line") for way in ((one, other), (other, one))]
    try:
        yield ports
    finally:
        for task in carrying:
            task.cancel()
        await asyncio.gather(*carrying, return_exceptions=True)
        for port in ports:
            port.unlink()
        for descriptor in (each for end in ends for each in end):
            os.close(descriptor)


async def _carry(baud: int, source: int, target: int) -> None:
    loop = asyncio.get_running_loop()
    at_s = loop.time()
    while True:
        await asyncio.sleep(_TICK_S)
        room = int((loop.time() - at_s) * baud / _BITS)
        try:
            data = os.read(source, max(room, 1))
        except BlockingIOError:
            at_s = loop.time()  # an idle line saves nothing up
            continue
        at_s += len(data) * _BITS / baud
        with contextlib.suppress(BlockingIOError):  # nobody reads: lost
            os.write(target, data)
