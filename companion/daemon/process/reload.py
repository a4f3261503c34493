"""SIGHUP: the configuration file is read again, and what can change in flight-line use changes at once.

Only keys that the file itself has changed count: what a ground station has set meanwhile (CMP_*) stays. What cannot
change while the daemon runs is named, and stays what it was until a restart. A file with a mistake changes nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from companion.config import load
from companion.config.sections import Config
from companion.config.senders import Senders
from companion.config.words import shown
from companion.daemon.faces.flight_line import AT_ARM
from companion.daemon.offload import Offload
from companion.daemon.process.service import Service
from companion.errors import ConfigError
from companion.storage.profiles import ProfileStore

logger = logging.getLogger(__name__)

Apply = Callable[[Service, Any], None]


def _stop_rivals(service: Service, value: bool) -> None:  # noqa: FBT001 - as all in the table
    service.offsets.rivalry.switch(stop_rivals=value)


def _allow(service: Service, value: tuple[str, ...]) -> None:
    service.faces.component.permission.allow(Senders(value))


def _log_level(_service: Service, value: str) -> None:
    logging.getLogger().setLevel(value.upper())


def _parameter(name: str, number: Callable[[Any], float] = float) -> Apply:
    """Of what a ground station can set as well: as if it had."""

    def apply(service: Service, value: Any) -> None:
        try:
            service.faces.component.parameters.change(name, number(value))
        except ValueError as error:
            logger.warning("%s; ground stations see the old value", error)

    return apply


RELOADABLE: Final[Mapping[str, Apply]] = {
    "calibration.target_gyro_sigma_deg_h": _parameter("CMP_GYR_TGT"),
    "calibration.target_accel_sigma_mg": _parameter("CMP_ACC_TGT"),
    "calibration.at_arm": _parameter("CMP_AT_ARM", AT_ARM.index),
    "push.parameters": _parameter("CMP_PUSH"),
    "push.stop_rivals": _stop_rivals,
    "mavlink.allow": _allow,
    "log.level": _log_level,
}
"""What can change without a restart, and how."""


class Reloader:
    """Reads the file again and applies it."""

    def __init__(self, service: Service, path: Path, offload: Offload) -> None:
        self._service, self._path, self._offload = service, path, offload
        self._in_force = flat(service.config)

    async def reload(self) -> str:
        """Apply what the file says now; what came of it in one line, empty when all of it is in force."""
        try:
            new = flat(await self._offload(load, self._path, ProfileStore))
        except ConfigError as error:
            logger.error("reload refused, the old configuration stays in force: %s", error)  # noqa: TRY400 - one line
            return f"reload refused: {error}"
        missing = object()
        old = self._in_force
        changed = [key for key in {**old, **new} if old.get(key, missing) != new.get(key, missing)]
        applied = [key for key in changed if key in RELOADABLE]
        for key in applied:
            RELOADABLE[key](self._service, new[key])
            logger.info("reloaded %s: %s = %s (was %s)", self._path, key, shown(new[key]), shown(old[key]))
            old[key] = new[key]
        rest = [key for key in changed if key not in RELOADABLE]
        if rest:
            words = f"restart to change {', '.join(rest)}"
            logger.warning("reloaded %s: %s (systemctl restart companion)", self._path, words)
            return words
        if not applied:
            logger.info("reloaded %s: nothing has changed", self._path)
        return ""


def flat(config: Config) -> dict[str, Any]:
    """Every setting by its key: `section.key`; a list of tables, or a section that is absent, is one setting."""
    found: dict[str, Any] = {}
    for section in config.__struct_fields__:
        value = getattr(config, section)
        if isinstance(value, msgspec.Struct):
            found.update({f"{section}.{key}": getattr(value, key) for key in value.__struct_fields__})
        elif value is not None:
            found[section] = value
    return found
