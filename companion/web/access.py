"""Rules of who may look at the page, and who may press a button.

Everybody who reaches the address may look. An action needs a token in a header that a foreign site cannot set: on the
board itself the page gets one that lives as long as its process; elsewhere a person types the token of the storage
folder, once. Against a foreign site that turns its own name into our address (DNS rebinding), the Host header may name
only addresses, "localhost" and the board's own names.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from companion.config.rules import is_address
from companion.errors import StorageError
from companion.storage.state import read_regular, write_atomically

TOKEN_HEADER: Final = "x-companion-token"  # noqa: S105 - a name
TOKEN_FILE: Final = "web-token"  # noqa: S105 - a name
# Without letters and digits that look alike on a phone in the sun; 12 of them are 59 bits.
_ALPHABET: Final = "23456789abcdefghjkmnpqrstuvwxyz"
_GROUPS, _GROUP = 3, 4
_LEAST_TOKEN: Final = _GROUPS * _GROUP
"""The least length of a token that somebody chose, without gaps and dashes."""
_MOST_TOKEN_BYTES: Final = 200
_OWN_ENDINGS: Final = ("", ".local", ".lan", ".home.arpa", ".internal")
"""Endings of names that nobody can register: what a hotspot or a router makes of the board's name."""


def split_address(bind: str) -> tuple[str, int]:
    """Split "HOST:PORT" or "[HOST]:PORT", which the configuration has checked."""
    host, _, port = bind.rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    return host == "localhost" or ipaddress.ip_address(host).is_loopback


def page_url(host: str, port: int) -> str:
    """Return the URL for a browser; an address for all networks becomes the board's name."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        host = f"{socket.gethostname().partition('.')[0]}.local"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def new_token() -> str:
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(_GROUP)) for _ in range(_GROUPS))


def kept_token(directory: Path) -> str:
    """Read the token of the storage folder; make one that only the owner can read where there is none.

    Raises:
        StorageError: it can be neither read nor made.
    """
    path = directory / TOKEN_FILE
    try:
        token = read_regular(path, _MOST_TOKEN_BYTES).decode("ascii").strip()
    except FileNotFoundError:
        token = new_token()
        write_atomically(path, f"{token}\n".encode())  # a temporary file's mode is 0600, and stays
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not a text"
        raise StorageError(f"{path}: cannot be read: {why}; as the daemon's user, or with sudo?") from None
    if (found := len(_bare(token))) < _LEAST_TOKEN:
        raise StorageError(
            f"{path}: found a token of {found} characters; allowed: at least {_LEAST_TOKEN}; remove the file, and a"
            " good one is made"
        )
    return token


def _bare(token: str) -> str:
    """Strip gaps and dashes, and lower capitals: they are a matter of keyboards."""
    return re.sub(r"[\s-]", "", token).lower()


class Access:
    """Rules of one address: the token that an action needs, and whether the page gets it by itself."""

    def __init__(self, token: str, *, handed_out: bool) -> None:
        self.token, self.handed_out = token, handed_out
        name = socket.gethostname().lower().partition(".")[0]
        self._names = {"localhost", *(name + ending for ending in _OWN_ENDINGS if name)}

    def refuses_host(self, headers: Mapping[str, str]) -> str | None:
        """Return why a request is not meant for us, in one line; None: it is."""
        host = headers.get("host", "")
        match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^:\[\]/@\s]+)(?::\d{1,5})?", host.lower())
        if match is not None:
            bare = match[1].strip("[]").removesuffix(".")
            if bare in self._names or is_address(bare):
                return None
        return f"not known here as {host[:80]!r}: use the board's address in numbers, or its own name"

    def refuses_stranger(self, headers: Mapping[str, str]) -> str | None:
        """Return why a request comes from another site's page; None: it comes from our own."""
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "asked by another site"
        origin, host = headers.get("origin"), headers.get("host", "")
        if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            return "asked by another site"
        return None

    def refuses_token(self, headers: Mapping[str, str]) -> str | None:
        """Return why no action may be started; None: one may."""
        given = _bare(headers.get(TOKEN_HEADER, ""))
        if not given:
            return "needs the token: companion web-token, on the board, shows it"
        if not secrets.compare_digest(given.encode(), _bare(self.token).encode()):
            if self.handed_out:
                return "the page was restarted: try again"
            return "wrong token: companion web-token, on the board, shows the right one"
        return None
