"""`companion monitor`: the big word, its reason, the devices and the last result, until Ctrl-C.

A terminal is redrawn in place with a handful of escape sequences that every terminal since the VT100 knows: neither
curses nor a library is needed for that. Where there is no such terminal (TERM=dumb, a pipe) a line is printed
whenever the state, a device, a warning or the last result changes.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import shutil
import sys
import textwrap
import time
from typing import Final

from companion import summary
from companion.cli import show
from companion.cli.terminal import DONE, load_config, print_json, print_lines
from companion.errors import DaemonUnreachableError
from companion.formats import Object
from companion.links.system.control_client import ask
from companion.printable import printable

SILENT_S: Final = 5.0
"""A daemon that says nothing for so long stands still."""
AGAIN_S: Final = 1.0

REASON_S: Final = 10.0
"""Shortest time between lines for the same state with another reason: many reasons count seconds."""
_COLOURS: Final = {"good": "1;97;42", "wait": "1;30;103", "busy": "1;97;44", "bad": "1;97;41"}
_SIGNS: Final = {"good": "OK ", "wait": "...", "busy": ">>>", "bad": "!!!"}


async def monitor(options: argparse.Namespace) -> int:
    """Watch until Ctrl-C; a daemon that goes away is waited for."""
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
        return DONE  # Ctrl-C is how one leaves
    finally:
        view.close()


class _Json:
    """One JSON object a line."""

    def show(self, status: Object) -> None:
        print_json(status)

    def gone(self, why: str) -> None:
        print_json({"state": "unreachable", "reason": why})

    def close(self) -> None:
        pass


class _Lines:
    """A line whenever something changes, each with the time of day."""

    def __init__(self) -> None:
        self._before: set[tuple[object, ...]] = set()
        self._stand: tuple[object, ...] = ()
        self._reason, self._reason_s = "", 0.0

    def show(self, status: Object) -> None:
        headline, now_s = status["headline"], time.monotonic()
        # Every tenth of the way is news; what only counts seconds or frames is not.
        stand = (status["state"], headline["tone"], (status["progress"] or 0) // 10)
        if stand != self._stand or (headline["reason"] != self._reason and now_s - self._reason_s >= REASON_S):
            self._stand, self._reason, self._reason_s = stand, headline["reason"], now_s
        # What each line is about, by which it is known again when it says the same in other figures.
        lines: dict[tuple[object, ...], str] = {(self._reason_s,): summary.headline(status)}
        for row in summary.rows(status):
            line = f"{row.name}: {row.words}"
            lines[(line,) if row.name == "warning" else row[:2]] = line
        lines |= {(line,): line for line in show.end_lines(status)}
        self._print([line for about, line in lines.items() if about not in self._before])
        self._before = set(lines)

    def gone(self, why: str) -> None:
        if self._before != {(why,)}:
            self._print([f"NO DAEMON: {why}; waiting for it"])
        self._before = {(why,)}

    def _print(self, lines: list[str]) -> None:
        now = time.strftime("%H:%M:%S")
        for line in lines:
            print_lines(f"{now} {line}")

    def close(self) -> None:
        pass


class _Screen:
    """The whole terminal, redrawn in place."""

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
    """A line as the terminal holds it; what a wire may have slipped into it moves no cursor."""
    return textwrap.wrap(printable(line), max(width, 20), subsequent_indent="    ", drop_whitespace=False) or [""]
