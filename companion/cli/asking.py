"""Dialogue of `companion setup`: asks one question at a time at a terminal or on a web page, or uses the defaults."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncGenerator
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from companion.cli.terminal import print_address, print_lines
from companion.errors import CalibrationRefusedError, CompanionError, ConfigError
from companion.formats import Object
from companion.setup.draft import Question, one_of

_MOST_BYTES: Final = 4096
OPEN_WITHIN_S: Final = 5.0
EVERY_S: Final = 0.5
SHOWN_S: Final = 1.0  # Time after which an open web page surely displays the last state


class Interview:
    """Asks questions on stdout (`error`: on stderr) and reads answers from stdin; `yes`: use the present answers."""

    def __init__(self, *, yes: bool, error: bool) -> None:
        self.yes, self._error = yes, error
        self._rest = b""
        self._echoes = not sys.stdin.isatty()

    def say(self, *lines: str) -> None:
        print_lines(*lines, error=self._error)

    async def ask(self, question: Question) -> None:
        """Ask a question until its answer is valid; an empty answer means the present one.

        Raises:
            CompanionError: stdin has ended; or no questions are asked and the present answer is not valid.
        """
        now = question.now
        if self.yes:
            question.put(now)
            self.say(f"{question.words.rstrip('?')}: {now}")
            return
        self.say("", question.words, *([f"  {question.hint}"] if question.hint else []))
        while True:
            self._prompt(now)
            answer = (await self._line()).strip() or now
            if self._echoes:
                self.say(answer)
            if answer.lower() in ("?", "help"):
                self.say(f"  {question.more or question.hint or 'docs/guide.md explains every step.'}")
                continue
            try:
                question.put(answer)
            except ConfigError as error:
                self.say(f"  {error}")
            else:
                return

    def _prompt(self, now: str) -> None:
        print_lines(f"  [{now}] >" if now else "  >", error=self._error, end=" ")

    async def agrees(self, question: str, *, by_default: bool = True, hint: str = "") -> bool:
        found = by_default

        def put(words: str) -> None:
            nonlocal found
            found = one_of(words, ("yes", "no")) == "yes"

        await self.ask(Question(question, "yes" if by_default else "no", put, hint, ("yes", "no")))
        return found

    async def _line(self) -> str:
        """Read a line from stdin; unlike Python's `input`, stop waiting at Ctrl-C at once."""
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
        return os.read(descriptor, _MOST_BYTES)  # a regular file is always ready
    try:
        await ready.wait()
    finally:
        loop.remove_reader(descriptor)
    return os.read(descriptor, _MOST_BYTES)


class PageInterview(Interview):
    """Asks questions on a web page, which `async with` opens. Its token is the one in the daemon's folder `storage`."""

    def __init__(self, bind: str, storage: Path) -> None:
        from companion.web.server import Page  # no other command needs the web server

        super().__init__(yes=False, error=False)
        self._echoes = True
        self._lines: list[str] = []
        self._question: Object | None = None
        self._answered: asyncio.Future[str] | None = None
        self._number = 0
        self._page = Page(bind, storage, self._answer)

    async def __aenter__(self) -> Self:
        """Open the web page; raise CompanionError with the reason if that fails."""
        self._serving = asyncio.create_task(self._page.run(), name="page")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(OPEN_WITHIN_S):
                while self._page.problem == "not open yet":
                    await asyncio.sleep(0.01)
        if self._page.problem is not None:
            await self._close()
            raise CompanionError(f"the page cannot be opened: {self._page.problem}")
        print_address(self._page.url, None if self._page.local else self._page.access.token)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, CompanionError):
            self.say("", f"ended: {error}" if error is not None else "All is done.")
            await asyncio.sleep(SHOWN_S)
        await self._close()

    async def _close(self) -> None:
        self._serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._serving

    def _prompt(self, now: str) -> None:
        print_lines(f"  [{now}] answer on the page >" if now else "  answer on the page >", end=" ")

    def say(self, *lines: str) -> None:
        super().say(*lines)
        self._lines += lines

    async def ask(self, question: Question) -> None:
        shown = ("words", "hint", "now", "choices", "more")
        self._question = {key: getattr(question, key) for key in shown}
        try:
            await super().ask(question)
        finally:
            self._question = None

    async def _line(self) -> str:
        self._number += 1
        self._answered = asyncio.get_running_loop().create_future()
        return await self._answered

    async def _answer(self, request: Object) -> AsyncGenerator[Object, None]:
        """Handle a request of the web page (status, monitor, answer) with replies like those of the daemon."""
        if request.get("command") == "status":
            yield {"kind": "result", "status": self._status()}
            return
        while request.get("command") == "monitor":
            yield {"kind": "progress", "status": self._status()}
            await asyncio.sleep(EVERY_S)
        words = request.get("words")
        if request.get("command") != "answer" or not isinstance(words, str):
            raise CalibrationRefusedError("there is no configuration yet: answer the questions first")
        if self._answered is None or self._answered.done() or request.get("number") != self._number:
            raise CalibrationRefusedError("this question is answered already")
        self._answered.set_result(words)
        yield {"kind": "result", "reason": "taken"}

    def _status(self) -> Object:
        question = None if self._question is None else {**self._question, "number": self._number}
        if question is None:
            latest = next((line for line in reversed(self._lines) if line.strip()), "")
            headline = {"word": "SETTING UP", "reason": latest.strip(), "tone": "busy"}
        else:
            headline = {"word": "YOUR ANSWER", "reason": "", "tone": "wait"}
        return {"headline": headline, "setup": {"lines": self._lines, "question": question}}
