"""The daemon on MQTT: its state out, requests in.

It looks at the daemon a few times a second and puts what has changed into the outbox; it holds nobody up, and nothing
that happens here, in aiomqtt or at the broker, ends anything but itself.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from typing import Final

import msgspec

from companion.calibration.records.record import to_json
from companion.config.sections import Mqtt
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.core import Core, Handler
from companion.daemon.faces.mqtt.requests import Requests
from companion.daemon.heading.subsystem import PoseNow
from companion.formats import Object
from companion.links.mqtt.client import Incoming, MqttLink
from companion.links.system.listeners import Listeners
from companion.links.system.waiting import comes

logger = logging.getLogger(__name__)
_json: Final = msgspec.json.encode

LOOK_S: Final = 0.2
"""The attitude goes out at every look: at most 5 a second."""
PROGRESS_S: Final = 0.5
FOUND_WITHIN_S: Final = 3.0
"""How long the autopilot's system id is waited for; without it the vehicle is number 1, as on MAVLink."""
AFTER_FAULT_S: Final = 30.0
STATE_S: Final = 0.5
ANSWER_AT_END_S: Final = 0.5
FLUSH_S: Final = 1.0
ONLINE = b"online"
OFFLINE = b"offline"
LEAST_S: Final = 1.0
SLOW_S: Final = 10.0
_COPIED = ("state", "reason", "progress", "waiting_for", "vehicle", "warnings", "fault", "putting_back", "last")
_ARMING = ("at_arm", "verdict", "words", "state", "in_force")


