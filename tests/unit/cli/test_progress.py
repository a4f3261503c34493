"""Progress of a waiting command on a terminal of 80 columns."""

from __future__ import annotations

import io
import re
import sys

import pytest

from companion.cli.client import Progress


class Screen(io.StringIO):
    """Rows that a VT100 of 80 columns shows, with the sequences that move to a row above and erase what is below."""

    def isatty(self) -> bool:
        return True

    def rows(self) -> list[str]:
        rows, at, column = [""], 0, 0
        for up, erase, letter in re.findall(r"\x1b\[(\d+)A|\x1b\[(J)|(.)", self.getvalue(), re.DOTALL):
            if up:
                at -= int(up)
            elif erase:
                rows[at:] = [rows[at][:column]]
            elif letter == "\r":
                column = 0
            elif letter == "\n":
                at, column = at + 1, 0
                rows += [""] * (at == len(rows))
            else:
                assert column < 79, "the terminal would wrap by itself"
                rows[at] = f"{rows[at][:column].ljust(column)}{letter}{rows[at][column + 1 :]}"
                column += 1
        return rows


def test_a_long_instruction_is_shown_whole_and_counts_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", screen := Screen())
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    progress = Progress()
    progress.show(30, "measuring: 1 of 3: measuring, 11 of 12 s, hands off")
    for turned in (7, 28, 180):
        words = f"waiting: 2 of 3: turn it by 180 degrees, onto its marks; turned {turned} of 180 degrees"
        progress.show(33, words)
        shown = screen.rows()
        assert shown[0] == "[ 30 %] measuring: 1 of 3: measuring, 11 of 12 s, hands off"
        assert len(shown) == 3
        assert " ".join(shown[1:]) == f"[ 33 %] {words}"
    progress.show(34, "measuring: 2 of 3")
    progress.show(35, "measuring: 2 of 3")
    progress.close()
    assert screen.rows()[3:] == ["[ 35 %] measuring: 2 of 3", ""]
