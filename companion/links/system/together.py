"""What may wait a moment is taken together with the next read of a fast stream: a wake-up costs more than its bytes.

A stream that is read at short, fixed intervals (`bytestream.COLLECT_S`) drives; what others bring meanwhile and need
not be looked at in that very moment waits for its next read, with the time at which it came, in the order in which it
came. While nothing drives, nothing waits.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

logger = logging.getLogger(__name__)

MOST_WAITING: Final = 64
"""What comes beyond is not kept waiting: ten times what an autopilot sends between two reads."""

TURNS: Final = 4
"""What waits is taken at every so many reads of the stream ..."""
SECOND_S: Final = 0.07
"""... and at each within so much after a full second of the loop's clock: until the samples behind it have come,
whoever works out a calibration waits for the second's last ones."""

Take = Callable[[bytes, float], object]


class Together:
    """Chunks of bytes that wait, each with who takes it and when it came. All calls are made on the loop's thread."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Take, bytes, float]] = []
        self._drivers = 0
        self._turns = 0
        """Turns of the drivers since something was taken."""
        self._taking = False

    @property
    def driven(self) -> bool:
        """Whether what waits is taken again and again."""
        return self._drivers > 0

    def drive(self) -> None:
        """From here on the caller calls `turn` at short intervals, until it says `rest`."""
        self._drivers += 1

    def rest(self) -> None:
        """The caller drives no longer."""
        self._drivers -= 1
        if self._drivers == 0:
            self.drain()

    def put(self, take: Take, data: bytes, t_s: float) -> None:
        """Let bytes that came at `t_s` wait for the next `take`; where nothing drives they are taken now."""
        self._waiting.append((take, data, t_s))
        if self._drivers == 0 or len(self._waiting) >= MOST_WAITING:
            self.drain()

    def turn(self, now_s: float) -> None:
        """A driver is about to read: take what waits when it is time to."""
        self._turns += 1
        if self._turns >= TURNS or now_s % 1.0 < SECOND_S:
            self.drain()

    def drain(self) -> None:
        """Take all that waits, in its order."""
        if self._taking:
            return  # by what was taken; the rest is about to be
        self._taking, self._turns = True, 0
        try:
            while self._waiting:
                waiting, self._waiting = self._waiting, []
                for take, data, t_s in waiting:
                    try:
                        take(data, t_s)
                    except Exception:
                        # Of one, which must not cost the others theirs.
                        logger.exception("taking what has waited failed")
        finally:
            self._taking = False
