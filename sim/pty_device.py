"""A serial device on a pseudo-terminal: a path that can be opened, read, unplugged and plugged in again.

`heard` models a receiver that reads a line at another speed or parity than it was sent. The line idles high. A frame is
a low start bit, eight data bits with the least significant first, a parity bit if any, and a high stop bit. The
receiver samples each bit in its middle, as a UART does, from the falling edge that begins a frame.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import math
import os
import select
import termios
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Self

from sim.devices import SerialDevice

Parity = Literal["none", "even", "odd"]
DATA_BITS = 8


class Received(NamedTuple):
    """One frame as the receiver has read it."""

    byte: int
    framing_error: bool
    """True: the bit in the place of the stop bit was low."""
    parity_error: bool


@dataclass(frozen=True)
class Setting:
    """Setting of one end of the line: 8 data bits and one stop bit always."""

    baud: int
    parity: Parity = "none"


def parity_bit(byte: int, parity: Parity) -> int:
    ones = byte.bit_count() % 2
    return ones if parity == "even" else 1 - ones


def transmit(data: bytes, setting: Setting, gap_bits: int = 0) -> list[int]:
    """Return the levels of the line, one per bit, with `gap_bits` of idle line between bytes."""
    levels = [1]
    for byte in data:
        levels += [0, *(byte >> bit & 1 for bit in range(DATA_BITS))]
        if setting.parity != "none":
            levels.append(parity_bit(byte, setting.parity))
        levels += [1] * (1 + gap_bits)
    return levels


def receive(levels: list[int], sent_baud: int, setting: Setting) -> Iterator[Received]:
    """Yield the frames that a receiver finds in the levels of a line.

    A low stop bit counts as the start bit of the next frame, as in the 16550 and its many descendants (NS16550 data
    sheet, line status register, framing error). After a break (all bits low), the receiver waits for an edge.
    """
    step = sent_baud / setting.baud  # bits of the line for one of the receiver's
    stop = DATA_BITS + (1 if setting.parity == "none" else 2)
    now, begun = 0.0, None
    while True:
        first = max(math.ceil(now - 1e-9), 1)
        falls = (at for at in range(first, len(levels)) if levels[at - 1] and not levels[at])
        start = begun if begun is not None else next(falls, None)
        begun = None
        if start is None:
            return

        def level(bit: int, start: float = start) -> int:
            at = int(start + (bit + 0.5) * step + 1e-9)
            return levels[at] if at < len(levels) else 1

        if level(0) == 1:  # shorter than half a bit: noise, not a start
            now = start + 0.5 * step
            continue
        byte = sum(level(1 + bit) << bit for bit in range(DATA_BITS))
        parity_error = setting.parity != "none" and level(1 + DATA_BITS) != parity_bit(byte, setting.parity)
        framing_error = level(stop) == 0
        yield Received(byte, framing_error, parity_error)
        if framing_error and byte:
            begun = start + stop * step
        # The middle of the stop bit is where a receiver begins to look for the next edge.
        now = start + (stop + 0.5) * step


def heard(data: bytes, sent: Setting, read: Setting, gap_bits: int = 0) -> bytes:
    """Return what a program on Linux reads: with parity checking, a byte with wrong parity or stop bit becomes NUL."""
    if sent == read:
        return data
    return bytes(
        0 if read.parity != "none" and (frame.framing_error or frame.parity_error) else frame.byte
        for frame in receive(transmit(data, sent, gap_bits), sent.baud, read)
    )


_SHORTEST_SLEEP_S = 0.001


class PtyDevice:
    """Serves a device's frames on the event loop, in its clock's time, under a symlink with a stable name.

    Like a UART, the device does not wait for the reader: unread bytes are lost, and a slow reader loses bytes in the
    middle of frames. Only the path is shared with the reader, so it works with any program.

    Use: `async with PtyDevice(HMR3300(aircraft), directory / "compass") as device: ...`
    """

    def __init__(self, device: SerialDevice, path: Path, *, line: Setting | None = None) -> None:
        self.device, self.path, self.line = device, path, line
        """`line`: setting of the device's UART; a reader at another speed or parity reads what a UART makes of it.

        None: bytes pass unchanged, whatever the reader's setting.
        """
        self.muted = False
        """True: the device is connected but sends nothing."""
        self._master: int | None = None
        self._poll = select.poll()
        self._banner = b""
        self._serving: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self.replug()
        self._serving = asyncio.create_task(self._serve(), name=f"sim device {self.path.name}")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._serving is not None:
            self._serving.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._serving
            self._serving = None
        self.unplug()

    async def wait_closed(self) -> None:
        """Wait until serving ends, which only a fault of the simulator causes."""
        if self._serving is not None:
            await asyncio.shield(self._serving)

    @property
    def opened(self) -> bool:
        return self._master is not None and not any(event & select.POLLHUP for _, event in self._poll.poll(0))

    def unplug(self) -> None:
        """Unplug the device: the path disappears, and a reader gets a hang-up."""
        if self._master is None:
            return
        self._close()
        self.path.unlink(missing_ok=True)

    def replug(self) -> None:
        """Plug the device in: a new pseudo-terminal under the same path; the device starts again."""
        if self._master is not None:
            return
        if self.path.exists() and not self.path.is_symlink():
            raise FileExistsError(f"{self.path}: exists and is no symlink; give a folder of its own")
        self._open()
        self._banner = self.device.power_on(self._now_s())

    def _close(self) -> None:
        assert self._master is not None
        self._poll.unregister(self._master)
        os.close(self._master)
        self._master = None

    def _open(self) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        fcntl.fcntl(master, fcntl.F_SETFD, fcntl.FD_CLOEXEC)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        staged = self.path.with_name(f".{self.path.name}.new")
        staged.unlink(missing_ok=True)
        staged.symlink_to(os.ttyname(slave))
        staged.replace(self.path)
        os.close(slave)  # from here on the kernel tells by POLLHUP whether anybody has it open
        self._master = master
        self._poll.register(master, select.POLLHUP)

    def _unlock(self) -> None:
        """Free the port after a reader that was killed, as a serial port is when its last reader ends.

        The lock of such a reader (TIOCEXCL) stays on a pseudo-terminal as long as its other end is open.
        """
        try:
            slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        except OSError as error:
            if error.errno != errno.EBUSY:
                raise
            # Only root may open it to take the lock away; nobody else can have it open either.
            self._close()
            self._open()
        else:
            fcntl.ioctl(slave, termios.TIOCNXCL)
            os.close(slave)

    def _now_s(self) -> float:
        return self.device.aircraft.time_at(asyncio.get_running_loop().time())

    async def _serve(self) -> None:
        was_opened = False
        while True:
            now_s = self._now_s()
            if self._master is None:
                was_opened = False
                await asyncio.sleep(0.05)
                continue
            if was_opened and not self.opened:
                self._unlock()
            was_opened = self.opened
            if self._banner and self.opened:  # as behind an adapter that powers its device when it is opened
                self._write(self._banner)
                self._banner = b""
            self._take_commands(now_s)
            for frame in self.device.frames_until(now_s):
                wait_s = frame.complete_s - self._now_s()
                if wait_s > 0.0:
                    await asyncio.sleep(wait_s)
                self._write(frame.data)
            wait_s = self.device.next_sample_s - self._now_s()
            await asyncio.sleep(min(max(wait_s, _SHORTEST_SLEEP_S), 0.1))

    def _write(self, data: bytes) -> None:
        """Write into the port, or drop the bytes: never waits, never raises."""
        if not data:
            return
        if self._master is None or self.muted or not self.opened:
            return
        if self.line is not None:
            data = heard(data, self.line, reader_setting(self._master))
        try:
            os.write(self._master, data)
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):
                raise

    def _take_commands(self, now_s: float) -> None:
        assert self._master is not None
        try:
            data = os.read(self._master, 4096)
        except OSError:  # nothing to read, or nobody there
            return
        if data:
            self._write(self.device.command(data, now_s))


def reader_setting(master: int) -> Setting:
    """Return the reader's setting of a pseudo-terminal.

    A pseudo-terminal forgets PARENB, but not whether parity is to be checked, nor which.
    """
    flags_in, _, flags, *_ = termios.tcgetattr(master)
    parity: Parity = "none"
    if flags_in & termios.INPCK:
        parity = "odd" if flags & termios.PARODD else "even"
    speed = termios.tcgetattr(master)[5]
    return Setting(_BAUDS.get(speed, 9600), parity)


_BAUDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdecimal()}
