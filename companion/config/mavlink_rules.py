"""The rules of who may ask and of signing, in the section [mavlink]."""

from __future__ import annotations

from companion.config.sections import Mavlink
from companion.config.senders import ALLOWED, Senders
from companion.errors import ConfigError


def check_access(mavlink: Mavlink, name: str) -> None:
    """Check `allow`, `signing` and `signing_key_file`.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    for entry in mavlink.allow:
        try:
            Senders([entry])
        except ValueError:
            raise ConfigError(f"{name}: 'mavlink.allow': found {entry!r}; allowed: {ALLOWED}") from None
    path = mavlink.signing_key_file
    if mavlink.signing in ("sign", "require") and path is None:
        raise ConfigError(
            f"{name}: 'mavlink.signing_key_file' is missing; allowed: a text, not empty (needed by signing ="
            f' "{mavlink.signing}")'
        )
    if path is not None and "/" in path and not path.startswith("/"):
        raise ConfigError(
            f"{name}: 'mavlink.signing_key_file': found {path!r}; allowed: a path that begins with /, or the bare name"
            " of a systemd credential"
        )
