"""Main part of the MQTT process: publishes the daemon's state, answers requests, and sends results to the fleet."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncGenerator
from typing import Final

import msgspec

from companion.config.sections import Mqtt
from companion.formats import Object
from companion.links.system.connection import ask
from companion.links.system.events import comes
from companion.links.system.process import ChildSettings
from companion.messages import message
from companion.mqtt.client import Incoming, MqttLink
from companion.mqtt.daemon import Ask, Daemon, Requests
from companion.mqtt.fleet import AircraftFleet

logger = logging.getLogger(__name__)
_json: Final = msgspec.json.encode

MEMORY_MIB: Final = 128
"""Memory limit of the MQTT process, which needs 30 MiB, fleet client included."""
FOUND_WITHIN_S: Final = 3.0
"""Longest wait for the autopilot's MAVLink system id; then the topics use MAVLink's default, 1."""
NEWS_WITHIN_S: Final = 1.0
PROGRESS_S: Final = 0.5
ANSWER_AT_END_S: Final = 0.5
FLUSH_S: Final = 1.0

ONLINE = b"online"
OFFLINE = b"offline"
LEAST_S: Final = 1.0
SLOW_S: Final = 10.0
_COPIED = ("state", "reason", "progress", "waiting_for", "warnings", "fault", "putting_back", "last")
_ARMING = ("at_arm", "verdict", "words", "state", "in_force")
_VEHICLE = ("system_id", "firmware", "armed", "summary")


class MqttProcess:
    """All tasks of the MQTT process. Only tests pass `asks`, to replace requests to the daemon's control socket."""

    def __init__(self, settings: ChildSettings, asks: Ask | None = None) -> None:
        config = settings.config
        assert config.mqtt is not None
        self._settings: Mqtt = config.mqtt
        self._socket, self._only_listening = config.control.path, settings.only_listening is not None
        self._system_id, self._has_fleet = config.vehicle.system_id, config.fleet is not None
        self.daemon = Daemon(asks or self._ask)
        self.link: MqttLink | None = None
        self.topics: Topics | None = None
        self.fleet: AircraftFleet | None = None
        if config.fleet is not None and not self._only_listening:
            self.fleet = AircraftFleet(config.fleet, config.storage.path, self.daemon, lambda: self.link)

    def status(self) -> Object:
        fleet: Object | None = None if self.fleet is None else self.fleet.status()
        if self._only_listening and self._has_fleet:
            fleet = {"good": True, "summary": message("fleet_not_sent", reason="only a check is running")}
        if self.link is None or self.topics is None:
            waiting = "waiting for the autopilot's system id"
            return {"good": False, "summary": waiting, "connected": False, "fleet": fleet}
        return {**self.link.status(), "base_topic": self.topics.base, "fleet": fleet}

    async def run(self) -> None:
        """Publish and answer requests until cancelled; under the command `check`, only connect to the broker."""
        if self._only_listening:
            self.topics = Topics(self._base())
            self.link = MqttLink(self._settings, client_id=f"{self._client_id(self.topics.base)}-check")
            await self.link.run()
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self.daemon.follow(), name="daemon")]
            if self.fleet is not None:
                tasks.append(group.create_task(self.fleet.run(), name="fleet"))
            try:
                await self._publish_forever()
            finally:
                for task in tasks:
                    task.cancel()

    def _ask(self, request: Object) -> AsyncGenerator[Object, None]:
        return ask(self._socket, {"face": "mqtt", **request})

    @property
    def _known_system_id(self) -> int | None:
        return self.daemon.vehicle.get("system_id") or self._system_id

    def _base(self) -> str:
        return self._settings.base_topic or f"companion/{self._known_system_id or 1}"

    def _client_id(self, base: str) -> str:
        # Same id after every restart: the new connection replaces the old one and its last will.
        return self._settings.client_id or base.replace("/", "-")

    async def _news(self) -> None:
        await comes(self.daemon.news, NEWS_WITHIN_S)
        self.daemon.news.clear()

    async def _publish_forever(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FOUND_WITHIN_S):
                while self._settings.base_topic is None and self._known_system_id is None:
                    await self._news()
        while True:
            await self._publish_as(Topics(self._base()))

    async def _publish_as(self, topics: Topics) -> None:
        """Publish and handle requests under one base topic, until the vehicle's MAVLink system id changes."""

        def respond(command: str, response: Object) -> None:
            droppable = response["state"] == "refused" or "repeated" in response
            link.outbox.answer(topics.response + command, _json(response), droppable=droppable)

        def on_message(message: Incoming) -> None:
            if message.topic == topics.status:
                if message.payload != ONLINE and link.outbox.kept(topics.status) == ONLINE:
                    # The last will of an earlier connection arrived late: overwrite it.
                    link.outbox.keep(topics.status, ONLINE, again=True)
            elif message.topic.startswith(topics.request):
                command = message.topic.removeprefix(topics.request)
                requests.accept(command, message.payload, retained=message.retained)
            elif self.fleet is not None:
                self.fleet.on_message(message)

        requests = Requests(self.daemon.ask, topics.request, respond)
        self.topics = topics
        self.link = link = MqttLink(
            self._settings,
            client_id=self._client_id(topics.base),
            will=(topics.status, OFFLINE),
            subscriptions=(f"{topics.request}+", topics.status),
            on_message=on_message,
        )
        self._pace, self._progress, self._progress_s = Pace(), b"", -math.inf
        running = asyncio.get_running_loop().create_task(link.run(), name="mqtt link")
        try:
            while self._base() == topics.base:
                self._publish(link, topics)
                if running.done():
                    running.result()
                await self._news()
            logger.info("mqtt: the vehicle is %s, no longer %s", self._base(), topics.base)
            await requests.close(ANSWER_AT_END_S)
            for topic in topics.kept:
                link.outbox.keep(topic, b"")  # delete it at the broker
        except asyncio.CancelledError:
            await requests.close(ANSWER_AT_END_S)
            self.daemon.news.clear()
            await self._news()  # for example the record of a calibration that was just cancelled
            self._publish(link, topics)
            link.outbox.keep(topics.status, OFFLINE)
            raise
        finally:
            await link.flush(FLUSH_S)
            running.cancel()
            await asyncio.wait([running], timeout=FLUSH_S)

    def _publish(self, link: MqttLink, topics: Topics) -> None:
        daemon, outbox = self.daemon, link.outbox
        outbox.keep(topics.status, ONLINE if daemon.alive else OFFLINE)
        if daemon.status is None:
            return
        now_s = asyncio.get_running_loop().time()
        if daemon.record is not None:
            outbox.keep(topics.record, _json(daemon.record))
        state = summary(daemon.status)
        if self._pace.is_due(state, now_s):
            outbox.keep(topics.state, _json(state))
        if not link.connected:
            return
        job = daemon.status["job"]
        progress = b"" if job is None else _json(job)
        busy = daemon.status["progress"] is not None
        if progress != self._progress and (now_s - self._progress_s >= PROGRESS_S or not busy):
            outbox.send_telemetry(topics.progress, progress)
            self._progress, self._progress_s = progress, now_s
        if daemon.pose is not None:
            outbox.send_telemetry(topics.attitude, _json(daemon.pose))


