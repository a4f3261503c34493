"""Connection to an MQTT broker by the library aiomqtt 2: credentials, TLS, MQTT version, and texts for errors.

Only this module and mqtt/client.py use aiomqtt, because its version 3 will be a different library.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import ssl
import stat
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion.config.sections import Mqtt
from companion.errors import CompanionError, LinkError
from companion.messages import message

if TYPE_CHECKING:
    import aiomqtt

logger = logging.getLogger(__name__)
_quiet = logging.getLogger(f"{__name__}.aiomqtt")
# aiomqtt logs its errors and raises them too: we log them only once, as text for people.
_quiet.setLevel(logging.CRITICAL)

MQTT_3_1_1: Final = 4
MQTT_5: Final = 5
MAX_PASSWORD_BYTES: Final = 4096
_LEAST_REFUSAL_CODE: Final = 128


class Broker:
    """Broker to which one client connects, by the newest version of MQTT that the broker supports.

    MQTT 5 is tried first: only MQTT 5 marks messages that were published as retained, and lets a client limit the
    length of messages. Credentials are read for every connection, so that a correction needs no restart.
    """

    def __init__(self, settings: Mqtt, client_id: str) -> None:
        self.settings, self.client_id = settings, client_id
        self.where = f"{settings.host}:{settings.broker_port}"
        self.protocol = MQTT_5
        if is_open_to_all(settings):
            words = "mqtt: password file %s: everybody on this computer can read it (chmod o-r)"
            logger.warning(words, settings.password_path)

    @contextlib.asynccontextmanager
    async def connected(self, most_bytes: int, **options: Any) -> AsyncIterator[aiomqtt.Client]:
        """Connect until the context ends; `most_bytes`: longest packet that the broker may send (MQTT 5 only).

        Raises:
            LinkError: the connection failed or ended, with the cause.
        """
        import aiomqtt

        reached = False
        try:
            client = await self._connect(most_bytes, options)
            reached = True
            try:
                yield client
            finally:
                # An error of the disconnection must not replace a cancellation.
                with contextlib.suppress(aiomqtt.MqttError, OSError):
                    await client.__aexit__(None, None, None)
        except CompanionError:
            raise
        except (aiomqtt.MqttError, OSError, UnicodeError, ExceptionGroup) as error:
            if any(isinstance(cause, MemoryError) for cause in causes(error)):
                raise MemoryError from error
            logger.debug("mqtt", exc_info=error)
            raise LinkError(
                f"{self.where}: {explain(error, self.settings, self.client_id, reached=reached)}"
            ) from error

    async def _connect(self, most_bytes: int, options: dict[str, Any]) -> aiomqtt.Client:
        import aiomqtt

        password = await asyncio.to_thread(read_password, self.settings)
        context = await asyncio.to_thread(tls_context, self.settings)
        while True:
            client = self._client(most_bytes, password=password, tls_context=context, **options)
            try:
                return await client.__aenter__()
            except aiomqtt.MqttError as error:
                before, self.protocol = self.protocol, MQTT_5
                # A broker without MQTT 5 refuses it, is silent, or closes the connection.
                if before != MQTT_5 or not (_reason_code(error) == UNSUPPORTED_PROTOCOL or _is_unanswered(error)):
                    raise
                self.protocol = MQTT_3_1_1

    def _client(self, most_bytes: int, **options: Any) -> aiomqtt.Client:
        import aiomqtt
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = None
        if self.protocol == MQTT_5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.MaximumPacketSize = most_bytes
        return aiomqtt.Client(
            self.settings.host,
            self.settings.broker_port,
            identifier=self.client_id,
            username=self.settings.username,
            protocol=aiomqtt.ProtocolVersion(self.protocol),
            clean_session=True if properties is None else None,
            keepalive=self.settings.keepalive_s,
            properties=properties,
            logger=_quiet,
            **options,
        )


async def subscribe(client: aiomqtt.Client, topic: str, **options: Any) -> None:
    """Subscribe to a topic; raise LinkError if the broker refuses it."""
    granted = await client.subscribe(topic, **options)
    if any(getattr(code, "value", code) >= _LEAST_REFUSAL_CODE for code in granted):
        raise LinkError(message("broker_refuses", what=f"topic {topic} (its access list?)"))


def read_password(settings: Mqtt) -> str | None:
    """Read the broker's password from its file; return None if no file is configured.

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
        raise LinkError(message("path_not_usable", path=f"password file {path}", reason=_words(error))) from None
    try:
        password = content.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        password = ""
    if not password or "\n" in password or len(content) > MAX_PASSWORD_BYTES:
        reason = "wanted: the password on one line, and nothing else"
        raise LinkError(message("path_not_usable", path=f"password file {path}", reason=reason))
    return password


def is_open_to_all(settings: Mqtt) -> bool:
    path = settings.password_path
    try:
        return path is not None and bool(path.stat().st_mode & stat.S_IROTH)
    except OSError:
        return False


