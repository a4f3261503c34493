"""The MQTT process: publishes the daemon's state, answers requests, and sends what the fleet has not confirmed yet."""

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
from companion.mqtt.client import Incoming, MqttLink
from companion.mqtt.daemon import Ask, Daemon, Requests
from companion.mqtt.fleet import AircraftFleet

logger = logging.getLogger(__name__)
_json: Final = msgspec.json.encode

MEMORY_MIB: Final = 128
"""The process needs 30 MiB, the fleet's part included."""
FOUND_WITHIN_S: Final = 3.0
"""Wait this long for the autopilot's system id; without it the vehicle is number 1, as on MAVLink."""
NEWS_WITHIN_S: Final = 1.0
PROGRESS_S: Final = 0.5
AFTER_FAULT_S: Final = 30.0
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
    """Work of the process. A test hands in the daemon's answers; otherwise they come from the control socket."""

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
        """Return the connection's state, for `companion status` and `check`; the fleet's under its own key."""
        fleet: Object | None = None if self.fleet is None else self.fleet.status()
        if self._only_listening and self._has_fleet:
            fleet = {"good": True, "summary": "not looked at in a check: companion status, once the daemon runs"}
        if self.link is None or self.topics is None:
            waiting = "waiting for the autopilot's system id"
            return {"good": False, "summary": waiting, "connected": False, "fleet": fleet}
        return {**self.link.status(), "base_topic": self.topics.base, "fleet": fleet}

    async def run(self) -> None:
        """Serve the broker until cancelled. In a check the broker is only connected to."""
        if self._only_listening:
            await self._connect_only()
        async with asyncio.TaskGroup() as group:
            group.create_task(self.daemon.follow(), name="daemon")
            if self.fleet is not None:
                group.create_task(self.fleet.run(), name="fleet")
            group.create_task(self._publish_forever(), name="publisher")

    async def _ask(self, request: Object) -> AsyncGenerator[Object, None]:
        async with contextlib.aclosing(ask(self._socket, {"face": "mqtt", **request})) as replies:
            async for reply in replies:
                yield reply

    @property
    def _known_system_id(self) -> int | None:
        return self.daemon.vehicle.get("system_id") or self._system_id

    def _base(self) -> str:
        return self._settings.base_topic or f"companion/{self._known_system_id or 1}"

    def _client_id(self, base: str) -> str:
        # The same after every restart: our old connection, and its last will with it, gives way to the new one.
        return self._settings.client_id or base.replace("/", "-")

    async def _news(self) -> None:
        await comes(self.daemon.news, NEWS_WITHIN_S)
        self.daemon.news.clear()

    async def _connect_only(self) -> None:
        base = self._base()
        self.topics = Topics(base)
        self.link = MqttLink(self._settings, client_id=f"{self._client_id(base)}-check")
        await self.link.run()

    async def _publish_forever(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FOUND_WITHIN_S):
                while self._settings.base_topic is None and self._known_system_id is None:
                    await self._news()
        while True:
            try:
                await self._publish_as(self._base())
            except MemoryError:
                raise
            except Exception:
                logger.exception("MQTT met a fault of the program; it begins again in %.0f s", AFTER_FAULT_S)
                await asyncio.sleep(AFTER_FAULT_S)

    async def _publish_as(self, base: str) -> None:
        """Serve under a base topic until the vehicle has another one."""
        self.topics = topics = Topics(base)
        self.link = link = MqttLink(
            self._settings,
            client_id=self._client_id(base),
            will=(topics.status, OFFLINE),
            subscriptions=(f"{topics.request}+", topics.status),
            on_message=self._on_message,
        )
        self._requests = Requests(self.daemon.ask, self._respond, self._on_retained)
        self._pace, self._progress, self._progress_s = Pace(), b"", -math.inf
        running = asyncio.get_running_loop().create_task(link.run(), name="mqtt link")
        try:
            while self._base() == base:
                self._publish(link, topics)
                if running.done():
                    running.result()
                await self._news()
            logger.info("mqtt: the vehicle is %s, no longer %s", self._base(), base)
            await self._requests.close(ANSWER_AT_END_S)
            for topic in topics.kept:
                link.outbox.keep(topic, b"")  # the broker forgets it
        except asyncio.CancelledError:
            await self._requests.close(ANSWER_AT_END_S)
            await self.daemon.refresh()
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
            outbox.pass_on(topics.progress, progress)
            self._progress, self._progress_s = progress, now_s
        if daemon.pose is not None:
            outbox.pass_on(topics.attitude, _json(daemon.pose))

    # --- messages received

    def _on_message(self, message: Incoming) -> None:
        if self.topics is None or self.link is None:
            return
        if message.topic == self.topics.status:
            if message.payload != ONLINE and self.link.outbox.kept(message.topic) == ONLINE:
                # The last will of an earlier connection, come late.
                self.link.outbox.keep(message.topic, ONLINE, again=True)
        elif message.topic.startswith(self.topics.request):
            command = message.topic.removeprefix(self.topics.request)
            self._requests.accept(command, message.payload, retained=message.retained)
        elif self.fleet is not None:
            self.fleet.on_message(message)

    def _on_retained(self, command: str) -> None:
        if self.topics is not None:
            topic = self.topics.request + command
            logger.warning(
                "mqtt: the retained request at %s is not obeyed; delete it: mosquitto_pub -r -n -t %s", topic, topic
            )

    def _respond(self, command: str, response: Object) -> None:
        if self.topics is not None and self.link is not None:
            droppable = response["state"] == "refused" or "repeated" in response
            self.link.outbox.answer(self.topics.response + command, _json(response), droppable=droppable)


def summary(status: Object) -> Object:
    """Return the part of the status that is published as the state: no figures that change all the time."""
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
    """Says when a state is worth a message.

    At once when the state itself changes, within a second when anything else does; every ten seconds when only words
    change that tell how long ago something was.
    """

    def __init__(self) -> None:
        self._said: Object | None = None
        self._said_s = 0.0

    def is_due(self, state: Object, now_s: float) -> bool:
        """Return whether to send a state now; then it counts as sent."""
        said = self._said
        if said == state:
            return False
        due = (
            said is None
            or said["state"] != state["state"]
            or now_s - self._said_s >= (SLOW_S if _lasting(said) == _lasting(state) else LEAST_S)
        )
        if due:
            self._said, self._said_s = state, now_s
        return due


def _lasting(state: Object) -> Object:
    return {**state, "arming": {**state["arming"], "in_force": None, "words": None}}


class Topics:
    """All topics under one base, such as "companion/1"."""

    def __init__(self, base: str) -> None:
        self.base = base
        self.status, self.state, self.record = f"{base}/status", f"{base}/state", f"{base}/calibration/state"
        self.kept = (self.status, self.state, self.record)
        self.progress, self.attitude = f"{base}/calibration/progress", f"{base}/attitude"
        self.request, self.response = f"{base}/request/", f"{base}/response/"
        """Topics of a request and its response, without the name of the command."""
