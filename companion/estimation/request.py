"""What can be asked for."""

from __future__ import annotations

import enum
from typing import Final

LONGEST_S: Final = 1e6
"""Time limits are shorter, s."""


class What(enum.Enum):
    """Which biases to calibrate; the numbers are param1 of MAV_CMD_USER_1."""

    BOTH = 0
    GYROS = 1
    ACCELEROMETERS = 2

    @property
    def gyros(self) -> bool:
        """Whether gyro biases are asked for."""
        return self is not What.ACCELEROMETERS

    @property
    def accelerometers(self) -> bool:
        """Whether accelerometer biases are asked for."""
        return self is not What.GYROS
