"""The service manager's end of sd_notify: a datagram socket and all that came."""

from __future__ import annotations

import asyncio
import os
import socket
from pathlib import Path
from types import TracebackType
from typing import Self


class NotifySocket:
    """The socket of systemd for a Type=notify service; a context manager inside a running loop.

    Args:
        path: path of the socket; None: an abstract name.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.address = f"@companion-test-{os.getpid()}-{id(self)}" if path is None else str(path)
        self.messages: list[tuple[float, dict[str, str]]] = []
        """The loop's time at which each datagram came, and its assignments."""
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._came = asyncio.Event()

    def __enter__(self) -> Self:
        self._socket.bind("\0" + self.address[1:] if self.address.startswith("@") else self.address)
        asyncio.get_running_loop().add_reader(self._socket, self._read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()

    def environment(self, watchdog_s: float | None = None) -> dict[str, str]:
        watchdog = {} if watchdog_s is None else {"WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        return {"NOTIFY_SOCKET": self.address, **watchdog}

    def times(self, key: str, value: str = "1") -> list[float]:
        return [t_s for t_s, message in self.messages if message.get(key) == value]

    @property
    def status(self) -> str:
        """The last STATUS; empty before the first."""
        return next((message["STATUS"] for _, message in reversed(self.messages) if "STATUS" in message), "")

    async def until(self, key: str, words: str = "1", within_s: float = 90.0, count: int = 1) -> dict[str, str]:
        """Wait until so many messages have come in which `key` contains the words; the last of these.

        Raises:
            TimeoutError: they did not come; what did is in the message.
        """
        try:
            async with asyncio.timeout(within_s):
                while len(found := [m for _, m in self.messages if words in m.get(key, "")]) < count:
                    self._came.clear()
                    await self._came.wait()
        except TimeoutError:
            raise TimeoutError(f"no {key} with {words!r} in {[m for _, m in self.messages][-20:]}") from None
        return found[count - 1]

    def _read(self) -> None:
        while True:
            try:
                data = self._socket.recv(65536)
            except BlockingIOError:
                return
            lines = (line.partition("=") for line in data.decode().splitlines())
            self.messages.append((asyncio.get_running_loop().time(), {key: value for key, _, value in lines}))
            self._came.set()
