"""The configuration: what may be set, what it means, and one clear line for every mistake.

A TOML file becomes frozen structures with units in their names. Unknown keys are errors (with the nearest known
key), so that a misspelt limit is never silently a default.
"""

from __future__ import annotations

import difflib
import tomllib
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Protocol

import msgspec

from companion.config.rules import check_together
from companion.config.sections import Config, Noise, Profile
from companion.config.words import brief, explain, refuse_unknown_keys, shown
from companion.errors import ConfigError, StorageError

DEFAULT_PATH = Path("/etc/companion/companion.toml")
MOST_BYTES: Final = 64 * 1024
"""The longest configuration file; the sample, which has every key, is a ninth of that."""
MOST_LINE: Final = 4096
"""The most characters of a line: the time that TOML takes for a key grows with the square of its dots."""
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


def load(path: Path, saved: Saved | None = None) -> Config:
    """Read and check a configuration file; `saved` says where saved noise profiles are.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES + 1).decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file: companion setup makes it (or give another with -c FILE)") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return parse(text, str(path), saved)


def parse(text: str, name: str, saved: Saved | None = None) -> Config:
    """Check the text of a configuration file; `name` stands for the file in messages, `saved` as for `load`.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{name}: found more than {MOST_BYTES} bytes; allowed: a configuration file")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > MOST_LINE:
            raise ConfigError(f"{name}: line {number}: found {len(line)} characters; allowed: {MOST_LINE}")
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: brackets within brackets, too deep") from None
    except ValueError as error:  # TOML's own errors, and what Python says of a number with thousands of digits
        raise ConfigError(f"{name}: not valid TOML: {brief(str(error))}") from None
    refuse_unknown_keys(raw, Config, "", name)
    try:
        config = msgspec.convert(raw, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {explain(str(error), raw)}") from None
    check_together(config, name)
    return _with_saved_profiles(config, name, saved)


def _with_saved_profiles(config: Config, name: str, saved: Saved | None) -> Config:
    """The configuration with the figures of saved profiles in the place of their names."""
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
