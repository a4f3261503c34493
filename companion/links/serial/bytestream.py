"""Byte link over a serial port or `tcp://` that reopens by itself: one non-blocking descriptor on the event loop."""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

from companion.config.sections import Parity
from companion.errors import LinkError
from companion.links.serial.port import SerialOpener, close_serial
from companion.links.system.connection import Budget, OnState, Reconnection, connect_tcp, words_of
from companion.messages import message

READ_BYTES = 4096  # size of a tty's buffer: one read empties the port, so one time stamp is right for all its bytes
QUICK_READS = 20
QUICK_S = 0.0015  # mean interval of `QUICK_READS` reads; quicker reads are collected, as each byte would wake the loop
COLLECT_S = 0.0205
"""Pause before the next read of a port with many small reads: a wake-up costs far more than its bytes. Slightly above
the 20 ms within which an autopilot accepts only one heading (docs/reference/autopilots 6)."""
FULLEST_LINE = 0.9  # largest load of the line, as a share of its capacity, at which reads are collected
OUT_BUFFER_BYTES = 16384
LONGEST_PAUSE_S = 1.0
BEAT_S = 1.0
BEAT_WITHIN_S = 8.0
FLOOD_PAUSE_S = 0.05
MOST_READS = 64  # most reads of a port before a write; the kernel buffers fewer bytes than these can return
DISCARD_BYTES = 65536
DISCARD_READS = 16
WORTH_S = 2.0


