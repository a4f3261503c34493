"""An event loop whose clock jumps to the next timer: minutes of protocol in milliseconds, the same every run.

Only for code whose peers are all in memory: nothing waits for a real descriptor.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, Final, TypeVar

T = TypeVar("T")

MOST_TURNS_A_SECOND: Final = 50_000
"""Turns of the loop in one virtual second: far more than the busiest rig needs (under 2000).

It is work without a pause.
"""


class JumpingSelector(selectors.EpollSelector):
    """A selector that, instead of sleeping, moves its loop's clock by the time it would have slept."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 1000.0
        self._second_began_s = self.now_s
        self._turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._turns += 1
        if self.now_s - self._second_began_s >= 1.0:
            self._second_began_s, self._turns = self.now_s, 0
        elif self._turns > MOST_TURNS_A_SECOND:
            msg = f"livelock: {self._turns} turns of the loop within one second of virtual time"
            raise RuntimeError(msg)
        # Nothing is ready where nothing but the loop's own pipe is watched, which threads alone write to.
        ready = super().select(0) if timeout is None or len(self.get_map()) > 1 or self._turns % 64 == 0 else []
        if ready or timeout == 0:
            return ready
        if timeout is None:
            msg = "deadlock: every task waits for something that no timer will bring"
            raise RuntimeError(msg)
        self.now_s += max(timeout, 1e-9)
        return ready


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """A selector loop on virtual time; `time()` starts at 1000 s."""

    def __init__(self) -> None:
        self._jumping = JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now_s


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)
