"""A program at a terminal of its own, and a person who reads what it says and types."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import re
import sys
import termios
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

WITHIN_S = 90.0
CTRL_C, CTRL_D = "\x03", "\x04"


def _take_terminal() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


class Terminal:
    """An async context manager: starts `python -m companion` with these words, and ends it on leaving.

    Args:
        words: its arguments.
        folder: where it is started.
        before: Python to run in it first.
    """

    def __init__(self, words: Sequence[str], folder: Path, before: str = "") -> None:
        self._words, self._folder = words, folder
        start = "from companion import cli; raise SystemExit(cli.main())"
        self._program = ["-c", f"{before}; {start}"] if before else ["-m", "companion"]
        self.screen = ""
        self._new = asyncio.Event()
        self._read_to = 0

    async def __aenter__(self) -> Self:
        self._master, slave = os.openpty()
        os.set_blocking(self._master, False)
        asyncio.get_running_loop().add_reader(self._master, self._on_output)
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, *self._program, *self._words, stdin=slave, stdout=slave, stderr=slave,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}, cwd=self._folder,
            start_new_session=True, preexec_fn=_take_terminal,
        )  # fmt: skip
        os.close(slave)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._process.returncode is None:
            self._process.kill()
        await self._process.wait()
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)

    async def says(self, words: str) -> str:
        """Wait for these words (an expression) beyond what was read before; what was said up to their end."""
        async with asyncio.timeout(WITHIN_S):
            while (found := re.compile(words).search(self.screen, self._read_to)) is None:
                assert self._process.returncode is None, f"it has ended, without {words!r}:\n{self.screen}"
                self._new.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._new.wait(), 1.0)
        before, self._read_to = self._read_to, found.end()
        return self.screen[before : found.end()]

    def types(self, words: str) -> None:
        os.write(self._master, words.encode())

    async def answer(self, question: str, words: str = "") -> None:
        """Wait for a question and its prompt, and type a line."""
        await self.says(f"(?s){question}.*?> ")
        self.types(f"{words}\n")

    async def ended(self) -> int:
        async with asyncio.timeout(WITHIN_S):
            return await self._process.wait()

    def _on_output(self) -> None:
        with contextlib.suppress(OSError):  # EIO: nobody has the other end any more
            self.screen += os.read(self._master, 65536).decode().replace("\r\n", "\n")
            self._new.set()
            return
        asyncio.get_running_loop().remove_reader(self._master)
        self._new.set()
