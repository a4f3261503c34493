"""Process of the page: `python -m companion.web`, a child of the daemon and a client of its control socket."""

from __future__ import annotations

from typing import Final

from companion.links.system.process import ChildSettings, ChildWork, run_child

MEMORY_MIB: Final = 80
"""Twice the largest use measured: 22 MiB with a viewer, 39 with 16 deaf viewers and 1000 hostile connections."""


def _page(settings: ChildSettings) -> ChildWork:
    # Imported here: by now the process is nice, so that the daemon's start does not wait for it.
    from companion.links.system.connection import ask
    from companion.web.server import Page

    config = settings.config
    if config.web is None:
        raise ValueError("no [web] in the configuration")
    return Page(config.web.bind, config.storage.path, lambda asked: ask(config.control.path, asked | {"face": "page"}))


if __name__ == "__main__":
    run_child(_page, memory_mib=MEMORY_MIB)
