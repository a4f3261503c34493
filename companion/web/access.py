"""Access rules of the web page: for reading, and for actions.

All clients that reach the address may read. An action needs a token in a header that a foreign site cannot set. On the
board itself the page gets a token that is valid for the life of its process; elsewhere a person types the token of the
storage folder, once. Against a foreign site that resolves its own name to our address (DNS rebinding), the Host header
may name only addresses, "localhost" and the board's own names.
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
# Without letters and digits that look alike on a phone in the sun; 12 characters have 59 bits.
_ALPHABET: Final = "23456789abcdefghjkmnpqrstuvwxyz"
_GROUPS, _GROUP = 3, 4
_LEAST_TOKEN: Final = _GROUPS * _GROUP
"""Least length of a token that a person chose, without spaces and dashes."""
_MOST_TOKEN_BYTES: Final = 200
_OWN_ENDINGS: Final = ("", ".local", ".lan", ".home.arpa", ".internal")
"""Endings that a hotspot or a router appends to the board's name; names with them cannot be registered."""


def split_address(bind: str) -> tuple[str, int]:
    """Split "HOST:PORT" or "[HOST]:PORT", already checked by the configuration."""
    host, _, port = bind.rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    return host == "localhost" or ipaddress.ip_address(host).is_loopback


def page_url(host: str, port: int) -> str:
    """Return the URL for a browser; an address for all networks is replaced by the board's name."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        host = f"{socket.gethostname().partition('.')[0]}.local"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def new_token() -> str:
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(_GROUP)) for _ in range(_GROUPS))


def kept_token(directory: Path) -> str:
    """Read the token of the storage folder; if there is none, make one that only the owner can read.

    Raises:
        StorageError: the token can be neither read nor made.
    """
    path = directory / TOKEN_FILE
    try:
        token = read_regular(path, _MOST_TOKEN_BYTES).decode("ascii").strip()
    except FileNotFoundError:
        token = new_token()
        write_atomically(path, f"{token}\n".encode())  # with mode 0600
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
    """Remove spaces and dashes, and lower capitals: they depend on the keyboard."""
    return re.sub(r"[\s-]", "", token).lower()


class Access:
    """Rules of one address: the token that an action needs, and whether the page gets the token automatically."""

    def __init__(self, token: str, *, handed_out: bool) -> None:
        self.token, self.handed_out = token, handed_out
        name = socket.gethostname().lower().partition(".")[0]
        self._names = {"localhost", *(name + ending for ending in _OWN_ENDINGS if name)}

    def refuses_host(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason why a request's Host is not ours, in one line; None: it is ours."""
        host = headers.get("host", "")
        match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^:\[\]/@\s]+)(?::\d{1,5})?", host.lower())
        if match is not None:
            bare = match[1].strip("[]").removesuffix(".")
            if bare in self._names or is_address(bare):
                return None
        return f"not known here as {host[:80]!r}: use the board's address in numbers, or its own name"

    def refuses_stranger(self, headers: Mapping[str, str]) -> str | None:
        """Return the evidence that a request comes from another site's page; None: it comes from our own."""
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "asked by another site"
        origin, host = headers.get("origin"), headers.get("host", "")
        if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            return "asked by another site"
        return None

    def refuses_token(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason why the token allows no action; None: it is right."""
        given = _bare(headers.get(TOKEN_HEADER, ""))
        if not given:
            return "needs the token: companion web-token, on the board, shows it"
        if not secrets.compare_digest(given.encode(), _bare(self.token).encode()):
            if self.handed_out:
                return "the page was restarted: try again"
            return "wrong token: companion web-token, on the board, shows the right one"
        return None
