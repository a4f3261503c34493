"""Ports that lead from the daemon to its devices within this process.

On a loaded machine the kernel delivers what was written to a TCP socket of 127.0.0.1 some time later, and virtual time
does not wait for it. What is written to a Unix socket is there when the write returns, so that a cell is the same every
time. `CampaignLoop.sock_connect` leads here.
"""

from __future__ import annotations

import itertools
import os
import socket
from typing import Any, Final

_FIRST: Final = 20_000
_PORTS: Final = 40_000
_numbers = itertools.count()
_open: set[int] = set()


def new_port() -> int:
    """Return a free port on which nobody listens yet."""
    port = _FIRST + next(_numbers) % _PORTS
    _open.add(port)
    return port


def listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(_name(port))
    listener.listen(100)
    return listener


def leads_here(address: Any) -> bool:
    return isinstance(address, tuple) and len(address) >= 2 and address[1] in _open


def connect(port: int) -> socket.socket:
    """A connected socket.

    Raises:
        ConnectionRefusedError: nobody listens.
    """
    end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        end.connect(_name(port))
    except OSError:
        end.close()
        raise
    return end


def _name(port: int) -> str:
    """Abstract (unix(7)): it is gone with the socket."""
    return f"\0campaign {os.getpid()} {port}"
