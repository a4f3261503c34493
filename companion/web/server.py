"""The page at its address: opened, opened again, and its status. It holds no state but who looks."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.formats import Object
from companion.links.system.connection import Backoff, Reconnection
from companion.web.access import Access, is_loopback, kept_token, new_token, page_url, split_address
from companion.web.app import PageRoutes
from companion.web.listener import listening
from companion.web.viewers import Ask, Viewers

WORTH_S: Final = 10.0
"""A page that was open for this long is opened again at once."""
_PARTS: Final = Path(__file__).with_name("page")
_STYLE: Final = re.compile(rb'<link rel="stylesheet" href="([\w./]+)">')
_SCRIPT: Final = re.compile(rb'<script src="([\w.]+)"></script>')


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
        self._html = _assembled()
        self._viewers = Viewers(ask, local=self.local)
        self._site: PageRoutes | None = None
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
            self._site = PageRoutes(self.access, self._ask, self._viewers, self._html)
            headers = _security_headers(self._html)
            async with listening(self._site.app, self._host, self._port, *headers) as self._port:
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


def _assembled() -> bytes:
    """Return the page as one document: a phone at the edge of the hotspot has all of it or nothing."""
    html = (_PARTS / "page.html").read_bytes()
    html = _STYLE.sub(lambda found: b"<style>\n" + (_PARTS / found[1].decode("ascii")).read_bytes() + b"</style>", html)
    return _SCRIPT.sub(
        lambda found: b"<script>\n" + (_PARTS / found[1].decode("ascii")).read_bytes() + b"</script>", html
    )


def _security_headers(html: bytes) -> tuple[tuple[str, str], ...]:
    """Return headers that let nothing but the page's own style and script run, and speak to nobody but us."""

    def hashes(tag: bytes) -> str:
        found = re.findall(b"<" + tag + b">(.*?)</" + tag + b">", html, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(text).digest()).decode() for text in found)
        return " ".join(f"'sha256-{digest}'" for digest in digests)

    policy = (
        f"default-src 'none'; script-src {hashes(b'script')}; style-src {hashes(b'style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return ("Content-Security-Policy", policy), ("Cross-Origin-Opener-Policy", "same-origin")
