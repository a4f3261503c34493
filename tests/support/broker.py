"""Real MQTT brokers on free loopback ports, and a client to watch and to ask with.

Mosquitto where it is installed; amqtt (in Python, MQTT 3.1.1 only) everywhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import aiomqtt
import pytest
import trustme

from companion.mqtt import client as link

Kind = Literal["mosquitto", "amqtt"]

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/sbin")
KINDS: list[Kind] = ["mosquitto", "amqtt"] if MOSQUITTO else ["amqtt"]
BEST: Kind = KINDS[0]
"""Most tests need one broker, and that the one people use."""

USER, PASSWORD = "heron", "Grus grus"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Broker:
    """A broker process; start, kill and start it again on its port.

    Args:
        folder: for its files.
        kind: which.
        users: whether USER with PASSWORD is needed.
        tls: whether it speaks TLS, with a certificate for 127.0.0.1 by the authority in `ca_file`.
        more: lines more of its configuration (of Mosquitto's).
    """

    def __init__(
        self, folder: Path, kind: Kind = BEST, *, users: bool = False, tls: bool = False, more: str = ""
    ) -> None:
        self.kind, self.users, self.tls, self.more = kind, users, tls, more
        self.plugins: dict[str, dict[str, object]] = {}
        """amqtt's, with their configuration."""
        self.folder = folder / f"broker-{kind}"
        self.folder.mkdir(exist_ok=True)
        self.port = free_port()
        self.ca_file = self.folder / "ca.pem"
        self._process: subprocess.Popen[bytes] | None = None
        if tls:
            self._certify()
        if users:
            self._name_users()

    def _certify(self) -> None:
        authority = trustme.CA()
        server = authority.issue_cert("127.0.0.1")
        authority.cert_pem.write_to_path(self.ca_file)
        client = authority.issue_cert("companion")
        client.private_key_pem.write_to_path(self.folder / "client-key.pem")
        client.cert_chain_pems[0].write_to_path(self.folder / "client.pem")
        server.private_key_pem.write_to_path(self.folder / "key.pem")
        server.cert_chain_pems[0].write_to_path(self.folder / "cert.pem")

    def _name_users(self) -> None:
        path = self.folder / "users"
        if self.kind == "mosquitto":
            subprocess.run(["mosquitto_passwd", "-b", "-c", path, USER, PASSWORD], check=True, capture_output=True)
            path.chmod(0o644)
        else:
            from pwdlib import PasswordHash
            from pwdlib.hashers.argon2 import Argon2Hasher

            path.write_text(f"{USER}:{PasswordHash((Argon2Hasher(),)).hash(PASSWORD)}\n")

    def _command(self) -> list[str]:
        if self.kind == "mosquitto":
            lines = [f"listener {self.port} 127.0.0.1", f"allow_anonymous {str(not self.users).lower()}", "user root"]
            lines += [f"password_file {self.folder}/users"] * self.users
            lines += [f"certfile {self.folder}/cert.pem", f"keyfile {self.folder}/key.pem"] * self.tls
            lines.append(self.more)
            config = self.folder / "mosquitto.conf"
            config.write_text("\n".join(lines) + "\n")
            return [str(MOSQUITTO), "-c", str(config)]
        listener: dict[str, object] = {"type": "tcp", "bind": f"127.0.0.1:{self.port}"}
        if self.tls:
            listener |= {"ssl": True, "certfile": f"{self.folder}/cert.pem", "keyfile": f"{self.folder}/key.pem"}
        plugins: dict[str, dict[str, object] | None] = {
            "amqtt.plugins.authentication.FileAuthPlugin": {"password_file": f"{self.folder}/users"}
            if self.users
            else None,
            "amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": not self.users},
        }
        wanted = {name: what for name, what in plugins.items() if what is not None} | self.plugins
        config = self.folder / "amqtt.yaml"  # JSON is YAML
        config.write_text(json.dumps({"listeners": {"default": listener}, "plugins": wanted}))
        start = "import sys; from amqtt.scripts.broker_script import main; sys.argv[0] = 'amqtt'; main()"
        return [sys.executable, "-c", start, "-c", str(config)]

    def _spawn(self) -> None:
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(self._command(), stdout=log, stderr=log)

    async def start(self) -> Broker:
        self._spawn()
        async with asyncio.timeout(60.0):
            while True:
                assert self._process is not None
                assert self._process.poll() is None, (self.folder / "log").read_text()
                try:
                    _, writer = await asyncio.open_connection("127.0.0.1", self.port)
                except ConnectionRefusedError:
                    await asyncio.sleep(0.05)
                else:
                    writer.close()
                    with contextlib.suppress(OSError):
                        await writer.wait_closed()
                    return self

    @property
    def process_id(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def section(self, **more: object) -> str:
        keys: dict[str, object] = {"host": "127.0.0.1", "port": self.port, "tls": self.tls}
        if self.tls:
            keys["ca_file"] = str(self.ca_file)
        if self.users:
            password = self.folder / "password"
            password.touch(mode=0o600)
            password.write_text(PASSWORD + "\n")
            keys |= {"username": USER, "password_file": str(password)}
        return "[mqtt]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in {**keys, **more}.items())


@contextlib.asynccontextmanager
async def broker(
    folder: Path, kind: Kind = BEST, *, users: bool = False, tls: bool = False, more: str = ""
) -> AsyncIterator[Broker]:
    one = Broker(folder, kind, users=users, tls=tls, more=more)
    try:
        yield await one.start()
    finally:
        one.kill()


def hurry(monkeypatch: pytest.MonkeyPatch, kind: Kind) -> None:
    """amqtt says nothing to MQTT 5; do not wait for long until MQTT 3.1.1 is tried."""
    if kind == "amqtt":
        monkeypatch.setattr(link, "GREETING_DEADLINE_S", 0.7)


class Heard(NamedTuple):
    topic: str
    payload: bytes
    retained: bool

    @property
    def json(self) -> Any:
        return json.loads(self.payload)


class Peer:
    """Another client of the broker, which hears everything."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client
        self._changed = asyncio.Condition()
        self.heard: list[Heard] = []

    async def listen(self) -> None:
        await self._client.subscribe("#", qos=1)
        async for message in self._client.messages:
            async with self._changed:
                assert isinstance(message.payload, bytes)
                self.heard.append(Heard(message.topic.value, message.payload, bool(message.retain)))
                self._changed.notify_all()

    async def publish(self, topic: str, payload: object = b"", *, retain: bool = False, qos: int = 1) -> None:
        data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
        await self._client.publish(topic, data, qos=qos, retain=retain)

    async def until(
        self, topic: str, fits: Callable[[Heard], bool] = lambda heard: True, within_s: float = 90.0
    ) -> Heard:
        """The first message on a topic that fits, whether it has come already or comes yet."""

        def found() -> Heard | None:
            return next((heard for heard in self.heard if heard.topic == topic and fits(heard)), None)

        try:
            async with asyncio.timeout(within_s), self._changed:
                await self._changed.wait_for(lambda: found() is not None)
        except TimeoutError:
            said = "\n".join(f"{heard.topic} {heard.payload[:200]!r}" for heard in self.heard[-30:])
            raise AssertionError(f"nothing that fits on {topic} within {within_s} s; heard:\n{said}") from None
        heard = found()
        assert heard is not None
        return heard

    async def response(self, base: str, command: str, transaction: object, *states: str, within_s: float = 90.0) -> Any:
        """The response to a transaction, in one of some states if any are given."""

        def fits(heard: Heard) -> bool:
            return heard.json["transaction"] == transaction and (not states or heard.json["state"] in states)

        return (await self.until(f"{base}/response/{command}", fits, within_s)).json

    def responses(self, base: str, command: str) -> list[Any]:
        return [heard.json for heard in self.heard if heard.topic == f"{base}/response/{command}"]

    def forget(self) -> None:
        self.heard.clear()


@contextlib.asynccontextmanager
async def peer(one: Broker) -> AsyncIterator[Peer]:
    client = aiomqtt.Client(
        "127.0.0.1",
        one.port,
        username=USER if one.users else None,
        password=PASSWORD if one.users else None,
        tls_params=aiomqtt.TLSParameters(ca_certs=str(one.ca_file)) if one.tls else None,
    )
    async with client:
        watcher = Peer(client)
        listening = asyncio.create_task(watcher.listen())
        try:
            yield watcher
        finally:
            listening.cancel()
            with contextlib.suppress(asyncio.CancelledError, aiomqtt.MqttError):
                await listening
