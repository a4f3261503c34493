"""Process that serves the web page (`python -m companion.web`): the daemon's child and its control socket's client."""

from __future__ import annotations

from typing import Final

from companion.links.system.process import ChildSettings, ChildWork, run_child

MEMORY_MIB: Final = 80
"""Memory limit, twice the largest use: 22 MiB with one viewer, 39 with 16 stalled viewers and 1000 hostile clients."""


def _page(settings: ChildSettings) -> ChildWork:
    # Import here, where this process already has its low priority, so as not to delay the daemon's start.
    from companion.links.system.connection import ask
    from companion.web.server import Page

    config = settings.config
    if config.web is None:
        raise ValueError("no [web] in the configuration")
    return Page(config.web.bind, config.storage.path, lambda asked: ask(config.control.path, asked | {"face": "page"}))


if __name__ == "__main__":
    run_child(_page, memory_mib=MEMORY_MIB)
