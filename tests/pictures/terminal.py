"""Output of a command as an animated SVG: lines appear one after another, and scroll.

Recorders that do so are not maintained (termtosvg, since 2020) or need Node (svg-term). A program that only ever adds
lines needs two animations: one scrolls, one uncovers.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple
from xml.sax.saxutils import escape

ROOT: Final = Path(__file__).parents[2]
ROWS, COLUMNS = 26, 118
LINE_PX, CHARACTER_PX, MARGIN_PX = 17.0, 7.83, 12.0
"""Metrics of a monospaced font of 13 px."""
LONGEST_PAUSE_S: Final = 0.25
END_S: Final = 8.0
"""Display time of the last lines before the restart."""
_STYLE: Final = (
    "text{font:13px ui-monospace,Menlo,Consolas,'DejaVu Sans Mono',monospace;fill:#d4d4d4;white-space:pre}"
    ".c{fill:#7ec699}"
)


class TerminalLine(NamedTuple):
    t_s: float
    text: str


async def recorded(*words: str) -> list[TerminalLine]:
    """Run `python -m WORDS` and take down what it prints.

    Raises:
        RuntimeError: it failed.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-u", "-m", *words, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    assert process.stdout is not None
    loop = asyncio.get_running_loop()
    lines = [TerminalLine(loop.time(), line.decode().rstrip("\n")) async for line in process.stdout]
    if code := await process.wait():
        raise RuntimeError(f"{' '.join(words)} ended with {code}: {lines[-1].text if lines else 'without a word'}")
    return lines


def shortened(lines: Sequence[TerminalLine]) -> list[TerminalLine]:
    """Shorten long pauses; start at 0."""
    now_s, before_s, found = 0.0, lines[0].t_s, []
    for line in lines:
        now_s += min(line.t_s - before_s, LONGEST_PAUSE_S)
        before_s = line.t_s
        found.append(TerminalLine(now_s, line.text))
    return found


def wrapped(lines: Sequence[TerminalLine]) -> list[TerminalLine]:
    return [
        TerminalLine(line.t_s, line.text[at : at + COLUMNS])
        for line in lines
        for at in range(0, len(line.text) or 1, COLUMNS)
    ]


def svg(command: str, lines: Sequence[TerminalLine]) -> str:
    """The picture: the command at a prompt, then the lines."""
    shown = [TerminalLine(0.0, f"$ {command}"), *wrapped(shortened(lines))]
    total_s = shown[-1].t_s + END_S
    width, height = COLUMNS * CHARACTER_PX + 2 * MARGIN_PX, ROWS * LINE_PX + 2 * MARGIN_PX
    covered, scrolled = [], []
    for number, line in enumerate(shown, 1):
        at = f"{100.0 * line.t_s / total_s:.2f}%"
        if number < len(shown) and shown[number].t_s == line.t_s:
            continue  # they come together
        covered.append(f"{at}{{transform:translateY({number * LINE_PX:g}px)}}")
        scrolled.append(f"{at}{{transform:translateY({-max(number - ROWS, 0) * LINE_PX:g}px)}}")
    texts = "\n".join(
        f'<text y="{number * LINE_PX - 4:g}"{" class=" + chr(34) + "c" + chr(34) if number == 1 else ""}>'
        f"{escape(line.text)}</text>"
        for number, line in enumerate(shown, 1)
        if line.text
    )
    # Without animations the end is shown: all lines, scrolled to the last.
    end = -max(len(shown) - ROWS, 0) * LINE_PX
    box = f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(command)}"'
    return f"""<svg xmlns="http://www.w3.org/2000/svg" {box}>
<style>{_STYLE}
.s{{transform:translateY({end:g}px);animation:s {total_s:.1f}s step-end infinite}}
.u{{transform:translateY({len(shown) * LINE_PX:g}px);animation:u {total_s:.1f}s step-end infinite}}
@keyframes s{{{"".join(scrolled)}}}
@keyframes u{{{"".join(covered)}}}
@media (prefers-reduced-motion){{.s,.u{{animation:none}}}}</style>
<rect width="100%" height="100%" rx="6" fill="#1e1e1e"/>
<svg x="{MARGIN_PX:g}" y="{MARGIN_PX:g}" width="{width - 2 * MARGIN_PX:g}" height="{ROWS * LINE_PX:g}"><g class="s">
{texts}
<rect class="u" width="100%" height="{len(shown) * LINE_PX:g}" fill="#1e1e1e"/></g></svg>
</svg>
"""
