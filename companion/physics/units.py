"""Factors from the field's units to SI."""

from __future__ import annotations

import math
from typing import Final

DEG: Final = math.pi / 180.0
"""rad per degree."""

DEG_H: Final = math.pi / 180.0 / 3600.0
"""rad/s per degree per hour."""

G: Final = 9.80665
"""m/s^2 per g of the standard gravity."""

MG: Final = 9.80665e-3
"""m/s^2 per milli-g of the standard gravity, the unit in which accelerometers are specified."""
