"""Questions to a person at a terminal, one at a time; or to nobody, who takes what stands in brackets."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Sequence
from typing import Final

from companion.cli.terminal import print_lines
from companion.errors import CompanionError, ConfigError
from companion.setup.draft import one_of

_MOST_BYTES: Final = 4096


class Asking:
    """Asks on stdout, or on stderr where stdout is for JSON; takes answers from stdin. `yes`: nobody is asked."""

    def __init__(self, *, yes: bool, error: bool) -> None:
        self.yes, self._error = yes, error
        self._rest = b""
        self._echoes = not sys.stdin.isatty()

    def say(self, *lines: str) -> None:
        """Tell something."""
        print_lines(*lines, error=self._error)

    async def ask(
        self, question: str, now: str, put: Callable[[str], None], hint: str = "", choices: Sequence[str] = ()
    ) -> None:
        """Ask until `put` takes the answer; an empty one is what holds now. With `yes` that is taken, and said.

        `put` raises ConfigError, in one line, where it is none; `choices` are for a page that makes buttons of them.

        Raises:
            CompanionError: there is nobody to answer any more, or, with `yes`, what holds now is no answer.
        """
        if self.yes:
            put(now)
            self.say(f"{question.rstrip('?')}: {now}")
            return
        self.say("", question, *([f"  {hint}"] if hint else []))
        while True:
            print_lines(f"  [{now}] >" if now else "  >", error=self._error, end=" ")
            answer = (await self._line()).strip() or now
            if self._echoes:
                self.say(answer)
            try:
                put(answer)
            except ConfigError as error:
                self.say(f"  {error}")
            else:
                return

    async def agrees(self, question: str, *, by_default: bool = True, hint: str = "") -> bool:
        """Ask what is answered by yes or no."""
        found = by_default

        def put(words: str) -> None:
            nonlocal found
            found = one_of(words, ("yes", "no")) == "yes"

        await self.ask(question, "yes" if by_default else "no", put, hint, ("yes", "no"))
        return found

    async def _line(self) -> str:
        """The next line that is typed. Ctrl-C ends the waiting at once, which it would not in `input`."""
        while b"\n" not in self._rest and len(self._rest) < _MOST_BYTES:
            chunk = await _read(sys.stdin.fileno())
            if not chunk:
                self.say("")
                raise CompanionError("nobody answers (with --yes what stands in brackets is taken)")
            self._rest += chunk
        line, _, self._rest = self._rest.partition(b"\n")
        return line.decode(errors="replace")


async def _read(descriptor: int) -> bytes:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()
    try:
        loop.add_reader(descriptor, ready.set)
    except PermissionError:
        return os.read(descriptor, _MOST_BYTES)  # a file, which is always ready
    try:
        await ready.wait()
    finally:
        loop.remove_reader(descriptor)
    return os.read(descriptor, _MOST_BYTES)
