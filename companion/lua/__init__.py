"""Scripts that run on the flight controller; shipped here, installed there by its owner."""

from __future__ import annotations

from pathlib import Path
from typing import Final

ARMING_SCRIPT: Final = Path(__file__).with_name("companion_arming.lua")
"""ArduPilot's arming gate; goes to APM/scripts/companion_arming.lua on the flight controller."""

INSTALLATION: Final = (
    "save it on the flight controller as APM/scripts/companion_arming.lua (SD card or MAVFTP)",
    "set SCR_ENABLE to 1 and reboot the flight controller (ArduPilot 4.5 or later, more than 1 MB of flash)",
    'set calibration.at_arm = "gate" here; a forced arming passes by this gate (docs/arming.md)',
)