def summary(status: Object) -> Object:
    """The state as others show it: without the figures that change with every look."""
    return {
        **{key: status[key] for key in _COPIED},
        "arming": {key: status["arming"][key] for key in _ARMING},
        "devices": [
            {
                "name": device["name"],
                "kind": device["kind"],
                "good": device["good"],
                "problem": None if device["good"] else device["summary"],
            }
            for device in status["devices"]
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
        """Whether to send it now; if so, it counts as sent."""
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
        self.status = f"{base}/status"
        self.state = f"{base}/state"
        self.record = f"{base}/calibration/state"
        self.progress = f"{base}/calibration/progress"
        self.attitude = f"{base}/attitude"
        self.kept = (self.status, self.state, self.record)
        """Those that the broker keeps."""
        self.request, self.response = f"{base}/request/", f"{base}/response/"
        """Where a command is asked for and answered: its name follows."""


class MqttFace:
    """One broker's view of the daemon; `run` it. Where the daemon only listens, the broker is left alone."""

    def __init__(
        self,
        core: Core,
        settings: Mqtt,
        answer: Handler,
        status: Callable[[], Object],
        conductor: Conductor,
        pose: PoseNow,
    ) -> None:
        self._settings, self._answer, self._all_status, self._conductor = settings, answer, status, conductor
        self._vehicle, self._offload, self._pose = core.vehicle, core.offload, pose
        self._system_id = core.config.vehicle.system_id
        self._only_listening = core.only_listening is not None
        self._faulty = False
        self.link: MqttLink | None = None
        self.topics: Topics | None = None
        self.on_other: Listeners[Incoming] = Listeners()
        """Told of what comes under topics that are not ours."""

    def status(self) -> Object:
        """For `companion status` and `check`."""
        if self.link is None or self.topics is None:
            return {"good": False, "summary": "waiting for the autopilot's system id", "connected": False}
        return {**self.link.status(), "base_topic": self.topics.base}

    async def run(self) -> None:
        """Speak to the broker until cancelled; never raises anything else."""
        if self._settings.base_topic is None and self._known_system_id is None and not self._only_listening:
            await comes(self._vehicle.found, FOUND_WITHIN_S)
        while True:
            try:
                await self._speak_as(self._base())
            except Exception:
                logger.exception("MQTT met a fault of the program; it begins again in %.0f s", AFTER_FAULT_S)
                await asyncio.sleep(AFTER_FAULT_S)

    @property
    def _known_system_id(self) -> int | None:
        return self._vehicle.system_id or self._system_id

    def _base(self) -> str:
        return self._settings.base_topic or f"companion/{self._known_system_id or 1}"

    async def _speak_as(self, base: str) -> None:
        """Serve under a base topic until it is another one."""
        self.topics = topics = Topics(base)
        # The same after every restart: so our own old connection, and its last will with it, gives way to the new one.
        client_id = self._settings.client_id or base.replace("/", "-")
        if self._only_listening:
            self.link = link = MqttLink(self._settings, client_id=f"{client_id}-check", offload=self._offload)
            await link.run()
        self.link = link = MqttLink(
            self._settings,
            client_id=client_id,
            will=(topics.status, OFFLINE),
            subscriptions=(f"{topics.request}+", topics.status),
            on_message=self._on_message,
            offload=self._offload,
        )
        self._requests = Requests(self._answer, self._respond, self._on_retained)
        self._pace, self._state_s, self._state = Pace(), -math.inf, ""
        self._progress, self._progress_s = b"", -math.inf
        link.outbox.keep(topics.status, ONLINE)
        running = asyncio.get_running_loop().create_task(link.run(), name="mqtt link")
        try:
            while self._base() == base:
                await self._try_to_publish(link, topics)
                await asyncio.sleep(LOOK_S)
            logger.info("mqtt: the vehicle is %s, no longer %s", self._base(), base)
        finally:
            await self._requests.close(ANSWER_AT_END_S)
            if self._base() == base:
                await self._try_to_publish(link, topics)
                link.outbox.keep(topics.status, OFFLINE)
            else:
                for topic in topics.kept:
                    # What is ours no longer: the broker forgets it.
                    link.outbox.keep(topic, b"")
            await link.flush(FLUSH_S)
            # A publication that is answered in that moment swallows the cancellation (asyncio.wait_for of Python 3.11).
            while not running.done():
                running.cancel()
                await asyncio.wait([running], timeout=LOOK_S)

    async def _try_to_publish(self, link: MqttLink, topics: Topics) -> None:
        try:
            await self._publish_changes(link, topics)
            self._faulty = False
        except Exception:
            # A fault here must not cost the calibration; said once, not five times a second.
            logger.log(logging.DEBUG if self._faulty else logging.ERROR, "the state for MQTT", exc_info=True)
            self._faulty = True

    async def _publish_changes(self, link: MqttLink, topics: Topics) -> None:
        now_s = asyncio.get_running_loop().time()
        state = self._conductor.state.shown
        if state != self._state or now_s - self._state_s >= STATE_S:
            self._state, self._state_s = state, now_s
            self._look_rarely(link, topics, now_s)
        if not link.connected:
            return
        progress = self._progress_now()
        if progress != self._progress and (now_s - self._progress_s >= PROGRESS_S or not self._is_busy):
            link.outbox.pass_on(topics.progress, progress)
            self._progress, self._progress_s = progress, now_s
        pose = await self._pose.refresh()
        if pose is not None:
            link.outbox.pass_on(topics.attitude, _json(pose))

    def _look_rarely(self, link: MqttLink, topics: Topics, now_s: float) -> None:
        """What costs more than a glance."""
        if (last := self._conductor.results.last) is not None:
            link.outbox.keep(topics.record, to_json(last))
        said = summary(self._all_status())
        if self._pace.is_due(said, now_s):
            link.outbox.keep(topics.state, _json(said))

    @property
    def _is_busy(self) -> bool:
        return self._conductor.running is not None

    def _progress_now(self) -> bytes:
        """How the latest job does; empty before the first."""
        job = self._conductor.job
        if job is None:
            return b""
        return _json(
            {
                "kind": job.kind,
                "what": job.what.name.lower(),
                "requester": job.requester,
                "state": self._conductor.state.shown,
                "percent": self._conductor.progress_percent,
                "text": job.words if self._is_busy else self._conductor.reason,
            }
        )

    # --- what comes

    def _on_message(self, message: Incoming) -> None:
        if self.topics is None or self.link is None:
            return
        if message.topic == self.topics.status:
            if message.payload != ONLINE and self.link.outbox.kept(message.topic) == ONLINE:
                # The last will of an earlier connection, come late.
                self.link.outbox.send_again(message.topic)
            return
        if message.topic.startswith(self.topics.request):
            command = message.topic.removeprefix(self.topics.request)
            self._requests.accept(command, message.payload, retained=message.retained)
        else:
            self.on_other.tell(message)

    def _on_retained(self, command: str) -> None:
        if self.topics is not None:
            topic = self.topics.request + command
            logger.warning(
                "mqtt: the retained request at %s is not obeyed; delete it: mosquitto_pub -r -n -t %s", topic, topic
            )

    def _respond(self, command: str, response: Object, *, droppable: bool) -> None:
        if self.topics is not None and self.link is not None:
            self.link.outbox.answer(self.topics.response + command, _json(response), droppable=droppable)
