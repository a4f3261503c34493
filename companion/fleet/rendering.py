"""Renders the fleet's pages one after another; clients who ask for the same page share one rendering."""

from __future__ import annotations

import asyncio
import datetime
import re
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import sqlalchemy as sa

from companion.fleet import imu_pages, page

FRESH_S: Final = 2.0
"""Time for which a rendered page is given to further clients."""
_GLANCE: Final = re.compile(r"/(?:page/([1-9][0-9]{0,6}))?")
_AIRCRAFT: Final = re.compile(r"/aircraft/([0-9a-f]{16,36})")
_MODEL: Final = re.compile(r"/model/([0-9a-z-]{1,40})")


def render(connection: sa.Connection, path: str, now: datetime.datetime) -> str | None:
    """Render the page at a path; None: there is none."""
    if (match := _GLANCE.fullmatch(path)) is not None:
        return page.glance(connection, now, int(match[1] or 1))
    if (match := _AIRCRAFT.fullmatch(path)) is not None:
        return page.aircraft(connection, match[1], now)
    if (match := _MODEL.fullmatch(path)) is not None:
        return imu_pages.model_page(connection, match[1], now, page.SOURCE)
    return None


class Renderer:
    """Pages of one database.

    Rendering is work for the processor: at once, 20 of them would take 20 times as long each, and as much memory.
    """

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._thread = ThreadPoolExecutor(1, "fleet-pages")
        self._pages: dict[str, asyncio.Task[bytes | None]] = {}

    async def get(self, path: str) -> bytes | None:
        """Return a page that is at most `FRESH_S` old, or render it; None: there is none.

        Raises:
            SQLAlchemyError: the database cannot be read.
        """
        if (task := self._pages.get(path)) is None:
            task = self._pages[path] = asyncio.create_task(self._render(path), name=f"fleet page {path}")
        # Who leaves meanwhile does not end it for the others.
        return await asyncio.shield(task)

    async def _render(self, path: str) -> bytes | None:
        loop = asyncio.get_running_loop()
        keep_s = 0.0
        try:
            found = await loop.run_in_executor(self._thread, self._rendered, path)
            keep_s = 0.0 if found is None else FRESH_S
            return found
        finally:
            loop.call_later(keep_s, self._pages.pop, path, None)

    def _rendered(self, path: str) -> bytes | None:
        with self._engine.begin() as connection:
            found = render(connection, path, datetime.datetime.now(tz=datetime.UTC))
        return None if found is None else found.encode()
