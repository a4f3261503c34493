"""What can be asked for."""

from __future__ import annotations

import enum
from typing import Final, TypeGuard

LONGEST_S: Final = 1e6


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


def is_time_limit(value: object) -> TypeGuard[float]:
    """Whether this is a number of seconds that something may be given: above 0 and below a million."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < LONGEST_S