@dataclass(frozen=True, slots=True)
class PortSettings:
    """Serial port or `tcp://HOST:PORT`, with baud rate and parity, which are ignored for tcp."""

    url: str
    baud: int
    parity: Parity = "none"

    @property
    def is_tcp(self) -> bool:
        return self.url.startswith("tcp://")

    def __str__(self) -> str:
        return self.url if self.is_tcp else f"{self.url} at {self.baud} baud, parity {self.parity}"

    @property
    def seconds_per_byte(self) -> float:
        """Line time of one byte: start bit, 8 data bits, parity bit if any, stop bit. 0 for tcp:// means unknown."""
        if self.is_tcp:
            return 0.0
        return (10 if self.parity == "none" else 11) / self.baud

    def address(self) -> tuple[str, int]:
        """Return host and port of a tcp:// url; raise LinkError if host or port is missing or wrong."""
        try:
            parts = urlsplit(self.url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        if not host or not port:
            raise LinkError(f"{self.url}: not an address; allowed: tcp://HOST:PORT with PORT from 1 to 65535")
        return host, port


class ByteLink:
    """Link that passes the bytes of one port to `on_bytes(data, t_s)` while `run` runs; reopens after every loss.

    `on_state(connected, reason)` reports every change of state. `on_gap` reports that bytes were discarded. Callbacks
    must neither block nor raise.
    """

    def __init__(
        self,
        settings: PortSettings,
        on_bytes: Callable[[bytes, float], None],
        *,
        name: str,
        on_state: OnState | None = None,
        budget: Budget | None = None,
        on_turn: Callable[[], None] = lambda: None,
        on_gap: Callable[[], None] = lambda: None,
    ) -> None:
        self.settings = settings
        self.name = name
        self.budget = budget
        self.bytes_received = 0
        self.reconnects = 0
        self.turns = 0
        self._on_bytes, self._on_turn, self._on_gap = on_bytes, on_turn, on_gap
        self._reconnection = Reconnection(name, worth_s=WORTH_S, cap_s=LONGEST_PAUSE_S, on_state=on_state)
        self._descriptor: int | None = None
        self._reads = 0  # reads with data since `_reads_since`, which is a time and the bytes received by then
        self._reads_since = (0.0, 0)
        self._collecting: asyncio.TimerHandle | None = None
        self._lost: asyncio.Future[str] | None = None
        self._out = bytearray()
        self._opener = SerialOpener(settings.url, settings.baud, settings.parity)
        self._paused: asyncio.TimerHandle | None = None
        self._opened_before = False

    @property
    def connected(self) -> bool:
        return self._descriptor is not None

    @property
    def last_error(self) -> str:
        return self._reconnection.last_error

    async def run(self) -> None:
        try:
            await self._reconnection.keep(self._once)
        finally:
            if self._descriptor is not None:
                self._close()
                self._reconnection.end()

    async def _once(self) -> str:
        self._turn()
        descriptor = await self._open()
        before = self.bytes_received
        lost: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._lost = lost
        self._attach(asyncio.get_running_loop(), descriptor)
        while not lost.done():
            self._turn()
            await asyncio.wait([lost], timeout=BEAT_S)
        if self.bytes_received > before:
            self._reconnection.reset()
        return lost.result()

    def write(self, data: bytes) -> bool:
        """Send `data` or queue it in the bounded buffer; return False, without sending any of it, if closed or full."""
        if self._descriptor is None or len(self._out) + len(data) > OUT_BUFFER_BYTES:
            return False
        waiting = bool(self._out)
        self._out += data
        if not waiting:
            self._flush()
        return self._descriptor is not None

    def settled(self) -> bool:
        """Pass on all received bytes. Return False if more keep coming, output is waiting, or the link is closed."""
        now_s = asyncio.get_running_loop().time()
        emptied = any(not self._read(now_s) for _ in range(MOST_READS))
        return emptied and self._descriptor is not None and not self._out

    def _turn(self) -> None:
        self.turns += 1
        self._on_turn()

    async def _open(self) -> int:
        if self.settings.is_tcp:
            return await connect_tcp(self.settings.url, self.settings.address())
        return await self._opener.open()

    def _attach(self, loop: asyncio.AbstractEventLoop, descriptor: int) -> None:
        self._descriptor = descriptor
        if self._opened_before:
            self.reconnects += 1
        self._opened_before = True
        self._reads, self._reads_since = 0, (loop.time(), self.bytes_received)
        loop.add_reader(descriptor, self._readable)
        self._reconnection.up(f"{self.settings.url} is open")

    def _readable(self) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if not self._read(now_s) or self._descriptor is None or self._paused is not None:
            return
        self._reads += 1
        if self._reads == QUICK_READS:
            if now_s - self._reads_since[0] < QUICK_READS * QUICK_S and self._fits_the_line(now_s):
                loop.remove_reader(self._descriptor)
                self._collecting = loop.call_at(now_s + COLLECT_S, self._collected)
            self._reads, self._reads_since = 0, (now_s, self.bytes_received)

    def _collected(self) -> None:
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        # Schedule the next turn first, so that it comes whatever happens in this one.
        self._collecting = loop.call_at(now_s + COLLECT_S, self._collected)
        goes_on = self._read(now_s) and self._fits_the_line(now_s)
        if self._descriptor is None or self._paused is not None:
            return
        self._reads, self._reads_since = 0, (now_s, self.bytes_received)
        if not goes_on:
            self._stop_collecting()
            loop.add_reader(self._descriptor, self._readable)

    def _stop_collecting(self) -> None:
        if self._collecting is not None:
            self._collecting.cancel()
            self._collecting = None

    def _fits_the_line(self, now_s: float) -> bool:
        """Check that the bytes since `_reads_since` came no faster than the line can carry; over USB they may."""
        since_s, bytes_then = self._reads_since
        carried = self.bytes_received - bytes_then
        return carried * self.settings.seconds_per_byte <= FULLEST_LINE * (now_s - since_s)

    def _read(self, now_s: float) -> bool:
        """Read once, pass on the bytes, and return whether there were any. Close a dead port."""
        if self._descriptor is None:
            return False
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError as error:
            self._lose(self._explain(error))
            return False
        if not data:
            # A tty after a hang-up is always readable and returns nothing: only closing it ends the busy loop.
            self._lose(self._explain(None))
            return False
        self.bytes_received += len(data)
        if self.budget is not None and not self.budget.spend(len(data), now_s):
            self._pause()
        self._on_bytes(data, now_s)
        return True

    def _pause(self) -> None:
        loop = asyncio.get_running_loop()
        assert self._descriptor is not None
        self._stop_collecting()
        loop.remove_reader(self._descriptor)
        self._paused = loop.call_later(FLOOD_PAUSE_S, self._resume)

    def _resume(self) -> None:
        self._paused = None
        if self._descriptor is None or self.budget is None:
            return
        loop = asyncio.get_running_loop()
        try:
            for _ in range(DISCARD_READS):
                data = os.read(self._descriptor, DISCARD_BYTES)
                if not data:
                    break  # the next read gets the error and explains it
                self.bytes_received += len(data)
        except OSError:
            pass  # empty, or gone: the next read handles it
        self._on_gap()
        self._reads, self._reads_since = 0, (loop.time(), self.bytes_received)
        loop.add_reader(self._descriptor, self._readable)

    def _flush(self) -> None:
        if self._descriptor is None:
            return
        loop = asyncio.get_running_loop()
        try:
            while self._out:
                del self._out[: os.write(self._descriptor, self._out)]
        except (BlockingIOError, InterruptedError):
            loop.add_writer(self._descriptor, self._flush)
            return
        except OSError as error:
            self._lose(self._explain(error))
            return
        loop.remove_writer(self._descriptor)

    def _explain(self, error: OSError | None) -> str:
        url = self.settings.url
        if not self.settings.is_tcp and (error is None or error.errno in (errno.EIO, errno.ENXIO, errno.ENODEV)):
            return message("device_gone", port=url)
        reason = "the other side closed the connection" if error is None else words_of(error)
        return message("no_connection", url=url, reason=reason)

    def _lose(self, reason: str) -> None:
        # Close at once, not in `run`: while a dead descriptor is open, the device returns under another name.
        self._close()
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(reason)

    def _close(self) -> None:
        descriptor, self._descriptor = self._descriptor, None
        self._out.clear()
        self._stop_collecting()
        if descriptor is None:
            return
        loop = asyncio.get_running_loop()
        if self._paused is not None:
            self._paused.cancel()
            self._paused = None
        loop.remove_reader(descriptor)
        loop.remove_writer(descriptor)
        close_serial(descriptor)
