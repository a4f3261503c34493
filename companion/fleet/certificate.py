"""The certificate of the page: tried out before it is used, and taken anew when its files have changed."""

from __future__ import annotations

import logging
import ssl
from pathlib import Path

from companion.errors import ConfigError
from companion.mqtt.broker import load_pair, unusable

logger = logging.getLogger(__name__)


class Certificate:
    """A certificate with its chain, and its key, PEM; `context` is for a server.

    Raises:
        ConfigError: they cannot be used; one line that names the file.
    """

    def __init__(self, cert: Path, key: Path) -> None:
        self._cert, self._key = cert, key
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._seen: object = None
        self._take()

    def look_again(self) -> None:
        """Take files that have changed, for connections to come; those that cannot be used change nothing."""
        if self._stamps() == self._seen:
            return
        try:
            self._take()
        except ConfigError as error:
            logger.warning("page: the former certificate is used: %s", error)
        else:
            logger.info("page: %s was taken anew", self._cert)

    def _stamps(self) -> object:
        try:
            return [(found.st_mtime_ns, found.st_ino) for found in (self._cert.stat(), self._key.stat())]
        except OSError:
            return None

    def _take(self) -> None:
        client, trial = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._seen = self._stamps()
        where = self._cert
        try:
            client.load_verify_locations(where)
            where = self._key
            for context in (trial, self.context):
                load_pair(context, self._cert, self._key)
        except OSError as error:
            raise ConfigError(str(unusable(error, where))) from None
        if (refused := _refused(client, trial)) is not None:
            logger.warning("page: %s: browsers will refuse it: %s", self._cert, refused)


def _refused(client: ssl.SSLContext, server: ssl.SSLContext) -> str | None:
    """What a client that trusts this very certificate has against it (its dates, its purpose), in a handshake."""
    client.check_hostname = False
    client.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True)
    for side in sides * 2:
        try:
            side.do_handshake()
        except ssl.SSLWantReadError:
            continue
        except ssl.SSLCertVerificationError as error:
            return error.verify_message
    return None
