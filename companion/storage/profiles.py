"""Noise profiles learned from recordings: `profiles/NAME.json` in the storage directory.

Functions raise StorageError, in one line, if a file cannot be read or written.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from companion import formats
from companion.config import CATALOGUE, no_profile
from companion.config.sections import AllanModel, NoiseProfile
from companion.errors import ConfigError, StorageError
from companion.estimation.noise.allan import PROFILES
from companion.messages import message
from companion.storage.state import UNREADABLE, file_error, named_in, read_regular, sealed, unsealed, write_atomically

logger = logging.getLogger(__name__)

FORMAT_VERSION: Final = 1
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]{0,39}")
_FILE: Final = re.compile(rf"({_NAME.pattern})\.json")


class ProfileSource(msgspec.Struct, frozen=True, kw_only=True):
    """One recording from which a noise profile was learned."""

    file: str
    began_at: str | None  # UTC; None: not in the recording
    still_s: float
    temperature_degc: tuple[float, float] | None  # lowest and highest; None: unknown


class SavedProfile(msgspec.Struct, frozen=True, kw_only=True):
    """Content of the file of a noise profile."""

    format_version: int
    name: str
    saved_at: str
    imu: str
    gyro: AllanModel
    accel: AllanModel
    kept_from: str  # profile from which the figures listed in `kept` were copied
    kept: tuple[str, ...]  # figures that could not be estimated, because the recordings were too short
    sources: tuple[ProfileSource, ...]
    notes: tuple[str, ...] = ()
    warm_up: tuple[float, float] | None = None
    """Two-sigma bias change during warm-up, of gyro (rad/s) and accelerometer (m/s^2); None: unknown."""

    @property
    def profile(self) -> NoiseProfile:
        seconds, many = sum(source.still_s for source in self.sources), len(self.sources)
        recordings = f"{many} recording{'s' if many != 1 else ''}"
        origin = f"learned from {seconds / 3600.0:.1f} h at rest in {recordings}, saved {self.saved_at[:10]}"
        return NoiseProfile(self.name, self.gyro, self.accel, origin, self.warm_up)


def check_name(name: str) -> None:
    """Raise StorageError if a new profile's name is in the built-in catalogue or not allowed as a file name."""
    if _plain(name) in CATALOGUE or not _NAME.fullmatch(name):
        raise StorageError(message("profile_name_not_allowed", name=repr(name)))


def _plain(name: str) -> str:
    return re.sub(r"[-_ ]", "", name.strip().lower())


class ProfileStore:
    def __init__(self, directory: Path) -> None:
        self._folder = directory / "profiles"

    def path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

    def names(self) -> list[str]:
        """List the names of all saved profiles, including unreadable ones; raises StorageError."""
        return named_in(self._folder, _FILE)

    def read(self, name: str) -> SavedProfile:
        """Read one saved profile; raises StorageError in one line."""
        path = self.path(name)
        found = read_profile(path)
        if found.name != name:
            raise file_error(path, "used", f"it is of {found.name!r}")
        return found

    def write(self, profile: SavedProfile) -> Path:
        """Save a profile, replacing one of the same name; return its file. Raises StorageError."""
        check_name(profile.name)
        path = self.path(profile.name)
        # Readable for all: a profile is not secret, and any user of the folder may run `check` with it.
        data = sealed(msgspec.json.format(msgspec.json.encode(profile), indent=2))
        write_atomically(path, data, mode=0o644)
        return path


def read_profile(path: Path) -> SavedProfile:
    """Read a profile from any file; raise StorageError for a damaged file or a newer version."""
    try:
        found: SavedProfile = formats.decode(unsealed(read_regular(path)), SavedProfile, FORMAT_VERSION)
        for model in (found.gyro, found.accel):
            figures = msgspec.structs.astuple(model)
            if not all(0.0 <= each < math.inf for each in figures) or model.white == 0.0:
                raise ValueError(f"found N, B, K of {figures}; allowed: N above 0, none negative")
        if found.warm_up is not None and not all(0.0 < each < math.inf for each in found.warm_up):
            raise ValueError(f"found warm_up of {found.warm_up}; allowed: above 0")
    except (OSError, *UNREADABLE) as error:
        raise file_error(path, "used", error) from error
    return found


def saved_profile(directory: Path, wanted: str, *, forgiving: bool = False) -> NoiseProfile:
    """Read the saved profile that the configuration names.

    `forgiving`, for the daemon: replace an unusable profile by the noise of the worst common IMUs, with a warning.
    Raises ConfigError if there is no such profile, StorageError if it cannot be read.
    """
    store = ProfileStore(directory)
    try:
        names = store.names()
        if wanted in names:
            return store.read(wanted).profile
    except StorageError as error:
        if not forgiving:
            raise StorageError(f"{wanted!r}, a saved profile: {error}") from None
        logger.warning("%s", message("profile_replaced", reason=error))
        origin = message("profile_replaced", reason="its saved profile cannot be used")
        return msgspec.structs.replace(PROFILES["unknown"], name=wanted, origin=origin)
    raise no_profile(wanted, names)


def given_profile(wanted: str, directory: Callable[[], Path]) -> str | NoiseProfile:
    """Find the noise profile that `wanted` names: an IMU in the catalogue, a saved profile, or a file (/ or .json).

    `directory` is called only for a saved profile. Raises ConfigError if there is no such profile, StorageError for a
    damaged file.
    """
    if (plain := _plain(wanted)) in CATALOGUE:
        return plain
    if "/" in wanted or wanted.endswith(".json"):
        return read_profile(Path(wanted)).profile
    try:
        return saved_profile(directory(), wanted)
    except ConfigError as error:
        raise ConfigError(f"--profile: found {error}") from None
