"""Which of the long-lived tasks still go on: the watchdog is fed only while all of them do.

A loop that turns proves nothing of a task in it that waits for ever. So each task reports a beat from its own loop,
and the age of a beat counts in turns of whoever looks: while the whole loop stands still nobody ages, or every task
would be blamed for what one blocking call has done (and that the service manager sees by itself).
"""

from __future__ import annotations

from collections.abc import Callable


class Beats:
    """The beats of all tasks that must go on."""

    def __init__(self) -> None:
        self._limits_s: dict[str, float] = {}
        self._ages_s: dict[str, float] = {}

    def expect(self, name: str, within_s: float) -> Callable[[], None]:
        """Expect a beat of the task at least so often; returns what it has to call.

        Raises:
            ValueError: the name is taken.
        """
        if name in self._limits_s:
            raise ValueError(f"two tasks are called {name}")
        self._limits_s[name], self._ages_s[name] = within_s, 0.0

        def beat() -> None:
            self._ages_s[name] = 0.0

        return beat

    def look(self, since_last_look_s: float) -> dict[str, float]:
        """Let time pass; the tasks that are overdue, and since how many seconds nothing was heard of them."""
        for name in self._ages_s:
            self._ages_s[name] += since_last_look_s
        return {name: age_s for name, age_s in self._ages_s.items() if age_s > self._limits_s[name]}
