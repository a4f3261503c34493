"""How many bytes a port may bring: a device that goes mad, or a loop-back, must not occupy the daemon."""

from __future__ import annotations

from typing import Final

BYTES_PER_S: Final = 262144.0
"""More than any sensor sends: an IMU at 1 kHz with frames of 200 bytes, with some to spare; a line at 2.6 Mbaud."""
BURST_BYTES: Final = 65536.0
"""What may have gathered in the kernel while the loop was busy."""


class Budget:
    """A bucket that fills with so many bytes a second, and from which every read takes."""

    def __init__(self, bytes_per_s: float = BYTES_PER_S, burst_bytes: float = BURST_BYTES) -> None:
        self._bytes_per_s, self._burst_bytes = bytes_per_s, burst_bytes
        self._left, self._t_s = burst_bytes, 0.0
        self.exceeded_s: float | None = None
        """When it was last empty; None: never."""

    def left(self, now_s: float) -> float:
        """How many may be taken."""
        gained = max(now_s - self._t_s, 0.0) * self._bytes_per_s
        return min(self._left + gained, self._burst_bytes)

    def take(self, count: int, now_s: float) -> bool:
        """Take so many; False when there were not so many, which leaves a bucket that is empty and no more."""
        self._left, self._t_s = self.left(now_s) - count, now_s
        if self._left >= 0.0:
            return True
        self._left, self.exceeded_s = 0.0, now_s
        return False
