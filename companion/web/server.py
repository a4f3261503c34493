"""The page at its address: opened, opened again, and its status. It holds no state but who looks."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.formats import Object
from companion.links.system.connection import Backoff, Reconnection
from companion.web.access import Access, is_loopback, kept_token, new_token, page_url, split_address
from companion.web.app import Site
from companion.web.document import assembled, security_headers
from companion.web.listener import listening
from companion.web.viewers import Ask, Viewers

WORTH_S: Final = 10.0
"""A page that was open for this long is opened again at once."""


class Page:
    """Serves the page at HOST:PORT; `run` it as a task of its own.

    The token is kept in the storage when others than this board can reach it.
    """

    def __init__(self, bind: str, directory: Path, ask: Ask) -> None:
        self._host, self._port = split_address(bind)
        self._directory, self._ask = directory, ask
        self.local = is_loopback(self._host)
        self.access = Access(new_token(), handed_out=self.local)
        self.problem: str | None = "not open yet"
        """Why nobody can look, in one line; None while the page is there."""
        self._html = assembled()
        self._viewers = Viewers(ask, local=self.local)
        self._site: Site | None = None
        self._reconnection = Reconnection(
            "page", Backoff(first_s=1.0, cap_s=30.0), worth_s=WORTH_S, on_state=self._on_state
        )

    async def run(self) -> None:
        """Serve until cancelled; an address that is not there yet is waited for."""
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        try:
            if not self.local:
                self.access = Access(kept_token(self._directory), handed_out=False)
            self._site = Site(self.access, self._ask, self._viewers, self._html)
            headers = security_headers(self._html)
            async with listening(self._site.app, self._host, self._port, headers) as self._port:
                self._reconnection.up(self.url)
                await self._viewers.run()
        except OSError as error:
            return f"{self._host}:{self._port}: {error.strerror or error}"
        except StorageError as error:
            return f"{self._host}:{self._port}: {error}"

    def _on_state(self, there: bool, words: str) -> None:  # noqa: FBT001 - Reconnection's own signature
        self.problem = None if there else words

    @property
    def url(self) -> str:
        """Address for a browser."""
        return page_url(self._host, self._port)

    def status(self) -> Object:
        """Return what `companion status` shows."""
        return {
            "good": self.problem is None,
            "summary": self.problem or self.url + ("" if self.local else " (buttons: companion web-token)"),
            "url": None if self.problem else self.url,
            "viewers": len(self._viewers),
            "wrong_tokens": 0 if self._site is None else self._site.wrong_tokens,
        }