def summary(status: Object) -> Object:
    """Select the part of the daemon's status that is published as its state, without figures that always change."""
    return {
        **{key: status[key] for key in _COPIED},
        "vehicle": {key: status["vehicle"][key] for key in _VEHICLE},
        "arming": {key: status["arming"][key] for key in _ARMING},
        "devices": [
            {key: one[key] for key in ("name", "kind", "good")} | {"problem": None if one["good"] else one["summary"]}
            for one in status["devices"]
        ],
    }


class Pace:
    """Limit on how often the daemon's state is published.

    A change of the field `state` is published at once, any other change within a second. Texts that state the age of an
    event change all the time: changes of these texts alone are published every ten seconds.
    """

    def __init__(self) -> None:
        self._sent: Object | None = None
        self._sent_s = 0.0

    def is_due(self, state: Object, now_s: float) -> bool:
        sent = self._sent
        if sent == state:
            return False
        due = (
            sent is None
            or sent["state"] != state["state"]
            or now_s - self._sent_s >= (SLOW_S if _lasting(sent) == _lasting(state) else LEAST_S)
        )
        if due:
            self._sent, self._sent_s = state, now_s
        return due


def _lasting(state: Object) -> Object:
    return {**state, "arming": {**state["arming"], "in_force": None, "words": None}}


class Topics:
    """MQTT topics under a base such as "companion/1". Append a command's name to `request` and `response`."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.status, self.state, self.record = f"{base}/status", f"{base}/state", f"{base}/calibration/state"
        self.kept = (self.status, self.state, self.record)
        self.progress, self.attitude = f"{base}/calibration/progress", f"{base}/attitude"
        self.request, self.response = f"{base}/request/", f"{base}/response/"
