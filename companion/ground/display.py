"""Progress for people, on stderr: a bar and what is said on a terminal, plain lines anywhere else."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self

from companion.errors import ConfigError
from companion.ground.link import INSTALL
from companion.printable import printable


class Display:
    """A context manager, since a bar must be taken off the terminal again."""

    def __init__(self) -> None:
        try:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
        except ImportError as error:
            raise ConfigError(f"companion ground needs rich: {error}; {INSTALL}") from None
        # What the companion says is no markup: "[x]" stays what it is.
        self._console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
        self._bar: Any = Progress(
            BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False),
            console=self._console, transient=True,
        )  # fmt: skip
        self._task: Any = None
        self._shown = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._task is not None:
            self._bar.stop()

    def progress(self, percent: int, text: str) -> None:
        """Show the progress."""
        text = printable(text)
        if self._console.is_terminal:
            if self._task is None:
                self._task = self._bar.add_task(text, total=100)
                self._bar.start()
            self._bar.update(self._task, completed=percent, description=text)
        elif text != self._shown:
            self._shown = text
            self._console.print(f"[{percent:3d} %] {text}")

    def text(self, text: str, *, urgent: bool) -> None:
        """Show a text of the companion."""
        self._console.print(printable(text), style="bold yellow" if urgent else "")
