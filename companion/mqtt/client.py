"""The MQTT process's connection: made again after every loss, and fed from an outbox that is bounded whatever it does.

A broker that sends more than this process may hold ends the process, and nothing else.
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
"""Timeout of the broker's first answer; a broker that is silent to MQTT 5 is then tried with MQTT 3.1.1."""
ANSWER_DEADLINE_S: Final = 5.0
FIRST_WAIT_S: Final = 0.5
LONGEST_WAIT_S: Final = 30.0
WORTH_S: Final = 10.0  # Least duration of a connection after which the next attempts begin with short waits again
MAX_PACKET_BYTES: Final = 64 * 1024
"""The longest message that the broker may send us (MQTT 5)."""
MAX_WAITING: Final = 1000
"""The most messages received and not handled yet; more are dropped without an answer. aiomqtt fills this queue faster
than it empties it: a flood of some hundred requests has to fit. With 64 KiB each they fit the process's memory."""
MAX_ANSWERS: Final = 64
LONG_BYTES: Final = 1024  # A message that is longer may be too long for a broker
MOST_TRIES: Final = 3
"""Connections that may end while one long message is being sent, before it is given up."""


class Incoming(NamedTuple):
    """A message from the broker."""

    topic: str
    payload: bytes
    retained: bool = False
    """Kept by the broker from earlier, or (seen in MQTT 5 only) published now to be kept."""


class Parcel(msgspec.Struct, eq=False):
    """Message on its way; telemetry has QoS 0."""

    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False
    droppable: bool = False
    tries: int = 0

    @property
    def is_given_up(self) -> bool:
        """True where the broker ended the connection over it so often that it would end every connection."""
        return self.tries > MOST_TRIES and len(self.payload) > LONG_BYTES


class Outbox:
    """Three kinds of messages, each with its own way of staying small.

    - kept: retained at the broker. Of each topic only the latest value counts; it is sent again at every connection,
      as a broker that has restarted may have lost it. Their topics are few and our own.
    - answers: each is sent, in order, also after the connection was lost in between. At most 64: then the oldest that
      may be dropped (a refusal) goes, and where none may, the oldest of all.
    - telemetry: of each topic only the latest value, and none without a connection.
    """

    def __init__(self) -> None:
        self._kept: dict[str, Parcel] = {}
        self._unsent: dict[str, Parcel] = {}
        self._answers: deque[Parcel] = deque()
        self._telemetry: dict[str, Parcel] = {}
        self._filled = asyncio.Event()
        self.emptied = asyncio.Event()
        self.emptied.set()
        self._open = False
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._unsent) + len(self._answers) + len(self._telemetry)

    def keep(self, topic: str, payload: bytes, *, again: bool = False) -> None:
        """Have the broker keep a payload; an empty one has it forget the topic. `again`: send it though it is kept."""
        if again or self.kept(topic) != payload:
            self._kept[topic] = self._unsent[topic] = Parcel(topic, payload, retain=True)
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
        self._answers.append(Parcel(topic, payload, droppable=droppable))
        self._notify()

    def send_telemetry(self, topic: str, payload: bytes) -> None:
        if self._open:
            self._telemetry[topic] = Parcel(topic, payload, qos=0)
            self._notify()

    def opened(self) -> None:
        """Start a connection: send all kept payloads again."""
        self._open = True
        self._unsent = {topic: parcel for topic, parcel in self._kept.items() if not parcel.is_given_up}
        self._notify()

    def closed(self) -> None:
        self._open = False
        self._telemetry.clear()
        self._notify()

    async def next(self) -> Parcel:
        """Return the next parcel; it stays until `sent`."""
        while not len(self):
            self._filled.clear()
            await self._filled.wait()
        return next(
            parcel for some in (self._unsent.values(), self._answers, self._telemetry.values()) for parcel in some
        )

    def sent(self, parcel: Parcel) -> None:
        """Remove a parcel that the broker has, or never takes, unless its topic has a newer value."""
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
    """Keeps a connection to the broker, sends what is in `outbox`, hands over what comes.

    A second client of the same id takes over from the first. The will, topic and payload, is what the broker publishes,
    retained, when we are gone without a word; its topic should be among the subscriptions, to know that what we say
    there comes through. `on_message` must not block.
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
                # Few brokers tell a client that they let it neither speak nor hear.
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
        """Keep the connection until cancelled; a loss is an event to report, never an exception."""
        try:
            await asyncio.to_thread(_load_library)
        except Exception as error:  # noqa: BLE001 - whatever a broken installation raises
            self._reconnection.down(message("mqtt_library_missing", error=error))
            await asyncio.get_running_loop().create_future()
        await self._reconnection.keep(self._once)

    async def flush(self, within_s: float) -> None:
        """Wait until everything was sent, at most so long; without a connection not at all."""
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
        # A topic that is added meanwhile takes part.
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
        """Subscribe to one more topic, now and at every connection."""
        import aiomqtt

        if topic in self._subscriptions:
            return
        self._subscriptions.append(topic)
        if self._client is not None:
            # A connection that is lost over it brings the next one.
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
    """Import aiomqtt, in a thread as it takes a while; raise ImportError where it is absent or another library."""
    if not version("aiomqtt").startswith("2."):
        raise ImportError(f"found version {version('aiomqtt')}; allowed: 2")
    importlib.import_module("aiomqtt")
