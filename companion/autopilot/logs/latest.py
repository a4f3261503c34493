"""Where each firmware keeps its logs, and which of them is the latest."""

from __future__ import annotations

from typing import Final

from companion.autopilot.logs.blocks import BLOCK_BYTES
from companion.autopilot.logs.ftp import FileClient
from companion.autopilot.vehicle.vehicle import Firmware
from companion.errors import AutopilotError

_ARDUPILOT: Final = ("/APM/LOGS", "/logs", "/var/lib/ardupilot/logs", "/SDCARD/APM/LOGS")
"""HAL_BOARD_LOG_DIRECTORY: flight controllers, SITL, Linux, ESP32."""
_PX4: Final = ("@MAV_LOG", "/fs/microsd/log", "/log")
"""From 1.17 on by the name of the protocol; before that, flight controllers and SITL."""
_NONE: Final = "no log on the autopilot: has it a card, and does it log?"


async def find(files: FileClient, firmware: Firmware | None, wanted: str | None) -> str:
    """The path of a log on the autopilot: the one of that name or number, else the latest.

    Raises:
        AutopilotError: it has none, or does not answer.
    """
    return await (_of_px4(files, wanted) if firmware == "px4" else _of_ardupilot(files, wanted))


async def _of_ardupilot(files: FileClient, wanted: str | None) -> str:
    """LASTLOG.TXT has the number of the latest: numbers begin anew at LOG_MAX_FILES."""
    for folder in _ARDUPILOT:
        if await files.open(f"{folder}/LASTLOG.TXT") is None:
            continue
        number = (await files.read(0, BLOCK_BYTES)).decode("ascii", "replace").strip().rstrip("D")
        wanted = number if wanted is None else wanted
        return f"{folder}/{int(wanted):08d}.BIN" if wanted.isdecimal() else f"{folder}/{wanted}"
    raise AutopilotError(_NONE)


async def _of_px4(files: FileClient, wanted: str | None) -> str:
    """Folders are dates, or sess001, ... where the time was not known when a log began."""
    for root in _PX4:
        found = await files.entries(root)
        if found is None:
            continue
        if wanted is not None:
            return f"{root}/{wanted}"
        numbered = [name for name in found[0] if name.startswith("sess")]
        dated = [name for name in found[0] if name not in numbered]
        logs = []
        for order, names in enumerate((numbered, dated)):
            if names:
                folder = f"{root}/{max(names, key=lambda name: (len(name), name))}"
                _, inside = await files.entries(folder) or ([], [])
                logs += [(each.unix_s, order, f"{folder}/{each.name}") for each in inside if ".ulg" in each.name]
        if logs:
            return max(logs)[-1]
    raise AutopilotError(_NONE)
