"""MQTT client that reconnects after every loss and sends messages from an outbox of limited size.

It runs in the MQTT process: messages of a broker that exhaust this process's memory cannot end the daemon.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import importlib
import logging
from collections import deque
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from companion.config.sections import Mqtt
from companion.errors import LinkError
from companion.formats import Object
from companion.links.system.connection import Reconnection
from companion.links.system.events import comes
from companion.messages import message
from companion.mqtt.broker import MQTT_5, Broker, subscribe

if TYPE_CHECKING:
    import aiomqtt

logger = logging.getLogger(__name__)

GREETING_DEADLINE_S: Final = 5.0
"""Timeout of the broker's first answer. If the broker does not answer to MQTT 5, the client tries MQTT 3.1.1."""
ANSWER_DEADLINE_S: Final = 5.0
FIRST_WAIT_S: Final = 0.5
LONGEST_WAIT_S: Final = 30.0
WORTH_S: Final = 10.0  # Least duration of a connection that resets the wait before the next attempt
MAX_PACKET_BYTES: Final = 64 * 1024
"""Longest message that the broker may send us; only MQTT 5 has such a limit."""
MAX_WAITING: Final = 1000
"""Largest number of received messages that wait to be handled; more are dropped without an answer. A burst of some
hundred requests fills this queue faster than we empty it. 1000 messages of 64 KiB fit the process's memory."""
MAX_ANSWERS: Final = 64
LONG_BYTES: Final = 1024  # Messages above this length may be too long for a broker
MOST_TRIES: Final = 3
"""Number of attempts to send one long message: if the connection is lost in each, the message is given up."""


class Incoming(NamedTuple):
    topic: str
    payload: bytes
    retained: bool = False
    """True if the broker had stored the message; with MQTT 5 also if it was published as retained just now."""


class OutgoingMessage(msgspec.Struct, eq=False):
    """Message to send; telemetry is sent once (QoS 0), all else at least once (QoS 1)."""

    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False
    droppable: bool = False
    tries: int = 0

    @property
    def is_given_up(self) -> bool:
        """True for a long message after `MOST_TRIES` attempts to send it, each ended by a lost connection."""
        return self.tries > MOST_TRIES and len(self.payload) > LONG_BYTES


class Outbox:
    """Messages that wait to be sent, of three kinds; each kind is limited in number.

    - kept: retained by the broker. Only the latest value of each topic is stored. It is sent again at every connection,
      because a restarted broker may have lost it. The topics are few and our own.
    - answers: each is sent, in order, even if the connection was lost in between. If 64 are waiting, one is dropped:
      the oldest droppable one (such as a refusal); without it the new one, if droppable; else the oldest of all.
    - telemetry: only the latest value of each topic is stored, and none without a connection.
    """

    def __init__(self) -> None:
        self._kept: dict[str, OutgoingMessage] = {}
        self._unsent: dict[str, OutgoingMessage] = {}
        self._answers: deque[OutgoingMessage] = deque()
        self._telemetry: dict[str, OutgoingMessage] = {}
        self._filled = asyncio.Event()
        self.emptied = asyncio.Event()
        self.emptied.set()
        self._open = False
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._unsent) + len(self._answers) + len(self._telemetry)

    def keep(self, topic: str, payload: bytes, *, again: bool = False) -> None:
        """Queue a retained payload; an empty one deletes the topic. Skip the topic's present payload unless `again`."""
        if again or self.kept(topic) != payload:
            self._kept[topic] = self._unsent[topic] = OutgoingMessage(topic, payload, retain=True)
            self._notify()

    def kept(self, topic: str) -> bytes | None:
        return self._kept[topic].payload if topic in self._kept else None

    def answer(self, topic: str, payload: bytes, *, droppable: bool) -> None:
        if len(self._answers) >= MAX_ANSWERS:
            self.dropped += 1
            oldest = next((index for index, old in enumerate(self._answers) if old.droppable), None)
            if oldest is None and droppable:
                return
            del self._answers[oldest or 0]
        self._answers.append(OutgoingMessage(topic, payload, droppable=droppable))
        self._notify()

    def send_telemetry(self, topic: str, payload: bytes) -> None:
        if self._open:
            self._telemetry[topic] = OutgoingMessage(topic, payload, qos=0)
            self._notify()

    def opened(self) -> None:
        """Note that a connection has been made, and queue all retained messages again, except those given up."""
        self._open = True
        self._unsent = {topic: parcel for topic, parcel in self._kept.items() if not parcel.is_given_up}
        self._notify()

    def closed(self) -> None:
        self._open = False
        self._telemetry.clear()
        self._notify()

    async def next(self) -> OutgoingMessage:
        """Wait for the next message to send and return it; it stays in the outbox until `sent` is called."""
        while not len(self):
            self._filled.clear()
            await self._filled.wait()
        return next(
            parcel for some in (self._unsent.values(), self._answers, self._telemetry.values()) for parcel in some
        )

    def sent(self, parcel: OutgoingMessage) -> None:
        """Remove a message that was sent or given up; a newer message of its topic stays in the outbox."""
        for latest in (self._unsent, self._telemetry):
            if latest.get(parcel.topic) is parcel:
                del latest[parcel.topic]
        if self._answers and self._answers[0] is parcel:
            self._answers.popleft()
        self._notify()

    def _notify(self) -> None:
        if len(self):
            self._filled.set()
            self.emptied.clear()
        else:
            self.emptied.set()


