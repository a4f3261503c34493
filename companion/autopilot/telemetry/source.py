"""A message that an IMU may come in, and what is known of whether it does."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

from companion.autopilot.telemetry.imu_messages import ImuMessage

ABSENT_AFTER: Final = 10
"""Readings of nothing but zeros in a row, and there is no such IMU."""


@dataclasses.dataclass(slots=True)
class Source:
    """One message as a possible source of samples."""

    message: ImuMessage
    rates_hz: Sequence[float]
    rate: int = 0
    refused: bool = False
    last_s: float = -math.inf
    recent: int = 0
    zeros: int = 0
    reason: str = ""
    device_s: float = -math.inf

    @property
    def name(self) -> str:
        """Of the message."""
        return self.message.kind.message

    @property
    def absent(self) -> bool:
        """Whether there is no such IMU."""
        return self.zeros >= ABSENT_AFTER
