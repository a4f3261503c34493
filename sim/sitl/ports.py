"""Ports that are free now: for binaries that must be told a number before they start."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
from collections.abc import Iterable
from pathlib import Path

LOOPBACK = "127.0.0.1"


def free_udp_port() -> int:
    """A UDP port nobody has on the loopback address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def free_tcp_window(size: int) -> int:
    """The first of `size` consecutive TCP ports that are free."""
    for _ in range(50):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.bind((LOOPBACK, 0))
            first = int(probe.getsockname()[1])
        if first + size < 65536 and all(port_free(port, socket.SOCK_STREAM) for port in range(first, first + size)):
            return first
    raise OSError(f"no {size} free TCP ports in a row")


def port_free(port: int, kind: socket.SocketKind) -> bool:
    """Whether one could bind it."""
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:  # as servers do: connections in their last wait do not count
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def ports_free(ports: Iterable[tuple[int, socket.SocketKind]]) -> bool:
    """Whether all of them are."""
    return all(port_free(port, kind) for port, kind in ports)


def unlocked(path: Path) -> bool:
    """Whether no other process holds a record lock (fcntl, not flock) on a file."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDWR)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        finally:
            os.close(descriptor)
    return True
