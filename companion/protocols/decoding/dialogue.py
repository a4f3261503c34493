"""What is said to a device so that it speaks: polls, and commands to start a stream that has been stopped.

Only what leaves no trace in a device is ever said: nothing that it stores, nothing that toggles unless its state has
been seen, nothing while it speaks by itself. `read_only = true` in the configuration keeps us silent altogether.
Pure: time comes in, bytes go out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final

SILENT_S: Final = 2.0
"""So long a device that streams by itself is waited for before anything is said to it."""


class Dialogue(ABC):
    """The companion's half of the conversation with one device, on one opened port after another."""

    @abstractmethod
    def opened(self, t_s: float) -> None:
        """The port was opened (again) at `t_s`: nothing is known of the device."""

    @abstractmethod
    def heard(self, data: bytes, samples: int, t_s: float) -> None:
        """Bytes came, and completed so many samples; called after they were decoded."""

    @abstractmethod
    def due(self, t_s: float) -> bytes:
        """What is to be sent now; empty for nothing. Asked every 20 ms or so, and after every `heard`."""

    @property
    @abstractmethod
    def words(self) -> str:
        """What was last asked of the device, for people; empty while nothing was ("stream started with S")."""
