"""Control socket, for the command line and the child processes.

A Unix stream socket for the daemon's user (mode 0600) or a group (0660). Each connection carries one request. Each line
is a JSON object: progress lines, then one of kind "result" or "error". A job goes on when its client disconnects.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import grp
import logging
import os
import socket
import stat
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final, Self

from companion.commands import ALL
from companion.errors import CompanionError, LinkError, RequestRefusedError
from companion.formats import Object, parse_request
from companion.links.system.connection import READ_TIMEOUT_S, write_line
from companion.messages import message

logger = logging.getLogger(__name__)

Handler = Callable[[Object], AsyncIterator[Object]]

REQUEST_LIMIT: Final = 64 * 1024
REQUEST_TIMEOUT_S: Final = 5.0
KERNEL_BYTES: Final = 16 * 1024
MAX_CLIENTS: Final = 16
"""Maximum number of connections in each of three classes: no request yet, urgent commands, other commands."""
URGENT: Final = tuple(name for name, command in ALL.items() if command.urgent)


class ControlServer:
    """Server of the control socket; use it with `async with`."""

    def __init__(self, path: Path, handler: Handler, *, group: str | None = None) -> None:
        self._path, self._group = path, group
        self._handler = handler
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._silent: dict[asyncio.Task[None], None] = {}
        self._served: Counter[bool] = Counter()

    async def __aenter__(self) -> Self:
        """Bind the socket, replacing a stale one; raise LinkError on failure, or if another daemon answers on it."""
        listener = _bind(self._path)
        if self._group is not None:
            _open_to(self._path, self._group)
        self._server = await asyncio.start_unix_server(
            self._accept, sock=listener, limit=REQUEST_LIMIT, backlog=MAX_CLIENTS
        )
        # asyncio accepts up to `backlog` clients before it closes an evicted one; the kernel may queue more.
        listener.listen()
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._server is not None:
            self._server.close()
        for client in list(self._clients):
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._silent) >= MAX_CLIENTS:
            # Our own clients send their request at once, so the oldest silent client is closed.
            oldest = next(iter(self._silent))
            oldest.cancel()
            del self._silent[oldest]
        # With small buffers, a client that does not read is noticed soon.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
        writer.transport.set_write_buffer_limits(0)
        client = asyncio.get_running_loop().create_task(self._serve(reader, writer), name="control client")
        self._clients.add(client)
        self._silent[client] = None
        client.add_done_callback(self._forget)
        # A `finally` in the task will not do: a task cancelled before its first step never reaches it.
        client.add_done_callback(lambda _: writer.transport.abort())

    def _forget(self, client: asyncio.Task[None]) -> None:
        self._clients.discard(client)
        self._silent.pop(client, None)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, TimeoutError):  # the client went away; its job goes on
            try:
                async with asyncio.timeout(REQUEST_TIMEOUT_S):
                    request = parse_request(await reader.readline())
            except ValueError as error:
                await write_line(writer, {"kind": "error", "reason": message("request_not_understood", reason=error)})
                await _finish(writer)
                return
            await self._take(request, writer)

    async def _take(self, request: Object, writer: asyncio.StreamWriter) -> None:
        if (client := asyncio.current_task()) is not None:
            self._silent.pop(client, None)
        urgent = request.get("command") in URGENT
        if self._served[urgent] >= MAX_CLIENTS:
            await write_line(writer, {"kind": "error", "reason": message("too_many_at_once", what="clients")})
            await _finish(writer)
            return
        self._served[urgent] += 1
        try:
            await self._answer(request, writer)
            await _finish(writer)
        finally:
            self._served[urgent] -= 1

    async def _answer(self, request: Object, writer: asyncio.StreamWriter) -> None:
        try:
            async for reply in self._handler(request):
                await write_line(writer, reply)
        except RequestRefusedError as error:
            await write_line(writer, {"kind": "error", "reason": str(error), "refusal": error.kind})
        except CompanionError as error:
            await write_line(writer, {"kind": "error", "reason": str(error)})
        except ConnectionError:
            raise
        except Exception:
            logger.exception("control request %r failed", request.get("command"))
            await write_line(writer, {"kind": "error", "reason": message("daemon_internal_error")})


async def _finish(writer: asyncio.StreamWriter) -> None:
    writer.close()
    async with asyncio.timeout(READ_TIMEOUT_S):
        await writer.wait_closed()


def _bind(path: Path) -> socket.socket:
    try:
        path.parent.mkdir(exist_ok=True)
        _remove_stale(path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # `bind` creates the file with the umask's mode, so that is right before anyone can connect.
        old_mask = os.umask(0o177)
        try:
            listener.bind(str(path))
        except BaseException:
            listener.close()
            raise
        finally:
            os.umask(old_mask)
    except OSError as error:
        reason = error.strerror or error
        raise LinkError(message("path_not_usable", path=f"control socket {path}", reason=reason)) from error
    return listener


def _open_to(path: Path, group: str) -> None:
    try:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
        path.chmod(0o660)
    except (KeyError, OSError) as error:
        why = "no such group" if isinstance(error, KeyError) else error.strerror or str(error)
        logger.warning("%s", message("path_not_usable", path=f"control socket {path}", reason=f"group {group}: {why}"))


def _remove_stale(path: Path) -> None:
    """Remove the socket of a daemon that has ended; raise OSError if it belongs to a running one or is no socket."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise OSError(errno.EEXIST, "a file that is not a socket is in the way; remove it")
    probe = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        probe.connect(str(path))
    except ConnectionRefusedError:
        path.unlink()
    else:
        raise OSError(errno.EADDRINUSE, "another companion is running (see: companion status)")
    finally:
        probe.close()


def process_behind(path: Path) -> set[int]:
    """Return the id of the process that listens on a control socket; empty: no process, or no access to it."""
    try:
        with socket.socket(socket.AF_UNIX) as asking:
            asking.settimeout(1.0)
            asking.connect(str(path))
            credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    except OSError:
        return set()
    return {struct.unpack("3i", credentials)[0]}
