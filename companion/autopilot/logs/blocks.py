"""Which blocks of a file are asked for next, how many at once, and how long the line then has for itself. Pure."""

from __future__ import annotations

from typing import Final

BLOCK_BYTES: Final = 239
"""The most that one message of MAVLink FTP carries."""
MOST_AT_ONCE: Final = 5
"""So many requests ArduPilot keeps (AP_MAVLINK_FTP_MAX_SESSIONS)."""
LONGEST_S: Final = 0.1
"""The most time that the blocks asked for at once may hold up telemetry, where they are more than one."""
LEAST_PAUSE_S: Final = 0.02
"""Makes 60 kB/s at most, whatever the line."""
FIRST_WITHIN_S: Final = 1.0
_LEAST_WITHIN_S: Final = 0.15
_MOST_WITHIN_S: Final = 4.0


class Blocks:
    """A file from `front` to `end` (bytes): what is in front is there, without a gap."""

    def __init__(self, front: int, end: int) -> None:
        self.front, self.end = front, end
        self.within_s = FIRST_WITHIN_S
        """How long the answers to what is `wanted` are waited for."""
        self._at_once = 1
        self._held: dict[int, bytes] = {}

    def wanted(self) -> list[tuple[int, int]]:
        """Offset and length of the next blocks."""
        reach = min(self.end, self.front + self._at_once * BLOCK_BYTES)
        return [
            (offset, min(BLOCK_BYTES, self.end - offset))
            for offset in range(self.front, reach, BLOCK_BYTES)
            if offset not in self._held
        ]

    def take(self, offset: int, data: bytes) -> bytes:
        """A block has come, in any order and as often as it likes; what now follows the front without a gap."""
        if data and self.front <= offset and offset + len(data) <= self.end:
            self._held.setdefault(offset, data)
        whole = b""
        while (block := self._held.pop(self.front, None)) is not None:
            whole += block
            self.front += len(block)
        # Behind a block that came short the others begin in its middle.
        self._held = {at: block for at, block in self._held.items() if (at - self.front) % BLOCK_BYTES == 0}
        return whole

    def pause_s(self, took_s: float, *, all_came: bool) -> float:
        """How long to ask for nothing after blocks that took so long: as long again, so that half of the line is free.

        A line shows its speed by how long they take, however many stations and routers are between.
        """
        if not all_came:
            self._at_once = max(1, self._at_once // 2)
            self.within_s = min(2.0 * self.within_s, _MOST_WITHIN_S)
            return LEAST_PAUSE_S
        self.within_s = min(max(4.0 * took_s, _LEAST_WITHIN_S), _MOST_WITHIN_S)
        if took_s > LONGEST_S:
            self._at_once = max(1, self._at_once - 1)
        elif took_s < LONGEST_S / 2.0:
            self._at_once = min(MOST_AT_ONCE, self._at_once + 1)
        return max(took_s, LEAST_PAUSE_S)
