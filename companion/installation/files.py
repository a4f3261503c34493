"""The files that a service needs, as they are shipped, and where they go.

Their one home is `systemd/` at the top of the project; a wheel carries that folder inside this package.
"""

from __future__ import annotations

import enum
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.errors import CompanionError

EXECUTABLE: Final = "/opt/companion/bin/companion"
"""As the shipped unit names it."""
SERIAL_GROUP: Final = "dialout"
"""Likewise: who may open serial ports on Debian."""

_STAMP: Final = "# Put here by `companion install-service`; sha256 of what follows: "
_STAMPED: Final = re.compile(re.escape(_STAMP).encode() + rb"([0-9a-f]{64})\n")


class Place(enum.Enum):
    """Below which folder a file goes."""

    LIBRARY = "lib"
    """`lib` of a prefix: the installation's own. What the owner changes goes to /etc (`systemctl edit`)."""
    CONFIGURATION = "etc"
    """/etc/companion: the owner's own."""


@dataclass(frozen=True, slots=True)
class Shipped:
    """One file: its name in `systemd/`, and where it goes."""

    source: str
    place: Place
    target: str


SERVICE: Final = Shipped("companion.service", Place.LIBRARY, "systemd/system/companion.service")
RULES: Final = Shipped("rules.d/70-companion.rules", Place.LIBRARY, "udev/rules.d/70-companion.rules")
MODULES: Final = Shipped("modules-load.d/companion.conf", Place.LIBRARY, "modules-load.d/companion.conf")
SAMPLE: Final = Shipped("companion.toml", Place.CONFIGURATION, "companion.toml.sample")
OURS: Final = (SERVICE, RULES, MODULES, SAMPLE)
"""What is replaced by a new version."""
CONFIGURATION: Final = Shipped("companion.toml", Place.CONFIGURATION, "companion.toml")
"""What is put there once and then belongs to the aircraft's owner."""


def folder() -> Path:
    """Where the shipped files are: inside the package of a wheel, else at the top of the checkout.

    Raises:
        CompanionError: neither is there.
    """
    here = Path(__file__).resolve().parent
    for candidate in (here / "systemd", here.parents[1] / "systemd"):
        if (candidate / SERVICE.source).is_file():
            return candidate
    raise CompanionError(f"the files of the service are not beside {here}: the installation is not complete")


def content(shipped: Shipped, *, executable: str = EXECUTABLE, serial_group: str = SERIAL_GROUP) -> bytes:
    """A shipped file as it is to be installed, without its stamp.

    Raises:
        CompanionError: it is missing, or the executable's path cannot stand in a unit.
    """
    text = (folder() / shipped.source).read_text(encoding="utf-8")
    if shipped is SERVICE:
        if not re.fullmatch(r"/[\w.+/@-]+", executable):
            raise CompanionError(f"{executable!r} cannot stand in a unit; allowed: an absolute path without spaces")
        text = text.replace(f"ExecStart={EXECUTABLE} ", f"ExecStart={executable} ")
        text = text.replace(f"={SERIAL_GROUP}\n", f"={serial_group}\n")
        text = text.replace(f"_GROUP={SERIAL_GROUP}\n", f"_GROUP={serial_group}\n")
    return text.encode()


def stamped(data: bytes) -> bytes:
    """The data behind a first line by which a later change by hand is recognised."""
    return f"{_STAMP}{hashlib.sha256(data).hexdigest()}\n".encode() + data


def without_stamp(data: bytes) -> bytes:
    """What was stamped."""
    match = _STAMPED.match(data)
    return data[match.end() :] if match is not None else data


def is_untouched(data: bytes) -> bool:
    """Whether a file is as some version of us has put it there."""
    match = _STAMPED.match(data)
    return match is not None and hashlib.sha256(data[match.end() :]).hexdigest().encode() == match[1]
