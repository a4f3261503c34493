"""Notifications to the service manager by the sd_notify(3) protocol: one datagram of text lines."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Mapping
from typing import Self

logger = logging.getLogger(__name__)


class ServiceManager:
    """Notify the service manager at a path or "@" name, if any; `watchdog_s`: longest time between two WATCHDOG=1."""

    def __init__(self, address: str | None, watchdog_s: float | None = None) -> None:
        self._address = address or ""
        self.watchdog_s = watchdog_s if address is not None else None
        self._socket: socket.socket | None = None
        self._status = ""
        self._warned = False
        if address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            # A manager that does not read must not stop us.
            self._socket.settimeout(0.0)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ, process_id: int | None = None) -> Self:
        """Make the one that NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID name; log a wrong one."""
        address = environment.get("NOTIFY_SOCKET") or None
        if address is not None and address[0] not in "/@":
            logger.warning("NOTIFY_SOCKET: found %r; allowed: a path or @NAME; nobody is told", address)
            address = None
        try:
            watchdog_us = int(environment.get("WATCHDOG_USEC") or 0)
            for_us = int(environment.get("WATCHDOG_PID") or 0) in (0, process_id or os.getpid())
        except ValueError:
            logger.warning("WATCHDOG_USEC or WATCHDOG_PID is not a whole number; the watchdog is not fed")
            return cls(address)
        return cls(address, watchdog_us * 1e-6 if for_us and watchdog_us > 0 else None)

    @property
    def listens(self) -> bool:
        """Return whether a service manager listens."""
        return self._socket is not None

    def status(self, words: str) -> bool:
        """Send the status line, unless it is the last one."""
        line = " ".join(words.split())
        if line == self._status:
            return True
        sent = self.notify(f"STATUS={line}")
        if sent:
            self._status = line
        return sent

    def close(self) -> None:
        """Stop to notify."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def notify(self, line: str) -> bool:
        """Send a line such as READY=1, WATCHDOG=1 or STOPPING=1; return whether it was sent."""
        if self._socket is None:
            return False
        # A name that begins with "@" is in no folder, and begins with a zero to the kernel.
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(line.encode(), address)
        except OSError as error:
            level, why = logging.DEBUG if self._warned else logging.WARNING, error.strerror or error
            logger.log(level, "the service manager cannot be told at %s: %s", self._address, why)
            self._warned = True
            return False
        return True
