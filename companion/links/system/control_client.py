"""Client side of the control socket: one request a connection, one JSON object a line.

The server is `daemon/interfaces/control.py`. The command line and the daemon's own child processes are its clients.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import grp
import stat
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Final

import msgspec

from companion.errors import DaemonDeniedError, DaemonUnreachableError
from companion.formats import Object

LINE_LIMIT: Final = 32 * 1024 * 1024
READ_TIMEOUT_S: Final = 10.0


async def ask(path: Path, request: Object) -> AsyncGenerator[Object, None]:
    """Send one request and yield the replies; raise DaemonUnreachableError where no daemon answers to the end."""
    try:
        reader, writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
    except OSError as error:
        why = {errno.ENOENT: "no such socket", errno.ECONNREFUSED: "nobody listens there"}.get(
            error.errno or 0, str(error)
        )
        if error.errno == errno.EACCES:
            raise DaemonDeniedError(f"the daemon at {path} may not be asked: {_who_may(path)}") from None
        raise DaemonUnreachableError(f"no daemon answers at {path} ({why})") from None
    try:
        await write_line(writer, request)
        while line := await reader.readline():
            reply: Object = msgspec.json.decode(line)
            yield reply
            if reply.get("kind") in ("result", "error"):
                return
        raise DaemonUnreachableError(f"the daemon at {path} went away in the middle of the answer")
    except ConnectionError:
        raise DaemonUnreachableError(f"the daemon at {path} went away in the middle of the answer") from None
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def write_line(writer: asyncio.StreamWriter, reply: Object) -> None:
    """Send one JSON object; raise ConnectionError where the peer is gone or does not read."""
    writer.write(msgspec.json.encode(reply) + b"\n")
    try:
        async with asyncio.timeout(READ_TIMEOUT_S):
            await writer.drain()
    except TimeoutError:
        raise ConnectionAbortedError from None


def _who_may(path: Path) -> str:
    try:
        found = path.stat()
        if found.st_mode & stat.S_IWGRP:
            return f"only group {grp.getgrgid(found.st_gid).gr_name} and root may: usermod -aG, log in again; or sudo"
    except (OSError, KeyError):
        pass
    return "permission denied, try with sudo"
