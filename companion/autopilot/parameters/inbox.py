"""What arrives about one parameter while somebody waits for it."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Final

_ERROR_WORDS: Final = {
    1: "it does not exist",
    2: "the value is out of range",
    3: "no permission",
    4: "no such component",
    5: "it is read-only",
    6: "its type is not supported",
    7: "its type does not match",
    8: "it could not be read",
}
"""MAV_PARAM_ERROR in words; the generated dialect knows only the first five."""

_INBOX: Final = 64


class Inbox:
    """What arrives about one name during one exchange; when full the oldest answer is dropped."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._arrived: deque[float | Refusal | Rebooted] = deque(maxlen=_INBOX)
        self._bell = asyncio.Event()

    def put(self, item: float | Refusal | Rebooted) -> None:
        """Take what has arrived."""
        self._arrived.append(item)
        self._bell.set()

    async def get(self, deadline_s: float) -> float | Refusal | Rebooted | None:
        """The next item, or None at the deadline (loop's clock)."""
        while not self._arrived:
            self._bell.clear()
            try:
                async with asyncio.timeout_at(deadline_s):
                    await self._bell.wait()
            except TimeoutError:
                return None
        return self._arrived.popleft()


class Refusal:
    """A PARAM_ERROR."""

    def __init__(self, code: int) -> None:
        self.code = code

    @property
    def words(self) -> str:
        """Why, for people."""
        return _ERROR_WORDS.get(self.code, f"error {self.code}")


class Rebooted:
    """The autopilot restarted."""
