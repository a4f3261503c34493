"""Automatic reconnection, TCP, requests to the daemon's control socket, and limits on incoming bytes.

The server of the control socket is `daemon/interfaces/control.py`; its clients are the command line and the daemon's
own child processes.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import grp
import logging
import math
import os
import socket
import stat
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from companion.errors import DaemonDeniedError, DaemonUnreachableError, LinkError
from companion.formats import Object
from companion.messages import message

logger = logging.getLogger(__name__)

OnState = Callable[[bool, str], object]


class Reconnection:
    """Retry loop of one connection: reopens it after every loss and logs one warning per outage.

    The pause before a retry doubles from `first_s` to `cap_s`. It restarts at `first_s` after a connection that lasted
    `worth_s` or after `reset`. There is no jitter: each server has few clients.
    """

    def __init__(
        self, name: str, *, worth_s: float, first_s: float = 0.2, cap_s: float = 2.0, on_state: OnState | None = None
    ) -> None:
        self.last_error = ""
        self.retry_s: float | None = None
        self._name, self._worth_s, self._on_state = name, worth_s, on_state
        self._first_s, self._cap_s = first_s, cap_s
        self._pause_s = first_s
        self._warned = False
        self._up_s = math.inf
        self._notified: tuple[bool, str] | None = None

    async def keep(self, once: Callable[[], Awaitable[str]]) -> NoReturn:
        """Run `once` repeatedly. `once` calls `up`, then returns the reason of its end or raises LinkError."""
        loop = asyncio.get_running_loop()
        while True:
            self._up_s = math.inf
            try:
                reason = await once()
            except LinkError as error:
                reason = str(error)
            if loop.time() - self._up_s >= self._worth_s:
                self.reset()
            self.down(reason)
            delay_s, self._pause_s = self._pause_s, min(self._pause_s * 2.0, self._cap_s)
            self.retry_s = loop.time() + delay_s
            await asyncio.sleep(delay_s)
            self.retry_s = None

    def reset(self) -> None:
        self._pause_s = self._first_s

    def up(self, words: str) -> None:
        logger.info("%s: %s%s", self._name, words, " again" if self._warned else "")
        self._up_s = asyncio.get_running_loop().time()
        self._warned = False
        self._notify(words, connected=True)

    def down(self, reason: str) -> None:
        self.last_error = reason
        logger.log(logging.DEBUG if self._warned else logging.WARNING, "%s: %s", self._name, reason)
        self._warned = True
        self._notify(reason, connected=False)

    def end(self) -> None:
        self._notify("stopped", connected=False)

    def _notify(self, words: str, *, connected: bool) -> None:
        if self._on_state is not None and (connected, words) != self._notified:
            self._notified = (connected, words)
            self._on_state(connected, words)


CONNECT_DEADLINE_S: Final = 2.0


def words_of(error: OSError) -> str:
    # asyncio's own text is only "Connect call failed" and an address.
    return os.strerror(error.errno) if error.errno else str(error)


async def connect_tcp(url: str, address: tuple[str, int]) -> int:
    """Connect to the first address of a host that answers; return the descriptor or raise LinkError with the cause."""
    host, port = address
    loop = asyncio.get_running_loop()
    reason = "the host has no address"
    try:
        async with asyncio.timeout(CONNECT_DEADLINE_S):
            for family, kind, protocol, _, found in await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM):
                try:
                    return await _connect(loop, socket.socket(family, kind, protocol), found)
                except OSError as error:
                    reason = words_of(error)
    except TimeoutError:
        reason = f"no answer within {CONNECT_DEADLINE_S:g} s"
    except (socket.gaierror, UnicodeError) as error:
        reason = f"unknown host {host} ({error})"
    except OSError as error:
        reason = words_of(error)
    raise LinkError(message("no_connection", url=url, reason=reason))


async def _connect(loop: asyncio.AbstractEventLoop, endpoint: socket.socket, address: tuple[object, ...]) -> int:
    try:
        endpoint.settimeout(0)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # Detect a peer that vanished (power cut, Wi-Fi gone) within 5 + 3 * 2 s. While sent data is unacknowledged no
        # keepalive is sent; then the user timeout of 10 s applies.
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 10_000)
        await loop.sock_connect(endpoint, address)
        return endpoint.detach()
    except BaseException:
        endpoint.close()
        raise


BYTES_PER_S: Final = 262144.0
"""Limit of incoming bytes a second (2.6 Mbaud): an IMU with 1000 frames of 200 bytes a second, plus a margin."""
BURST_BYTES: Final = 65536.0


class Budget:
    """Token bucket that limits bytes: it fills at a constant rate, and every read withdraws its size."""

    def __init__(self, bytes_per_s: float = BYTES_PER_S, burst_bytes: float = BURST_BYTES) -> None:
        self._bytes_per_s, self._burst_bytes = bytes_per_s, burst_bytes
        self._left, self._t_s = burst_bytes, 0.0
        self.exceeded_s: float | None = None

    def left(self, now_s: float) -> float:
        gained = max(now_s - self._t_s, 0.0) * self._bytes_per_s
        return min(self._left + gained, self._burst_bytes)

    def spend(self, count: int, now_s: float) -> bool:
        """Withdraw `count` bytes; if the bucket holds fewer, empty it and return False."""
        self._left, self._t_s = self.left(now_s) - count, now_s
        if self._left >= 0.0:
            return True
        self._left, self.exceeded_s = 0.0, now_s
        return False


LINE_LIMIT: Final = 32 * 1024 * 1024
READ_TIMEOUT_S: Final = 10.0


async def ask(path: Path, request: Object) -> AsyncGenerator[Object, None]:
    """Send one request to the daemon and yield its replies; raise DaemonUnreachableError if not all arrive."""
    try:
        reader, writer = await asyncio.open_unix_connection(str(path), limit=LINE_LIMIT)
    except OSError as error:
        why = {errno.ENOENT: "no such socket", errno.ECONNREFUSED: "no program listens there"}.get(
            error.errno or 0, str(error)
        )
        if error.errno == errno.EACCES:
            raise DaemonDeniedError(message("control_socket_denied", path=path, who=_who_may(path))) from None
        raise DaemonUnreachableError(message("companion_not_running", path=path, why=why)) from None
    try:
        await write_line(writer, request)
        while line := await reader.readline():
            reply: Object = msgspec.json.decode(line)
            yield reply
            if reply.get("kind") in ("result", "error"):
                return
        raise ConnectionResetError
    except ConnectionError:
        raise DaemonUnreachableError(
            message("companion_not_running", path=path, why="ended its answer early")
        ) from None
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def write_line(writer: asyncio.StreamWriter, reply: Object) -> None:
    """Send one JSON object; raise ConnectionError if the peer is gone or does not read it in time."""
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
    return "permission denied, use sudo"