class MqttLink:
    """Connection to the broker: sends the messages of `outbox` and passes received ones to `on_message`.

    The broker disconnects a client when another connects with the same id. `will` is the last will (topic, payload): a
    message that the broker publishes, retained, when the connection is lost. Its topic must be in `subscriptions` too:
    the link verifies that our own messages come back. `on_message` must not block.
    """

    def __init__(
        self,
        settings: Mqtt,
        *,
        client_id: str,
        will: tuple[str, bytes] | None = None,
        subscriptions: Sequence[str] = (),
        on_message: Callable[[Incoming], None] = lambda message: None,
    ) -> None:
        self.outbox = Outbox()
        self.connections = 0
        self._broker = Broker(settings, client_id)
        self._will, self._subscriptions, self._on_message = will, list(subscriptions), on_message
        self._client: aiomqtt.Client | None = None
        self._reconnection = Reconnection("mqtt", worth_s=WORTH_S, first_s=FIRST_WAIT_S, cap_s=LONGEST_WAIT_S)
        self._connected_s = 0.0
        self._refused: list[str] = []
        self._echoed = False

    @property
    def connected(self) -> bool:
        return self._client is not None

    def status(self) -> Object:
        now_s, faults = asyncio.get_running_loop().time(), [*self._refused]
        if self.connected:
            connected_for_s = now_s - self._connected_s
            since = datetime.datetime.now(tz=datetime.UTC) - datetime.timedelta(seconds=connected_for_s)
            if self._will is not None and not self._echoed and connected_for_s > ANSWER_DEADLINE_S:
                # Few brokers report to a client that their access list forbids it to publish or to receive.
                faults.append(message("broker_refuses", what="our own messages: none comes back (its access list?)"))
            connected = message("mqtt_connected", broker=self._broker.where, detail=f"since {since:%H:%M:%S} UTC")
            words = "; ".join((connected, *faults))
        else:
            words = self._reconnection.last_error or f"{self._broker.where}: not connected yet"
            if (retry_s := self._reconnection.retry_s) is not None:
                words += f"; next attempt in {max(0.0, retry_s - now_s):.0f} s"
        if self.outbox.dropped:
            words += f"; {self.outbox.dropped} answers dropped in a flood of requests"
        return {
            "good": self.connected and not faults,
            "summary": words,
            "connected": self.connected,
            "last_error": self._reconnection.last_error or None,
        }

    async def run(self) -> None:
        """Stay connected until cancelled; a lost connection shows in `status` and raises no exception."""
        try:
            await asyncio.to_thread(_load_library)
        except Exception as error:  # noqa: BLE001 - whatever a broken installation raises
            self._reconnection.down(message("mqtt_library_missing", error=error))
            await asyncio.get_running_loop().create_future()
        await self._reconnection.keep(self._once)

    async def flush(self, within_s: float) -> None:
        """Wait until all messages were sent, for `within_s` seconds at most; without a connection return at once."""
        if self.connected:
            await comes(self.outbox.emptied, within_s)

    async def _once(self) -> str:
        import aiomqtt

        async with self._broker.connected(
            MAX_PACKET_BYTES,
            will=None if self._will is None else aiomqtt.Will(*self._will, qos=1, retain=True),
            timeout=GREETING_DEADLINE_S,
            max_queued_incoming_messages=MAX_WAITING,
        ) as client:
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._speak(client), name="mqtt sender")
                    group.create_task(self._receive(client), name="mqtt receiver")
            finally:
                self._client = None
                self.outbox.closed()
        return f"{self._broker.where}: the connection has ended"

    async def _speak(self, client: aiomqtt.Client) -> None:
        self._refused = []
        # The loop includes topics that are added meanwhile.
        for topic in self._subscriptions:
            await self._subscribe_now(client, topic)
        self._client, self._echoed = client, False
        self._connected_s = asyncio.get_running_loop().time()
        self.connections += 1
        self.outbox.opened()
        name = "MQTT 5" if self._broker.protocol == MQTT_5 else "MQTT 3.1.1"
        self._reconnection.up(message("mqtt_connected", broker=self._broker.where, detail=name))
        while True:
            parcel = await self.outbox.next()
            parcel.tries += 1
            if parcel.is_given_up:
                size, topic = len(parcel.payload), parcel.topic
                lost = message("mqtt_message_given_up", size=size, topic=topic, times=MOST_TRIES)
                logger.warning("mqtt: %s: %s", self._broker.where, lost)
            else:
                await client.publish(parcel.topic, parcel.payload, parcel.qos, parcel.retain, timeout=ANSWER_DEADLINE_S)
                parcel.tries = 0
            self.outbox.sent(parcel)

    async def subscribe(self, topic: str) -> None:
        """Subscribe to one more topic, now and at every later connection."""
        import aiomqtt

        if topic in self._subscriptions:
            return
        self._subscriptions.append(topic)
        if self._client is not None:
            # If this ends the connection, the next connection subscribes.
            with contextlib.suppress(aiomqtt.MqttError):
                await self._subscribe_now(self._client, topic)

    async def _subscribe_now(self, client: aiomqtt.Client, topic: str) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        options: dict[str, Any] = {"qos": 1}
        if self._broker.protocol == MQTT_5:
            options = {"options": SubscribeOptions(qos=1, retainAsPublished=True)}
        try:
            await subscribe(client, topic, timeout=ANSWER_DEADLINE_S, **options)
        except LinkError as error:
            self._refused.append(str(error))
            logger.warning("mqtt: %s: %s", self._broker.where, error)

    async def _receive(self, client: aiomqtt.Client) -> None:
        async for received in client.messages:
            topic = received.topic.value
            self._echoed |= self._will is not None and topic == self._will[0]
            try:
                self._on_message(Incoming(topic, received.payload, bool(received.retain)))
            except Exception:
                logger.exception("an MQTT message could not be dealt with")


def _load_library() -> None:
    """Import aiomqtt, which is slow: call this in a thread. Raise ImportError if it is missing or not version 2."""
    if not version("aiomqtt").startswith("2."):
        raise ImportError(f"found version {version('aiomqtt')}; allowed: 2")
    importlib.import_module("aiomqtt")
