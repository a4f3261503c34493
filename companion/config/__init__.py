"""Configuration: parser of the TOML file, with a one-line error for every mistake.

The parser converts the file to frozen structures with units in their field names. An unknown key is an error that
suggests the nearest known key: a misspelt limit must not silently become the default.
"""

from __future__ import annotations

import difflib
import tomllib
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from companion.config.rules import check_together
from companion.config.sections import Config, NoiseProfile, Profile
from companion.config.words import brief, explain, refuse_unknown_keys, shown
from companion.errors import ConfigError, StorageError

DEFAULT_PATH = Path("/etc/companion/companion.toml")
MOST_BYTES: Final = 64 * 1024
"""Maximum size of a configuration file: nine times the sample file, which contains every key."""
MOST_LINE: Final = 4096
"""Maximum number of characters in a line: the time to parse a TOML key grows with the square of its number of dots."""
CATALOGUE: Final[tuple[str, ...]] = typing.get_args(Profile)
_Kind = typing.TypeVar("_Kind", bound=msgspec.Struct)

Saved = Callable[[Path, str], NoiseProfile | str]
"""Function that loads a saved noise profile by storage directory and name, or returns just the name.

Raises:
    ConfigError, StorageError: there is no such profile, or it cannot be read; callers show the text after "found".
"""


def no_profile(wanted: str, names: Sequence[str] = ()) -> ConfigError:
    near = difflib.get_close_matches(wanted, [*CATALOGUE, *names], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return ConfigError(f"{shown(wanted)}; allowed: {_allowed(names)}{hint}")


def _none(_directory: Path, wanted: str) -> NoiseProfile:
    raise no_profile(wanted)


def load(path: Path, saved: Saved = _none) -> Config:
    """Read and check a configuration file; raise ConfigError with a one-line text if it cannot be used."""
    text = read(path, "companion setup makes it (or give another with -c FILE)")
    return parse(text, str(path), saved)


def read(path: Path, missing: str) -> str:
    """Read the text of a file; raise ConfigError if it cannot be read. `missing`: remedy if there is no such file."""
    try:
        with path.open("rb") as file:
            return file.read(MOST_BYTES + 1).decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file: {missing}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def parse(text: str, name: str, saved: Saved = _none) -> Config:
    """Parse and check the text of a configuration file; error texts call the file `name`.

    Raises:
        ConfigError: one line that names the file, the key, the value found and the allowed values.
    """
    config = converted(text, name, Config)
    check_together(config, name)
    return _with_saved_profiles(config, name, saved)


def converted(text: str, name: str, kind: type[_Kind]) -> _Kind:
    """Parse the text of a file without checking keys against each other; raise ConfigError for a wrong key or value."""
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{name}: found more than {MOST_BYTES} bytes; allowed: a configuration file")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > MOST_LINE:
            raise ConfigError(f"{name}: line {number}: found {len(line)} characters; allowed: {MOST_LINE}")
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: brackets within brackets, too deep") from None
    except ValueError as error:  # also raised by Python for a number with thousands of digits
        raise ConfigError(f"{name}: not valid TOML: {brief(str(error))}") from None
    refuse_unknown_keys(raw, kind, "", name)
    try:
        return msgspec.convert(raw, kind, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {explain(str(error), raw)}") from None


def _with_saved_profiles(config: Config, name: str, saved: Saved) -> Config:
    imus = []
    for index, imu in enumerate(config.imu):
        key = f"{name}: 'imu[{index}].profile': found"
        if isinstance(imu.profile, NoiseProfile):
            raise ConfigError(f"{key} a table; allowed: {_allowed(())}")
        if imu.profile is not None and imu.profile not in CATALOGUE:
            try:
                imu = msgspec.structs.replace(imu, profile=saved(config.storage.path, imu.profile))
            except (ConfigError, StorageError) as error:
                raise ConfigError(f"{key} {error}") from None
        imus.append(imu)
    return msgspec.structs.replace(config, imu=imus)


def _allowed(names: Sequence[str]) -> str:
    known = ", ".join(f'"{each}"' for each in (*CATALOGUE, *sorted(names)))
    return f"{known}, or one that companion log profile --save has saved"
