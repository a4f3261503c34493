"""Dialogue of `companion setup`: asks one question at a time at a terminal or on a web page, or uses the defaults."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import sys
from collections.abc import AsyncGenerator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

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
        self._rest, self._where = b"", ""
        self._echoes = not sys.stdin.isatty()

    def say(self, *lines: str) -> None:
        print_lines(*lines, error=self._error)

    async def ask(self, question: Question) -> Any:
        """Ask a question until its answer is valid, return what `put` returns; an empty answer is the present one.

        Raises:
            CompanionError: stdin has ended; or no questions are asked and the present answer is not valid.
        """
        now = question.now
        if self.yes:
            found = question.put(now)
            self.say(f"{question.words.rstrip('?')}: {now}")
            return found
        self.say("", question.words, *([f"  {question.hint}"] if question.hint else []))
        while True:
            print_lines(f"  [{now}]{self._where} >" if now else f" {self._where} >", error=self._error, end=" ")
            answer = (await self._line()).strip() or now
            if self._echoes:
                self.say(answer)
            if answer.lower() in ("?", "help"):
                self.say(f"  {question.more or question.hint or 'docs/guide.md explains every step.'}")
                continue
            try:
                return question.put(answer)
            except ConfigError as error:
                self.say(f"  {error}")

    async def agrees(self, question: str, *, by_default: bool = True, hint: str = "", more: str = "") -> bool:
        choices = ("yes", "no")
        put = functools.partial(one_of, allowed=choices)
        asked = Question(question, choices[not by_default], put, hint, choices, more)
        return bool(await self.ask(asked) == "yes")

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
    with contextlib.suppress(PermissionError):  # a regular file is always ready
        loop.add_reader(descriptor, ready.set)
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
        self._echoes, self._where = True, " answer on the page"
        self._lines: list[str] = []
        self._question: Object | None = None
        self._answered: asyncio.Future[str] | None = None
        self._number = 0
        self._end: Object | None = None  # Last headline, which browsers show after the page has closed
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
        if error is not None:
            self._end = {"word": "SET-UP ENDED", "reason": str(error), "tone": "bad"}
        if kind is None or issubclass(kind, CompanionError):
            await asyncio.sleep(SHOWN_S)
        await self._close()

    async def finish(self, then: str) -> None:
        """Wait until the operator has read the page; it keeps showing the next action `then` after it has closed."""
        await self.agrees("Read all of it? Then this page closes.", hint=then)
        self._end = {"word": "SET-UP DONE", "reason": then, "tone": "good"}

    async def _close(self) -> None:
        self._serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._serving

    def say(self, *lines: str) -> None:
        super().say(*lines)
        self._lines += lines

    async def ask(self, question: Question) -> Any:
        self._question = {key: getattr(question, key) for key in ("words", "hint", "now", "choices", "more")}
        try:
            return await super().ask(question)
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
        headline: Object = {"word": "YOUR ANSWER", "reason": "", "tone": "wait"}
        if question is None:
            latest = next((line for line in reversed(self._lines) if line.strip()), "")
            headline = self._end or {"word": "SETTING UP", "reason": latest.strip(), "tone": "busy"}
        shown = {"lines": self._lines, "question": question, "ended": self._end is not None}
        return {"headline": headline, "setup": shown}
