"""Samples where a daemon's processor time goes: `python -m tests.bench_profile OUT COMPANION-ARGUMENTS`.

A timer of processor time interrupts the main thread every few milliseconds, and what runs then is counted: cheap, and
no function looks dearer than it is because it is called often, as with a profiler that counts calls. What a call into C
takes counts for the line that called. SIGUSR1 begins, SIGUSR2 ends and writes the file.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Final

from companion.cli import main as companion

PERIOD_S: Final = 0.001
WITHIN_S: Final = 10.0
SHOWN: Final = 70
_HOUSE: Final = "/companion/"


class Sampler:
    """Counts innermost functions, and of each sample the innermost room of ours."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._functions: Counter[str] = Counter()
        self._rooms: Counter[str] = Counter()
        self._lines: Counter[str] = Counter()
        self._roots: Counter[str] = Counter()
        self._with_called: Counter[str] = Counter()

    def begin(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGPROF, self._take)
        signal.setitimer(signal.ITIMER_PROF, PERIOD_S, PERIOD_S)

    def end(self, number: int, frame: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        found = {name: dict(each.most_common()) for name, each in vars(self).items() if isinstance(each, Counter)}
        part = self._out.with_suffix(".part")
        part.write_text(json.dumps(found))
        part.rename(self._out)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if frame is None:
            return
        innermost = _words(frame)
        self._functions[innermost] += 1
        self._lines[f"{innermost}:{frame.f_lineno}"] += 1
        room, root = "asyncio and the kernel's waiting", ""
        each: FrameType | None = frame
        seen = set()
        while each is not None:
            _, ours, rest = each.f_code.co_filename.rpartition(_HOUSE)
            if ours and "/cli/" not in each.f_code.co_filename:
                if not root:
                    room = rest.partition("/")[0]
                root = _words(each)
                seen.add(root)
            each = each.f_back
        self._rooms[room] += 1
        self._roots[root or "asyncio"] += 1
        self._with_called.update(seen)


def _words(frame: FrameType) -> str:
    path = Path(frame.f_code.co_filename)
    return f"{'/'.join(path.parts[-2:])} {frame.f_code.co_qualname if sys.version_info >= (3, 11) else ''}"


def start(pid: int) -> None:
    """Let a process that runs under this module begin to count."""
    os.kill(pid, signal.SIGUSR1)


def stop(pid: int, out: Path) -> None:
    """Let it write what it has counted."""
    os.kill(pid, signal.SIGUSR2)
    until_s = time.monotonic() + WITHIN_S
    while not out.exists():
        if time.monotonic() > until_s:
            raise TimeoutError(f"{out}: not written")
        time.sleep(0.1)


def tell(out: Path, share: float) -> None:
    """Print what was counted; `share` of a core in per cent is the whole."""
    found = json.loads(out.read_text())
    whole = sum(found["_rooms"].values())
    for name, words in (
        ("_rooms", "by room (what it calls outside of ours included)"),
        ("_roots", "by what the event loop called"),
        ("_with_called", "by function of ours, with what it calls"),
        ("_functions", "by function, itself only"),
        ("_lines", "by line"),
    ):
        print(f"\n{words}; {whole} samples:")
        for one, count in list(found[name].items())[:SHOWN]:
            print(f"  {share * count / whole:6.2f} % of a core {100 * count / whole:5.1f} %  {one}")


if __name__ == "__main__":
    _sampler = Sampler(Path(sys.argv[1]))
    signal.signal(signal.SIGUSR1, _sampler.begin)
    signal.signal(signal.SIGUSR2, _sampler.end)
    sys.exit(companion(sys.argv[2:]))
