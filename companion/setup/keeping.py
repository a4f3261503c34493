"""The configuration file on disk: what is there, and how another content takes its place without losing the old one."""

from __future__ import annotations

import itertools
import os
import stat
from pathlib import Path

from companion import config
from companion.errors import ConfigError
from companion.installation import install as installing
from companion.setup.draft import Draft
from companion.storage.state import read_regular, write_atomically


def sample() -> str:
    """The sample configuration that this companion brings."""
    return installing.content(installing.SAMPLE).decode()


def begin(path: Path) -> Draft:
    """Load the configuration, or the sample where there is none; raise ConfigError where it cannot be used."""
    try:
        text = read_regular(path, config.MOST_BYTES).decode()
    except FileNotFoundError:
        return Draft(sample(), is_new=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if text == sample():
        return Draft(text, is_new=True)
    config.parse(text, str(path), lambda _, name: name)
    return Draft(text, is_new=False)


def is_writable(path: Path) -> bool:
    """Whether the file may be written, or made."""
    folder = path.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def holds(path: Path, text: str) -> bool:
    """Whether the file is there and says just this."""
    try:
        return read_regular(path, config.MOST_BYTES) == text.encode()
    except OSError:
        return False


def put(path: Path, text: str) -> Path | None:
    """Write the file atomically, keep the old one beside it, and return that path; None where nobody owned it."""
    # What is behind a link is replaced, not the link.
    path = path.resolve()
    kept, mode = None, installing.MODE
    if path.exists() and not holds(path, sample()):
        mode = stat.S_IMODE(path.stat().st_mode)
        names = (path.with_name(f"{path.name}.old{number}") for number in itertools.count(1))
        kept = next(name for name in names if not name.exists())
        write_atomically(kept, path.read_bytes(), mode=mode)
    write_atomically(path, text.encode(), mode=mode, parents=True)
    return kept
