"""The kinds of calibration that can be requested."""

from __future__ import annotations

import enum
from typing import Final

LONGEST_S: Final = 1e6
"""Time limits are shorter, s."""


class What(enum.Enum):
    """The biases to calibrate; the numbers are param1 of MAV_CMD_USER_1."""

    BOTH = 0
    GYROS = 1
    ACCELEROMETERS = 2

    @property
    def gyros(self) -> bool:
        """True: gyro biases are requested."""
        return self is not What.ACCELEROMETERS

    @property
    def accelerometers(self) -> bool:
        """True: accelerometer biases are requested."""
        return self is not What.GYROS