def tls_context(settings: Mqtt) -> ssl.SSLContext | None:
    """Make the TLS context for the broker; return None if TLS is not configured.

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
                Path(file).open("rb").close()  # OpenSSL does not name the file that it cannot read
            # Without a password argument OpenSSL would ask for the password of an encrypted key at the terminal.
            context.load_cert_chain(settings.cert_file, settings.key_file, password=lambda: "")
    except ssl.SSLError as error:
        what = (error.reason or str(error)).lower().replace("_", " ")
        reason = f"{what} (wanted: PEM, a key without a passphrase)"
        raise LinkError(message("path_not_usable", path=where, reason=reason)) from None
    except OSError as error:
        raise LinkError(message("path_not_usable", path=error.filename or where, reason=_words(error))) from None
    return context


UNSUPPORTED_PROTOCOL: Final = 132
"""Reason code of a broker that does not support the client's MQTT version (MQTT 5, section 2.4)."""
_BAD_PASSWORD: Final = (134, 135)
_LOST: Final = "has ended the connection (stopped? network? another client called {id!r}?)"
"""Error text for a lost connection: code 7 of the library paho, and code 128 of MQTT 5."""
_SILENT: Final = "is silent"
"""Error text after silence of twice the keepalive time: code 16 of the library paho, and code 141 of MQTT 5."""
_STATES: Final = {
    7: _LOST,
    16: _SILENT,
    128: _LOST,
    UNSUPPORTED_PROTOCOL: "speaks neither MQTT 5 nor 3.1.1",
    133: "refuses the client id {id!r} (mqtt.client_id)",
    136: "is not available now",
    137: "is not available now",
    139: "shuts down",
    141: _SILENT,
    142: "has another client called {id!r}: a second companion for this vehicle? (change mqtt.base_topic)",
}
"""Error texts by reason code: codes from 128 on are MQTT 5's (section 2.4), lower codes are those of the library paho.
The library converts reason codes of MQTT 3.1.1 to codes of MQTT 5."""


def causes(error: BaseException) -> list[BaseException]:
    """List an error and its causes, outermost first; of an exception group use only the first member."""
    found: list[BaseException] = []
    inner: BaseException | None = error
    while inner is not None and inner not in found:
        if isinstance(inner, BaseExceptionGroup):
            inner = inner.exceptions[0]
            continue
        found.append(inner)
        inner = inner.__cause__ or inner.__context__
    return found


def _reason_code(error: BaseException) -> int | None:
    codes = (getattr(cause, "rc", None) for cause in causes(error))
    return next((int(getattr(code, "value", code)) for code in codes if code is not None), None)


def _is_unanswered(error: BaseException) -> bool:
    """Return True if the broker accepted the connection and then was silent (aiomqtt has no error type for this)."""
    return any(str(cause) == "Operation timed out" for cause in causes(error))


def explain(error: BaseException, settings: Mqtt, client_id: str, *, reached: bool) -> str:
    """Describe in one line why no connection was made or, if `reached`, why it was lost; omit the broker's address."""
    code = _reason_code(error)
    if code in _BAD_PASSWORD:
        user = f"user {settings.username!r}: unknown, or the password is wrong"
        nobody = "clients without a user (mqtt.username, mqtt.password_file)"
        return message("broker_refuses", what=nobody if settings.username is None else user)
    if code is not None:
        state = _STATES.get(code)
        state = f"says: {causes(error)[-1]}" if state is None else state.format(id=client_id)
        return message("broker_fails", state=state)
    hint = " (does it want tls = true?)"
    if settings.tls:
        hint = " (does it want a certificate? mqtt.cert_file)" if settings.cert_file is None else ""
    if _is_unanswered(error):
        return message("broker_fails", state=_SILENT if reached else f"sends nothing{hint}")
    for cause in causes(error):
        if isinstance(cause, LinkError):
            return str(cause)
        if isinstance(cause, OSError) and (words := _of_system(cause, settings)):
            return words
    return str(error) or type(error).__name__


def _of_system(error: OSError, settings: Mqtt) -> str | None:
    if isinstance(error, ssl.SSLCertVerificationError):
        trusted = settings.ca_file or "the system's authorities; mqtt.ca_file names another"
        reason = f"its certificate is not trusted: {error.verify_message} (by {trusted})"
        return message("tls_failed", reason=reason)
    if isinstance(error, ssl.SSLError):
        return message("tls_failed", reason=(error.reason or str(error)).lower().replace("_", " "))
    if isinstance(error, socket.gaierror):
        return message("broker_fails", state=f"has an unknown host {settings.host}")
    if isinstance(error, TimeoutError):
        return message("broker_fails", state="gives no answer")
    if isinstance(error, ConnectionRefusedError):
        return message("broker_fails", state="does not listen (is it running?)")
    return _words(error) if error.errno else None


def _words(error: OSError) -> str:
    return os.strerror(error.errno).lower() if error.errno else str(error)
