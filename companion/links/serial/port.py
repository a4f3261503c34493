"""Exclusive opening of a serial port, with the cause of a failure in one line.

pyserial opens the port; this module adds TIOCEXCL, parity checking and VMIN = 1, and keeps only the descriptor.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import grp
import os
import pwd
import stat
import termios
import threading
from collections.abc import Callable

from companion.config.sections import Parity
from companion.errors import LinkError
from companion.links.serial.ports import find_holders, in_use
from companion.messages import message

OPEN_DEADLINE_S = 5.0
"""Timeout of opening a port: a healthy USB port needs some milliseconds; a hung driver must not hang the daemon."""

DRIVER_REFUSES = "the driver refuses"


def open_serial(path: str, baud: int, parity: Parity) -> int:
    """Open a port: raw, non-blocking, 8 data bits, one stop bit, no flow control. A slow driver blocks this call."""
    import serial  # costs 10 ms: imported only if there is a serial port

    try:
        port = serial.Serial(path, baud, parity=parity[0].upper(), timeout=0, exclusive=True)
    except (OSError, ValueError, OverflowError, termios.error) as error:
        raise LinkError(explain(path, baud, error)) from None
    try:
        # The lock of exclusive=True stops only programs that check it; TIOCEXCL stops everyone but root.
        fcntl.ioctl(port.fd, termios.TIOCEXCL)
        _finish_settings(port.fd, parity)
        try:
            port.set_low_latency_mode(True)
        except (ValueError, NotImplementedError, OSError):
            pass  # only UARTs and some USB bridges have a low-latency mode; `companion ports` shows an FTDI's timer
        # A duplicate shares the open file and so its lock; pyserial's four pipe ends can then be closed.
        descriptor = os.dup(port.fd)
        os.set_blocking(descriptor, False)
    except (OSError, termios.error) as error:
        raise LinkError(explain(path, baud, error)) from None
    finally:
        port.close()
    return descriptor


def close_serial(descriptor: int) -> None:
    """Unlock and close a port: a pseudo-terminal would keep the exclusive lock while its peer end is open."""
    with contextlib.suppress(OSError):  # gone already, or a socket
        fcntl.ioctl(descriptor, termios.TIOCNXCL)
    os.close(descriptor)


def _finish_settings(descriptor: int, parity: Parity) -> None:
    settings = termios.tcgetattr(descriptor)
    # A byte with a wrong parity or stop bit is then read as NUL, so that a decoder can recognise it.
    settings[0] &= ~(termios.IGNPAR | termios.BRKINT | termios.INPCK)
    if parity != "none":
        settings[0] |= termios.INPCK
    # With pyserial's VMIN = 0 a read without data returns 0 bytes, which also means that the device is gone.
    settings[6][termios.VMIN] = 1
    settings[6][termios.VTIME] = 0
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def explain(path: str, baud: int, error: Exception) -> str:
    number = _errno_of(error)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return message("no_device", port=path)
    if number == errno.EPERM:
        # The file's mode allows it, but systemd's device control knows only the drivers loaded when it started.
        return message("port_access_denied", port=path, why="the service's unit does not allow this kind of port")
    if number == errno.EACCES:
        return message("port_access_denied", port=path, why=_who_may(path))
    if number in (errno.EBUSY, errno.EAGAIN):
        return in_use(path, find_holders(path))
    if number == errno.EIO:
        return message("device_gone", port=path)
    reason: object = error
    if not _is_character_device(path):
        reason = "not a serial port"
    elif isinstance(error, ValueError | OverflowError) or number == errno.EINVAL:
        reason = f"{DRIVER_REFUSES} {baud} baud"
    return message("port_cannot_be_opened", port=path, reason=reason)


def _errno_of(error: Exception) -> int | None:
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return number
    first = error.args[0] if error.args else None
    return first if isinstance(first, int) else None  # termios.error is not an OSError, but has the same arguments


def _who_may(path: str) -> str:
    user = _name_of(pwd.getpwuid, os.geteuid())
    try:
        status = os.stat(path)
    except OSError:
        return f"user {user} may not open the folder"
    group = _name_of(grp.getgrgid, status.st_gid)
    mode = stat.S_IMODE(status.st_mode)
    if mode & stat.S_IRGRP and mode & stat.S_IWGRP and status.st_gid != 0:
        return f"user {user} is not in group {group} (usermod -aG {group} {user}, then log in again)"
    owner = _name_of(pwd.getpwuid, status.st_uid)
    return f"user {user} may not read and write it (owner {owner}:{group}, mode {mode:04o})"


def _name_of(look_up: Callable[[int], pwd.struct_passwd | grp.struct_group], number: int) -> str:
    try:
        return str(look_up(number)[0])
    except KeyError:
        return str(number)


def _is_character_device(path: str) -> bool:
    try:
        return stat.S_ISCHR(os.stat(path).st_mode)
    except OSError:
        return True


class SerialOpener:
    """Opens one port without blocking the event loop or the exit of the process.

    A hung driver may block for ever, so each attempt runs in a daemon thread. asyncio would wait for its own threads.
    """

    def __init__(self, path: str, baud: int, parity: Parity) -> None:
        self._path, self._baud, self._parity = path, baud, parity
        self._thread: threading.Thread | None = None

    async def open(self) -> int:
        """Open the port and return its descriptor; raise LinkError that names the port and the cause."""
        if self._thread is not None and self._thread.is_alive():
            raise LinkError(message("port_cannot_be_opened", port=self._path, reason="the driver hangs"))
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[int] = loop.create_future()
        self._thread = threading.Thread(
            target=self._attempt, args=(loop, opened), name=f"open {self._path}", daemon=True
        )
        self._thread.start()
        descriptor: int | None = None
        try:
            async with asyncio.timeout(OPEN_DEADLINE_S):
                descriptor = await opened
        except TimeoutError:
            reason = f"no answer of the driver within {OPEN_DEADLINE_S:g} s"
            raise LinkError(message("port_cannot_be_opened", port=self._path, reason=reason)) from None
        finally:
            # Cancelled after the thread's result and before our turn: nobody else would close the descriptor.
            if descriptor is None and opened.done() and not opened.cancelled() and opened.exception() is None:
                close_serial(opened.result())
        return descriptor

    def _attempt(self, loop: asyncio.AbstractEventLoop, opened: asyncio.Future[int]) -> None:
        found: int | LinkError
        try:
            found = open_serial(self._path, self._baud, self._parity)
        except LinkError as error:
            found = error
        except Exception as error:  # noqa: BLE001 - otherwise the thread dies silently and its caller waits for ever
            found = LinkError(message("port_cannot_be_opened", port=self._path, reason=repr(error)))

        def hand_over() -> None:
            if isinstance(found, LinkError):
                if not opened.done():
                    opened.set_exception(found)
            elif opened.done():
                close_serial(found)
            else:
                opened.set_result(found)

        try:
            loop.call_soon_threadsafe(hand_over)
        except RuntimeError:  # the loop has been closed meanwhile
            if isinstance(found, int):
                close_serial(found)
