"""Connecting to `tcp://HOST:PORT`: one non-blocking descriptor whose dead peer is noticed within seconds."""

from __future__ import annotations

import asyncio
import os
import socket
from typing import Final

from companion.errors import LinkError

CONNECT_DEADLINE_S: Final = 2.0
"""The kernel asks at once and after a second; a host that has come back is asked again within 2 s of that."""


def words_of(error: OSError) -> str:
    """The system's own words: asyncio puts "Connect call failed" and an address in their place."""
    return os.strerror(error.errno) if error.errno else str(error)


async def connect_tcp(url: str, address: tuple[str, int]) -> int:
    """Connect to the first address of a host that answers; return the socket's descriptor.

    Raises:
        LinkError: one line that names the address and the cause.
    """
    host, port = address
    try:
        async with asyncio.timeout(CONNECT_DEADLINE_S):
            return await connect(host, port)
    except TimeoutError:
        reason = f"{url}: no answer within {CONNECT_DEADLINE_S:g} s"
    except (socket.gaierror, UnicodeError) as error:
        reason = f"{url}: host {host} is not known ({error})"
    except OSError as error:
        reason = f"{url}: {words_of(error)}"
    raise LinkError(reason)


async def connect(host: str, port: int) -> int:
    """Connect to the first address of a host that answers, for as long as the system tries; return the descriptor.

    Raises:
        OSError: none does; of a host that is not known, `socket.gaierror`.
        UnicodeError: the host cannot be a name.
    """
    loop = asyncio.get_running_loop()
    failed = OSError("the host has no address")
    for family, kind, protocol, _, found in await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        try:
            return await _connect(loop, socket.socket(family, kind, protocol), found)
        except OSError as error:
            failed = error
    raise failed


async def _connect(loop: asyncio.AbstractEventLoop, endpoint: socket.socket, address: tuple[object, ...]) -> int:
    try:
        endpoint.settimeout(0)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A peer that vanished without a word (power cut, Wi-Fi gone) is noticed within 5 + 3 * 2 s; and within 10 s
        # while something that we sent is not acknowledged, when no keepalive is sent.
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            ("TCP_KEEPIDLE", 5),
            ("TCP_KEEPINTVL", 2),
            ("TCP_KEEPCNT", 3),
            ("TCP_USER_TIMEOUT", 10000),
        ):
            if hasattr(socket, option):
                endpoint.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        await loop.sock_connect(endpoint, address)
        return endpoint.detach()
    except BaseException:
        endpoint.close()
        raise
