"""Access rules of the web page, for reading and for actions.

All clients that reach the page may read. An action needs a token in an HTTP header that other web sites cannot set. If
only the board itself can reach the page, the server makes a token at start and sends it to the page; otherwise a
person types the token from the storage folder once. Another site could resolve its name to our address (DNS
rebinding): therefore the Host header may contain only addresses, "localhost" and the board's own names.
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
# Alphabet of a token, without letters and digits that look alike on a phone in the sun; 12 characters have 59 bits.
_ALPHABET: Final = "23456789abcdefghjkmnpqrstuvwxyz"
_GROUPS, _GROUP = 3, 4
_LEAST_TOKEN: Final = _GROUPS * _GROUP
"""Minimum length of a token that a person has chosen, without spaces and dashes."""
_MOST_TOKEN_BYTES: Final = 200
_OWN_ENDINGS: Final = ("", ".local", ".lan", ".home.arpa", ".internal")
"""Suffixes that hotspots and routers append to the board's name; nobody can register a domain with such a suffix."""


def split_address(bind: str) -> tuple[str, int]:
    """Split "HOST:PORT" or "[HOST]:PORT" into host and port; the configuration has already checked the form."""
    host, _, port = bind.rpartition(":")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    return host == "localhost" or ipaddress.ip_address(host).is_loopback


def page_url(host: str, port: int) -> str:
    """Return the web page's URL for a browser, with the board's name instead of the addresses 0.0.0.0 and ::."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - compared, not bound
        host = f"{socket.gethostname().partition('.')[0]}.local"
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def new_token() -> str:
    return "-".join("".join(secrets.choice(_ALPHABET) for _ in range(_GROUP)) for _ in range(_GROUPS))


def stored_token(directory: Path) -> str:
    """Read the web page's token from the storage folder; if there is none, create a file that only its owner can read.

    Raises:
        StorageError: the token cannot be read or created, or is too short.
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
    """Normalise a typed token: remove spaces and dashes, and convert capital letters to small ones."""
    return re.sub(r"[\s-]", "", token).lower()


class Access:
    """Access rules of a web page: actions need `token`. `handed_out`: the server sends its token to the page."""

    def __init__(self, token: str, *, handed_out: bool) -> None:
        self.token, self.handed_out = token, handed_out
        name = socket.gethostname().lower().partition(".")[0]
        self._names = {"localhost", *(name + ending for ending in _OWN_ENDINGS if name)}

    def host_refusal(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason to refuse a request whose Host header names another host than this board; None: accept."""
        host = headers.get("host", "")
        match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^:\[\]/@\s]+)(?::\d{1,5})?", host.lower())
        if match is not None:
            bare = match[1].strip("[]").removesuffix(".")
            if bare in self._names or is_address(bare):
                return None
        return f"not known here as {host[:80]!r}: use the board's address in numbers, or its own name"

    def stranger_refusal(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason to refuse a request that another web site's page has sent; None: accept."""
        if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
            return "asked by another site"
        origin, host = headers.get("origin"), headers.get("host", "")
        if origin is not None and origin.lower() not in (f"http://{host}".lower(), f"https://{host}".lower()):
            return "asked by another site"
        return None

    def token_refusal(self, headers: Mapping[str, str]) -> str | None:
        """Return the reason to refuse an action without the right token in its headers; None: accept."""
        given = _bare(headers.get(TOKEN_HEADER, ""))
        if not given:
            return "needs the token: companion page, on the board, shows it"
        if not secrets.compare_digest(given.encode(), _bare(self.token).encode()):
            if self.handed_out:
                return "the page was restarted: try again"
            return "wrong token: companion page, on the board, shows the right one"
        return None
