"""The questions of `setup` on a page, for whoever has a phone at hand and no terminal."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from companion.cli.asking import Asking
from companion.cli.terminal import print_address
from companion.errors import CalibrationRefusedError, CompanionError
from companion.formats import Object
from companion.web.server import Page

OPEN_WITHIN_S: Final = 5.0
EVERY_S: Final = 0.5
SHOWN_S: Final = 1.0
"""Within which a page that looks has the last state."""


class PageAsking(Asking):
    """Says all in the terminal too, asks on the page alone; an async context manager, which the page is there within.

    The storage is the daemon's, whose page takes the same token.
    """

    def __init__(self, bind: str, storage: Path) -> None:
        super().__init__(yes=False, error=False)
        self._echoes = True
        self._lines: list[str] = []
        self._question: Object | None = None
        self._answered: asyncio.Future[str] | None = None
        self._number = 0
        self._page = Page(bind, storage, self._answer)

    async def __aenter__(self) -> Self:
        """Open the page.

        Raises:
            CompanionError: it cannot be; why.
        """
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
        """Close it."""
        if kind is None or issubclass(kind, CompanionError):
            self.say("", f"ended: {error}" if error is not None else "All is done.")
            await asyncio.sleep(SHOWN_S)
        await self._close()

    async def _close(self) -> None:
        self._serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._serving

    def say(self, *lines: str) -> None:  # noqa: D102 - as in the base class
        super().say(*lines)
        self._lines += lines

    async def ask(  # noqa: D102 - as in the base class
        self, question: str, now: str, put: Callable[[str], None], hint: str = "", choices: Sequence[str] = ()
    ) -> None:
        self._question = {"words": question, "hint": hint, "now": now, "choices": list(choices)}
        try:
            await super().ask(question, now, put, hint, choices)
        finally:
            self._question = None

    async def _line(self) -> str:
        self._number += 1
        self._answered = asyncio.get_running_loop().create_future()
        return await self._answered

    async def _answer(self, request: Object) -> AsyncGenerator[Object, None]:
        """Answer the page as a daemon's control socket would: its status, and the operator's answer to the question."""
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
