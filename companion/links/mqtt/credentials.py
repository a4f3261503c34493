"""Password and certificates, read anew for every connection: what was corrected is found without a restart."""

from __future__ import annotations

import ssl
import stat
from pathlib import Path
from typing import Final

from companion.config.sections import Mqtt
from companion.errors import LinkError

MAX_PASSWORD_BYTES: Final = 4096


def read_password(settings: Mqtt) -> str | None:
    """The password, or None where none is configured.

    Raises:
        LinkError: one line that names the file and what is wrong with it.
    """
    path = settings.password_path
    if path is None:
        return None
    try:
        with path.open("rb") as file:
            content = file.read(MAX_PASSWORD_BYTES + 1)
    except OSError as error:
        raise LinkError(f"password file {path}: {_words(error)}") from None
    try:
        password = content.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        password = ""
    if not password or "\n" in password or len(content) > MAX_PASSWORD_BYTES:
        raise LinkError(f"password file {path}: wanted: the password on one line, and nothing else")
    return password


def is_open_to_all(settings: Mqtt) -> bool:
    """Whether everybody on this computer can read the password."""
    path = settings.password_path
    try:
        return path is not None and bool(path.stat().st_mode & stat.S_IROTH)
    except OSError:
        return False


def tls_context(settings: Mqtt) -> ssl.SSLContext | None:
    """What TLS needs, or None without TLS.

    Raises:
        LinkError: one line that names the file and what is wrong with it.
    """
    if not settings.tls:
        return None
    where = Path(settings.ca_file or "")
    try:
        context = ssl.create_default_context(cafile=settings.ca_file)
        if settings.cert_file is not None and settings.key_file is not None:
            where = Path(settings.key_file)
            _look(Path(settings.cert_file))
            _look(where)
            # Without a password of ours OpenSSL would ask at the terminal for that of an encrypted key.
            context.load_cert_chain(settings.cert_file, settings.key_file, password=lambda: "")
    except ssl.SSLError as error:
        what = (error.reason or str(error)).lower().replace("_", " ")
        raise LinkError(f"{where}: not usable: {what} (wanted: PEM, a key without a passphrase)") from None
    except OSError as error:
        raise LinkError(f"{error.filename or where}: {_words(error)}") from None
    return context


def _look(path: Path) -> None:
    with path.open("rb"):
        pass


def _words(error: OSError) -> str:
    return {
        FileNotFoundError: "no such file",
        PermissionError: "may not be read by this user",
        IsADirectoryError: "is a folder",
    }.get(type(error)) or (error.strerror or str(error))
