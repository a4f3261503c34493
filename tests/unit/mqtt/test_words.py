"""Passwords, certificates and the broker's refusals in one line each."""

from __future__ import annotations

from pathlib import Path

import aiomqtt
import pytest
import trustme
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from companion.config.sections import Mqtt
from companion.errors import LinkError
from companion.mqtt.broker import explain, is_open_to_all, read_password, tls_context

HOST = "192.0.2.1"


def of_file(path: Path) -> Mqtt:
    return Mqtt(host=HOST, username="u", password_file=str(path))


@pytest.mark.parametrize(
    ("content", "password"),
    [(b"secret", "secret"), (b"secret\n", "secret"), (b" a b \r\n", " a b "), ("Grüße\n".encode(), "Grüße")],
)
def test_a_password_is_the_one_line_of_its_file(tmp_path: Path, content: bytes, password: str) -> None:
    path = tmp_path / "password"
    path.write_bytes(content)
    path.chmod(0o640)
    assert read_password(of_file(path)) == password
    assert not is_open_to_all(of_file(path))
    path.chmod(0o644)
    assert is_open_to_all(of_file(path))


@pytest.mark.parametrize("content", [b"", b"\n", b"a\nb\n", b"\xff\xfe", b"x" * 5000])
def test_a_file_that_holds_no_password(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "password"
    path.write_bytes(content)
    with pytest.raises(LinkError, match=r"password file .*password not usable: wanted: the password on one line"):
        read_password(of_file(path))


def test_a_password_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match=r"^password file .*/none not usable: no such file or directory$"):
        read_password(of_file(tmp_path / "none"))
    with pytest.raises(LinkError, match="is a directory"):
        read_password(of_file(tmp_path))
    assert not is_open_to_all(of_file(tmp_path / "none"))
    assert read_password(Mqtt(host=HOST)) is None


def test_certificates_that_cannot_be_used(tmp_path: Path) -> None:
    authority = trustme.CA()
    ours, other = authority.issue_cert("companion"), authority.issue_cert("other")
    authority.cert_pem.write_to_path(tmp_path / "ca")
    ours.cert_chain_pems[0].write_to_path(tmp_path / "cert")
    ours.private_key_pem.write_to_path(tmp_path / "key")
    other.private_key_pem.write_to_path(tmp_path / "other")
    (tmp_path / "text").write_text("not a certificate")

    def settings(ca: str, cert: str, key: str) -> Mqtt:
        return Mqtt(
            host=HOST,
            tls=True,
            ca_file=str(tmp_path / ca),
            cert_file=str(tmp_path / cert),
            key_file=str(tmp_path / key),
        )

    assert tls_context(settings("ca", "cert", "key")) is not None
    assert tls_context(Mqtt(host=HOST)) is None
    for wrong, words in (
        (settings("none", "cert", "key"), "none not usable: no such file"),
        (settings("text", "cert", "key"), "text not usable"),
        (settings("ca", "none", "key"), "none not usable: no such file"),
        (settings("ca", "cert", "none"), "none not usable: no such file"),
        (settings("ca", "cert", "other"), "other not usable"),
    ):
        with pytest.raises(LinkError, match=words) as caught:
            tls_context(wrong)
        assert "\n" not in str(caught.value)


def _refused(name: str) -> Exception:
    return aiomqtt.exceptions.MqttConnectError(ReasonCode(PacketTypes.CONNACK, name))


def _lost(name: str) -> Exception:
    return aiomqtt.MqttCodeError(ReasonCode(PacketTypes.DISCONNECT, name), "Unexpected disconnection")


@pytest.mark.parametrize(
    ("error", "user", "words"),
    [
        (_refused("Bad user name or password"), "u", "refuses user 'u'"),
        (_refused("Not authorized"), None, "clients without a user (mqtt.username"),
        (_refused("Client identifier not valid"), None, "refuses the client id 'me' (mqtt.client_id)"),
        (_refused("Server unavailable"), None, "not available now"),
        (_refused("Quota exceeded"), None, "the broker says: "),
        (_lost("Session taken over"), None, "the broker has another client called 'me'"),
        (_lost("Server shutting down"), None, "the broker shuts down"),
        (aiomqtt.MqttError("Operation timed out"), None, "sends nothing (does it want tls = true?)"),
        (ExceptionGroup("", [_lost("Keep alive timeout")]), None, "the broker is silent"),
        (LinkError("password file /x: no such file"), None, "password file /x: no such file"),
        (OSError(113, "Connect call failed ('192.0.2.1', 1883)"), None, "no route to host"),
        (ZeroDivisionError(), None, "ZeroDivisionError"),
    ],
)
def test_why_there_is_no_connection(error: Exception, user: str | None, words: str) -> None:
    said = explain(error, Mqtt(host=HOST, username=user), "me", reached=False)
    assert words in said
    assert "\n" not in said
