"""Noise profiles learned from recordings: `profiles/NAME.json` in the storage directory."""

from __future__ import annotations

import difflib
import logging
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from companion import formats
from companion.config import CATALOGUE, no_profile
from companion.config.sections import Noise
from companion.errors import ConfigError, StorageError
from companion.estimation.noise.allan import PROFILES, AllanModel, NoiseProfile, noise_profile
from companion.storage.state import UNREADABLE, named_in, read_regular, sealed, unsealed, write_atomically

logger = logging.getLogger(__name__)

FORMAT_VERSION: Final = 1
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]{0,39}")
_FILE: Final = re.compile(rf"({_NAME.pattern})\.json")


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """One recording that a profile was learned from."""

    file: str
    began_at: str | None
    """UTC, where the recording tells it."""
    still_s: float
    temperature_degc: tuple[float, float] | None
    """Lowest and highest."""


class SavedProfile(msgspec.Struct, frozen=True, kw_only=True):
    """The file."""

    format_version: int
    name: str
    saved_at: str
    imu: str
    gyro: AllanModel
    """rad/s (times sqrt(s), 1, over sqrt(s))."""
    accel: AllanModel
    """m/s^2 likewise."""
    kept_from: str
    """The profile whose figures stand for those in `kept`."""
    kept: tuple[str, ...]
    """Figures that the recordings were too short to tell."""
    sources: tuple[Source, ...]
    notes: tuple[str, ...] = ()
    warm_up: tuple[float, float] | None = None
    """By how much a warm-up moves the biases, rad/s and m/s^2; null: not learned."""

    @property
    def origin(self) -> str:
        """In words."""
        seconds, many = sum(source.still_s for source in self.sources), len(self.sources)
        recordings = f"{many} recording{'s' if many != 1 else ''}"
        return f"learned from {seconds / 3600.0:.1f} h at rest in {recordings}, saved {self.saved_at[:10]}"

    @property
    def noise(self) -> Noise:
        """As the configuration carries it."""
        return msgspec.structs.replace(_noise(self.name, self.gyro, self.accel, self.origin), warm_up=self.warm_up)

    @property
    def profile(self) -> NoiseProfile:
        """As the estimator takes it."""
        return noise_profile(self.noise)


def _noise(name: str, gyro: AllanModel, accel: AllanModel, origin: str) -> Noise:
    astuple = msgspec.structs.astuple
    return Noise(name=name, gyro=astuple(gyro), accel=astuple(accel), origin=origin)


def check_name(name: str) -> None:
    """Whether a profile may be saved under this name.

    Raises:
        StorageError: it is the catalogue's, or no name for a file; says what is allowed.
    """
    plain = re.sub(r"[-_ ]", "", name.lower())
    if plain in CATALOGUE:
        raise StorageError(f"profile {name!r}: that name is the catalogue's; allowed: another one")
    if not _NAME.fullmatch(name):
        raise StorageError(
            f"profile {name!r}: allowed: up to 40 small letters, digits, dots, dashes and underscores,"
            " a letter or digit first"
        )


class ProfileStore:
    """The folder `profiles` of a storage directory."""

    def __init__(self, directory: Path) -> None:
        self._folder = directory / "profiles"

    def path(self, name: str) -> Path:
        """The file of a profile."""
        return self._folder / f"{name}.json"

    def names(self) -> list[str]:
        """All that are there, whether they can be read or not.

        Raises:
            StorageError: the folder cannot be listed.
        """
        return named_in(self._folder, _FILE)

    def read(self, name: str) -> SavedProfile:
        """One profile.

        Raises:
            StorageError: one line: it cannot be read, is damaged, or of a newer version.
        """
        path = self.path(name)
        found = read_profile(path)
        if found.name != name:
            raise StorageError(f"{path}: not a readable profile: it is of {found.name!r}")
        return found

    def write(self, profile: SavedProfile) -> Path:
        """Keep a profile, in the place of one of that name; returns its file.

        Raises:
            StorageError: the name is not allowed, or the file could not be written.
        """
        check_name(profile.name)
        path = self.path(profile.name)
        # Nothing in it is secret, and whoever may enter the folder may run `check` on what it says.
        data = sealed(msgspec.json.format(msgspec.json.encode(profile), indent=2))
        write_atomically(path, data, mode=0o644)
        return path


def read_profile(path: Path) -> SavedProfile:
    """A profile out of a file, wherever that lies and whatever it is called.

    Raises:
        StorageError: one line: it cannot be read, is damaged, or of a newer version.
    """
    try:
        return _from_json(unsealed(read_regular(path)))
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UNREADABLE as error:
        raise StorageError(f"{path}: not a readable profile: {error}") from error


def saved_profile(directory: Path, wanted: str, *, forgiving: bool = False) -> Noise:
    """One profile as the configuration carries it.

    `forgiving`: for the daemon, which no damaged file may end: the figures of the worst common parts, and a word.

    Raises:
        ConfigError: there is none of that name; says what is allowed.
        StorageError: it cannot be read.
    """
    store = ProfileStore(directory)
    try:
        names = store.names()
        if wanted in names:
            return store.read(wanted).noise
    except StorageError as error:
        if not forgiving:
            raise StorageError(f"{wanted!r}, a saved profile: {error}") from None
        logger.warning("%s; its sigmas are those of the worst common parts", error)
        worst = PROFILES["unknown"]
        return _noise(
            wanted, worst.gyro, worst.accel, "which cannot be used: sigmas are those of the worst common parts"
        )
    raise no_profile(wanted, names)


def given_profile(wanted: str, directory: Callable[[], Path]) -> str | Noise:
    """What somebody has named: a part of the catalogue, a saved profile, or the file of one (a slash in it, or .json).

    The storage directory is only asked for where it matters.

    Raises:
        ConfigError: no such profile; says what is allowed.
        StorageError: the file cannot be read.
    """
    plain = re.sub(r"[-_ ]", "", wanted.strip().lower())
    if plain in CATALOGUE:
        return plain
    if "/" in wanted or wanted.endswith(".json"):
        return read_profile(Path(wanted)).noise
    store = ProfileStore(directory())
    names = store.names()
    if wanted in names:
        return store.read(wanted).noise
    near = difflib.get_close_matches(plain, [*CATALOGUE, *names], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ConfigError(
        f"--profile: found {wanted}; allowed: {', '.join((*CATALOGUE, *names))}, or the file of a profile"
        f" (companion profile --save){hint}"
    )


def _from_json(data: bytes) -> SavedProfile:
    found: SavedProfile = formats.decode(data, SavedProfile, FORMAT_VERSION)
    for model in (found.gyro, found.accel):
        figures = msgspec.structs.astuple(model)
        if not all(map(math.isfinite, figures)) or min(figures) < 0.0 or model.white == 0.0:
            raise ValueError(f"found N, B, K of {figures}; allowed: N above 0, none negative")
    if found.warm_up is not None and not all(0.0 < each < math.inf for each in found.warm_up):
        raise ValueError(f"found warm_up of {found.warm_up}; allowed: above 0")
    return found
