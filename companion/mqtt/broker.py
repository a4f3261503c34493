"""Credentials for the broker, and its refusals in words.

Password and certificates are read for every connection, so that a correction needs no restart.
"""

from __future__ import annotations

import os
import socket
import ssl
import stat
from pathlib import Path
from typing import Final

from companion.config.sections import Mqtt
from companion.errors import LinkError

MAX_PASSWORD_BYTES: Final = 4096


def read_password(settings: Mqtt) -> str | None:
    """Read the password; None: none is configured.

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
        raise LinkError(f"password file {path}: {_why(error)}") from None
    try:
        password = content.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        password = ""
    if not password or "\n" in password or len(content) > MAX_PASSWORD_BYTES:
        raise LinkError(f"password file {path}: wanted: the password on one line, and nothing else")
    return password


def is_open_to_all(settings: Mqtt) -> bool:
    """Return whether everybody on this computer can read the password."""
    path = settings.password_path
    try:
        return path is not None and bool(path.stat().st_mode & stat.S_IROTH)
    except OSError:
        return False


def tls_context(settings: Mqtt) -> ssl.SSLContext | None:
    """Make the TLS context; None: without TLS.

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
            for file in (settings.cert_file, settings.key_file):
                Path(file).open("rb").close()  # OpenSSL does not say which of them it cannot read
            # Without a password of ours OpenSSL would ask at the terminal for that of an encrypted key.
            context.load_cert_chain(settings.cert_file, settings.key_file, password=lambda: "")
    except ssl.SSLError as error:
        what = (error.reason or str(error)).lower().replace("_", " ")
        raise LinkError(f"{where}: not usable: {what} (wanted: PEM, a key without a passphrase)") from None
    except OSError as error:
        raise LinkError(f"{error.filename or where}: {_why(error)}") from None
    return context


def _why(error: OSError) -> str:
    return {
        FileNotFoundError: "no such file",
        PermissionError: "may not be read by this user",
        IsADirectoryError: "is a folder",
    }.get(type(error)) or (error.strerror or str(error))


UNSUPPORTED_PROTOCOL: Final = 132
"""Reason codes of MQTT 5 (its section 2.4); paho turns those of MQTT 3.1.1 into the same."""
_BAD_PASSWORD: Final = (134, 135)
_CLIENT_ID: Final = 133
_UNAVAILABLE: Final = (136, 137)
_SHUTTING_DOWN: Final = 139
_TAKEN_OVER: Final = 142
_LOST: Final = (7, 128)
"""Codes of a lost connection: paho's own, and that of MQTT 5."""
_SILENT: Final = (16, 141)
"""Codes of silence for twice the keepalive: paho's own, and that of MQTT 5."""


def causes(error: BaseException) -> list[BaseException]:
    """List an error and its causes, outermost first; of a group, the first member's."""
    found: list[BaseException] = []
    inner: BaseException | None = error
    while inner is not None and inner not in found:
        if isinstance(inner, BaseExceptionGroup):
            inner = inner.exceptions[0]
            continue
        found.append(inner)
        inner = inner.__cause__ or inner.__context__
    return found


def reason_code(error: BaseException) -> int | None:
    """Return the reason code of the broker (or paho), if there is one."""
    for cause in causes(error):
        code = getattr(cause, "rc", None)
        if code is not None:
            return int(getattr(code, "value", code))
    return None


def is_of_protocol(error: BaseException) -> bool:
    """Return whether the broker may lack the version of MQTT that was tried."""
    return reason_code(error) == UNSUPPORTED_PROTOCOL or _is_unanswered(error)


def _is_unanswered(error: BaseException) -> bool:
    """Return whether the connection was accepted and then silent (aiomqtt has no type for it)."""
    return any(str(cause) == "Operation timed out" for cause in causes(error))


def explain(error: BaseException, settings: Mqtt, client_id: str, *, reached: bool) -> str:
    """Say in one line why there is no connection, without the address; `reached`: there was one."""
    code = reason_code(error)
    if code is not None:
        return _of_code(code, error, settings, client_id)
    hint = " (does it want tls = true?)"
    if settings.tls:
        hint = " (does it want a certificate? mqtt.cert_file)" if settings.cert_file is None else ""
    if _is_unanswered(error):
        return "the broker does not answer any more" if reached else f"what listens there says nothing{hint}"
    for cause in causes(error):
        if isinstance(cause, LinkError):
            return str(cause)
        if isinstance(cause, OSError) and (words := _of_system(cause, settings)):
            return words
    return str(error) or type(error).__name__


def _of_code(code: int, error: BaseException, settings: Mqtt, client_id: str) -> str:
    if code in _BAD_PASSWORD:
        if settings.username is None:
            return "the broker asks for a user (mqtt.username, mqtt.password_file)"
        return f"the broker refuses user {settings.username!r}: unknown, or the password is wrong"
    if code == _TAKEN_OVER:
        return (
            f"another client called {client_id!r} has taken over: is there a second companion for this vehicle?"
            " (mqtt.base_topic tells them apart)"
        )
    words = {
        UNSUPPORTED_PROTOCOL: "the broker speaks neither MQTT 5 nor 3.1.1",
        _CLIENT_ID: f"the broker refuses the client id {client_id!r} (mqtt.client_id)",
        _SHUTTING_DOWN: "the broker shuts down",
        **dict.fromkeys(
            _LOST, f"the connection is gone (broker stopped? network? another client called {client_id!r}?)"
        ),
        **dict.fromkeys(_SILENT, "nothing heard from the broker any more"),
        **dict.fromkeys(_UNAVAILABLE, "the broker is not available now"),
    }
    return words.get(code) or f"the broker says: {causes(error)[-1]}"


def _of_system(error: OSError, settings: Mqtt) -> str | None:
    if isinstance(error, ssl.SSLCertVerificationError):
        trusted = settings.ca_file or "the system's authorities; mqtt.ca_file names another"
        return f"the broker's certificate is not trusted: {error.verify_message} (by {trusted})"
    if isinstance(error, ssl.SSLError):
        return f"TLS fails: {(error.reason or str(error)).lower().replace('_', ' ')}"
    if isinstance(error, socket.gaierror):
        return f"host {settings.host} is not known"
    if isinstance(error, TimeoutError):
        return "no answer"
    if isinstance(error, ConnectionRefusedError):
        return "nobody listens there (is the broker running?)"
    return os.strerror(error.errno).lower() if error.errno else None
