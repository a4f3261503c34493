"""The fleet's other end: a collector by the words of docs/fleet/asyncapi.yaml, and a broker's connection in memory."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jsonschema
import yaml

from companion.config.sections import Fleet, Location
from companion.formats import Object
from companion.mqtt.client import Incoming, MqttLink, Outbox
from companion.mqtt.daemon import CLOCKS_AGREE_S, Daemon
from companion.mqtt.fleet import AircraftFleet

ASYNCAPI = Path(__file__).parents[2] / "docs" / "fleet" / "asyncapi.yaml"
CONTRACT: Any = yaml.safe_load(ASYNCAPI.read_text(encoding="utf-8"))
HERON = "00340032510d31313536353600" + 10 * "0"
CRANE = "00210045510d31313536353600" + 10 * "0"


@functools.cache
def judge(message: str) -> jsonschema.Draft202012Validator:
    """Return the validator for the payload of one of the contract's messages, references resolved."""
    schema = {**CONTRACT["components"]["messages"][message]["payload"], "components": CONTRACT["components"]}
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def check(message: str, payload: bytes) -> Any:
    """The payload, which must be as the contract says."""
    found = json.loads(payload)
    judge(message).validate(found)
    return found


class Collector:
    """Keeps what comes by (aircraft, epoch, sequence) and confirms it; `confirms` and `database` are for the test."""

    def __init__(self, publish: Callable[[str, bytes], None]) -> None:
        self._publish = publish
        self.database: dict[tuple[str, str, int], Any] = {}
        self.deliveries: list[tuple[str, str, int]] = []
        self.hellos: list[Any] = []
        self.confirms: Callable[[Any], bool] = lambda item: True

    def take(self, topic: str, payload: bytes) -> None:
        fleet, aircraft, what = topic.split("/")
        assert (fleet, what) in (("fleet", "hello"), ("fleet", "item"))
        said = check(what, payload)
        assert said["aircraft"] == aircraft
        if what == "hello":
            self.hellos.append(said)
            return
        key = (aircraft, said["epoch"], said["sequence"])
        self.deliveries.append(key)
        if self.confirms(said):
            before = self.database.setdefault(key, said)
            assert before["body"] == said["body"], "one number, two things"
            self.confirm(key)

    def confirm(self, *keys: tuple[str, str, int]) -> None:
        for aircraft, epoch, sequence in keys:
            self.say(aircraft, "confirmed", epoch, [[sequence, sequence]])

    def say(self, aircraft: str, what: str, epoch: str, sequences: Any) -> None:
        payload = json.dumps({"format_version": 1, "epoch": epoch, "sequences": sequences}).encode()
        check(what, payload)
        self._publish(f"fleet/{aircraft}/{what}", payload)

    def of(self, aircraft: str) -> list[Any]:
        return [item for (of, _, _), item in sorted(self.database.items()) if of == aircraft]

    def kinds(self, aircraft: str = HERON) -> list[str]:
        return [item["kind"] for item in self.of(aircraft)]


class Connection:
    """In the place of the link to the broker: what is sent reaches the collector, while there is a connection."""

    def __init__(self) -> None:
        self.on_message: Callable[[Incoming], None] = lambda message: None
        self.outbox = Outbox()
        self.connected = False
        self.connections = 0
        self.heard: set[str] = set()
        self.loses: Callable[[], bool] = lambda: False
        self.collector = Collector(self.deliver)

    async def subscribe(self, topic: str) -> None:
        self.heard.add(topic)

    def deliver(self, topic: str, payload: bytes, *, retained: bool = False) -> None:
        if self.connected and topic in self.heard:
            asyncio.get_running_loop().call_later(0.02, self.on_message, Incoming(topic, payload, retained))

    def connect(self) -> None:
        self.connected, self.connections = True, self.connections + 1
        self.outbox.opened()

    def disconnect(self) -> None:
        self.connected = False
        self.outbox.closed()

    async def run(self) -> None:
        while True:
            parcel = await self.outbox.next()
            await asyncio.sleep(0.01)
            if not self.connected:
                continue
            self.outbox.sent(parcel)
            if not self.loses():
                self.collector.take(parcel.topic, parcel.payload)


class _Daemon(Daemon):
    double: SimpleNamespace

    @property
    def vehicle(self) -> Object:
        return {
            "uid": self.double.uid,
            "system_id": self.double.system_id,
            "version_known": self.double.version is not None,
        }

    @property
    def clock_agrees(self) -> bool:
        unix_s = self.double.unix_time_s
        return unix_s is not None and abs(unix_s - time.time()) < CLOCKS_AGREE_S

    @clock_agrees.setter
    def clock_agrees(self, agrees: bool) -> None:
        pass


class Aircraft:
    """The fleet's face of one companion, beside an autopilot that tells no more than who it is and what time it is."""

    def __init__(self, folder: Path, *, uid: str | None = HERON, location: Location = "off") -> None:
        self.folder, self.location = folder, location
        self.vehicle = SimpleNamespace(uid=uid, version="4.6.3", system_id=1, unix_time_s=None)
        self.connection = Connection()
        self.curves: list[Object] = []

    @property
    def collector(self) -> Collector:
        return self.connection.collector

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[AircraftFleet]:
        async def answers(_request: Object) -> AsyncGenerator[Object, None]:
            yield {"kind": "result", "imus": self.curves}

        async def inline(function: Callable[..., Any], *arguments: Any) -> Any:
            return function(*arguments)

        settings = Fleet(name="Heron 7", location=self.location)
        daemon, link = _Daemon(answers), cast("MqttLink", self.connection)
        daemon.double = self.vehicle
        face = AircraftFleet(settings, self.folder, daemon, lambda: link, inline)
        self.connection.on_message = face.on_message
        tasks = [asyncio.create_task(face.run()), asyncio.create_task(self.connection.run())]
        try:
            yield face
            assert not any(task.done() for task in tasks), [task for task in tasks if task.done()]
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
