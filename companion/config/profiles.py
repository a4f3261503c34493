"""`profile` of an IMU: a name of the catalogue, or one of the saved profiles, whose figures take its place."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

import msgspec

from companion.config.sections import Config, Noise, Profile
from companion.config.words import shown
from companion.errors import ConfigError, StorageError

CATALOGUE: Final[tuple[str, ...]] = typing.get_args(Profile)


class SavedProfiles(Protocol):
    """Profiles that are kept somewhere."""

    def names(self) -> Sequence[str]:
        """Of all of them."""

    def noise(self, name: str) -> Noise:
        """One of them.

        Raises:
            StorageError: it cannot be read, in one line.
        """

    def instead(self, name: str, error: StorageError) -> Noise | None:
        """What to take where one cannot be read; None: the configuration that names it is refused."""


Saved = Callable[[Path], SavedProfiles | None]
"""The saved profiles of a storage directory; None: they are not to be looked for, and a name stays a name."""


def with_saved_profiles(config: Config, name: str, saved: Saved | None) -> Config:
    """The configuration with the figures of saved profiles in the place of their names.

    Raises:
        ConfigError: one line that names file and key: an unknown name, or a profile that cannot be read.
    """
    imus = []
    for index, imu in enumerate(config.imu):
        key = f"{name}: 'imu[{index}].profile': found"
        if isinstance(imu.profile, Noise):
            raise ConfigError(f"{key} a table; allowed: {_allowed(())}")
        if imu.profile is not None and imu.profile not in CATALOGUE:
            if saved is None:
                raise _unknown(imu.profile, (), key)
            if (store := saved(config.storage.path)) is not None:
                imu = msgspec.structs.replace(imu, profile=_found(store, imu.profile, key))
        imus.append(imu)
    return msgspec.structs.replace(config, imu=imus)


def _found(store: SavedProfiles, wanted: str, key: str) -> Noise:
    try:
        names = store.names()
        if wanted in names:
            return store.noise(wanted)
    except StorageError as error:
        if (instead := store.instead(wanted, error)) is not None:
            return instead
        raise ConfigError(f"{key} {wanted!r}, a saved profile: {error}") from None
    raise _unknown(wanted, names, key)


def _unknown(wanted: str, names: Sequence[str], key: str) -> ConfigError:
    near = difflib.get_close_matches(wanted, [*CATALOGUE, *names], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return ConfigError(f"{key} {shown(wanted)}; allowed: {_allowed(names)}{hint}")


def _allowed(names: Sequence[str]) -> str:
    known = ", ".join(f'"{each}"' for each in (*CATALOGUE, *sorted(names)))
    return f"{known}, or one that companion profile --save has saved"
