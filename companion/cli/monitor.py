"""Command `monitor`: shows the daemon's state, its reason, the devices and the last result, until Ctrl-C.

At a terminal, the command redraws the screen with VT100 escape sequences. For other outputs (TERM=dumb, a pipe) it
prints a line whenever the state, a device, a warning or the last result changes.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import shutil
import sys
import textwrap
import time
from typing import Final

from companion import summary
from companion.cli import show
from companion.cli.terminal import DONE, as_typed, load_config, print_json, print_lines
from companion.errors import DaemonUnreachableError
from companion.formats import Object, printable
from companion.links.system.connection import ask

SILENT_S: Final = 5.0
"""Time without a reply after which the monitor reports that the daemon is silent."""
AGAIN_S: Final = 1.0

FIGURES: Final = re.compile(r"\d+([.,:]\d+)*")
_COLOURS: Final = {"good": "1;97;42", "wait": "1;30;103", "busy": "1;97;44", "bad": "1;97;41"}
_SIGNS: Final = {"good": "OK ", "wait": "...", "busy": ">>>", "bad": "!!!"}


async def monitor(options: argparse.Namespace) -> int:
    path = load_config(options).control.path
    view: _Json | _Screen | _Lines
    if options.json:
        view = _Json()
    else:
        view = _Screen() if sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb" else _Lines()
    heard = False
    try:
        while True:
            replies = ask(path, {"command": "monitor"})
            try:
                while True:
                    async with asyncio.timeout(SILENT_S):
                        reply = await anext(replies)
                    if reply["kind"] != "progress":
                        view.gone(str(reply["reason"]))
                        break
                    heard = True
                    view.show(reply["status"])
            except DaemonUnreachableError as error:
                if not heard:
                    raise
                view.gone(str(error))
            except TimeoutError:
                view.gone(f"the daemon has said nothing for {SILENT_S:g} s")
            await asyncio.sleep(AGAIN_S)
    except asyncio.CancelledError:
        return DONE  # Ctrl-C is the normal end
    finally:
        if isinstance(view, _Screen):
            view.close()


class _Json:
    def show(self, status: Object) -> None:
        print_json(status)

    def gone(self, why: str) -> None:
        print_json({"state": "unreachable", "reason": why})


class _Lines:
    """Monitor output for a pipe: prints a line, with the time of day, when its text changes without the figures."""

    def __init__(self) -> None:
        self._before: set[tuple[object, ...]] = set()

    def show(self, status: Object) -> None:
        headline = summary.headline(status)
        tenths = (status["progress"] or 0) // 10
        lines: dict[tuple[object, ...], str] = {(FIGURES.sub("", headline), tenths): headline}
        for _, name, words, _ in summary.rows(status):
            line = f"{name}: {words}"
            lines[(FIGURES.sub("", line),)] = line
        self._print(lines | {(line,): line for line in show.end_lines(status)})

    def gone(self, why: str) -> None:
        self._print({(why,): f"NO DAEMON: {why}; waiting for it"})

    def _print(self, lines: dict[tuple[object, ...], str]) -> None:
        for words, line in lines.items():
            if words not in self._before:
                print_lines(f"{time.strftime('%H:%M:%S')} {line}")
        self._before = set(lines)


class _Screen:
    def __init__(self) -> None:
        self._colours = "NO_COLOR" not in os.environ
        self._last: Object | None = None
        sys.stdout.write("\x1b[2J\x1b[?25l")

    def show(self, status: Object) -> None:
        self._last = status
        headline = status["headline"]
        self._draw(headline["tone"], headline["word"], headline["reason"], status)

    def gone(self, why: str) -> None:
        self._draw("bad", "NO DAEMON", f"{why}; waiting for it", self._last)

    def _draw(self, tone: str, word: str, reason: str, status: Object | None) -> None:
        width, height = shutil.get_terminal_size()
        look = _COLOURS[tone] if self._colours else "1;7"
        head = [" ", f"  {_SIGNS[tone]}  {' '.join(printable(word))}", " "]
        lines = [f"\x1b[{look}m{line[:width].ljust(width)}\x1b[0m" for line in head]
        lines += [f"\x1b[1m{part}\x1b[0m" for part in _wrapped(reason, width)]
        if status is not None:
            lines += ["", *(part for line in show.monitor_lines(status) for part in _wrapped(line, width))]
        lines = lines[: height - 2]
        sys.stdout.write("\x1b[H" + "".join(f"{line}\x1b[K\n" for line in lines))
        sys.stdout.write(f"{time.strftime('%H:%M:%S')}  Ctrl-C ends this, nothing else"[:width] + "\x1b[K\x1b[J")
        sys.stdout.flush()

    def close(self) -> None:
        sys.stdout.write("\x1b[?25h\n")
        sys.stdout.flush()


def _wrapped(line: str, width: int) -> list[str]:
    """Wrap a line to the terminal's width, and escape control characters in it."""
    return textwrap.wrap(
        printable(as_typed.get()(line)), max(width, 20), subsequent_indent="    ", drop_whitespace=False
    ) or [""]
