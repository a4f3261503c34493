"""Connection to an MQTT broker: made again after every loss, fed from an outbox that is bounded whatever it does.

aiomqtt 2 speaks MQTT 3.1.1 and 5. Only this module knows it, as its version 3 will be another library. MQTT 5 is tried
first: only there can a message say that it was published to be retained, and only there is the broker told how long a
message may be. A broker that sends more than this process may hold ends the process, and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import importlib
import logging
import ssl
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from companion.config.sections import Mqtt
from companion.links.system.connection import Reconnection
from companion.links.system.events import comes
from companion.mqtt.broker import causes, explain, is_of_protocol, is_open_to_all, read_password, tls_context

if TYPE_CHECKING:
    import aiomqtt

logger = logging.getLogger(__name__)
_quiet = logging.getLogger(f"{__name__}.aiomqtt")
# What goes wrong there reaches us as an exception, and is said once, in words for people.
_quiet.setLevel(logging.CRITICAL)

INSTALL: Final = "pip install 'aiomqtt>=2.5,<3' where the companion is installed"
GREETING_DEADLINE_S: Final = 5.0
"""Timeout of the broker's first answer; a broker that is silent to MQTT 5 is then tried with MQTT 3.1.1."""
ANSWER_DEADLINE_S: Final = 5.0
FIRST_WAIT_S: Final = 0.5
LONGEST_WAIT_S: Final = 30.0
WORTH_S: Final = 10.0
"""Least duration of a connection after which the next attempts begin with short waits again."""
MQTT_3_1_1: Final = 4
MQTT_5: Final = 5
_PROTOCOLS: Final = {MQTT_5: "MQTT 5", MQTT_3_1_1: "MQTT 3.1.1"}
MAX_PACKET_BYTES: Final = 64 * 1024
"""The longest message that the broker may send us (MQTT 5)."""
MAX_WAITING: Final = 1000
"""The most messages received and not handled yet; more are dropped without an answer. aiomqtt fills this queue faster
than it empties it: a flood of some hundred requests has to fit. With 64 KiB each they fit the process's memory."""
_REFUSED: Final = 128
MAX_ANSWERS: Final = 64
LONG_BYTES: Final = 1024
"""A message that is longer may be too long for a broker."""
MOST_TRIES: Final = 3
"""Connections that may end while one long message is being sent, before it is given up."""


class Incoming(NamedTuple):
    """A message from the broker."""

    topic: str
    payload: bytes
    retained: bool = False
    """Kept by the broker from earlier, or (seen in MQTT 5 only) published now to be kept."""


class Parcel(NamedTuple):
    """Message on its way; telemetry passes without the broker's receipt."""

    kind: Literal["kept", "answer", "passing"]
    topic: str
    payload: bytes
    droppable: bool = False


class Outbox:
    """Three kinds of messages, each with its own way of staying small.

    - kept: retained at the broker. Of each topic only the latest value counts; it is remembered after it was sent,
      as a broker that has restarted may have lost it. Their topics are few and our own.
    - answers: each is sent, in order, also after the connection was lost in between. At most 64: then the oldest that
      may be dropped (a refusal) goes, and where none may, the oldest of all.
    - passing: telemetry. Of each topic only the latest value, and none without a connection.
    """

    def __init__(self) -> None:
        self._kept: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}
        self._answers: deque[Parcel] = deque()
        self._passing: dict[str, bytes] = {}
        self._filled = asyncio.Event()
        self.emptied = asyncio.Event()
        self.emptied.set()
        self._open = False
        self._given_up: set[str] = set()
        """Topics whose kept value the broker does not take."""
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._unsent) + len(self._answers) + len(self._passing)

    def keep(self, topic: str, payload: bytes, *, again: bool = False) -> None:
        """Have the broker keep a payload; an empty one has it forget the topic. `again`: send it though it is kept."""
        if again or self._kept.get(topic) != payload:
            self._kept[topic] = payload
            self._unsent[topic] = None
            self._given_up.discard(topic)
            self._tell()

    def kept(self, topic: str) -> bytes | None:
        """Return the payload that the broker keeps under a topic."""
        return self._kept.get(topic)

    def answer(self, topic: str, payload: bytes, *, droppable: bool) -> None:
        """Send an answer once."""
        if len(self._answers) >= MAX_ANSWERS:
            self.dropped += 1
            oldest = next((index for index, old in enumerate(self._answers) if old.droppable), None)
            if oldest is None and droppable:
                return
            del self._answers[oldest or 0]
        self._answers.append(Parcel("answer", topic, payload, droppable))
        self._tell()

    def pass_on(self, topic: str, payload: bytes) -> None:
        """Send telemetry if there is a connection."""
        if self._open:
            self._passing[topic] = payload
            self._tell()

    def opened(self) -> None:
        """Start a connection: send all kept payloads again."""
        self._open = True
        self._unsent = {topic: None for topic in self._kept if topic not in self._given_up}
        self._tell()

    def closed(self) -> None:
        """End a connection, and drop telemetry."""
        self._open = False
        self._passing.clear()
        self._tell()

    async def next(self) -> Parcel:
        """Return the next parcel; it stays (telemetry apart) until `sent`."""
        while True:
            if self._unsent:
                topic = next(iter(self._unsent))
                return Parcel("kept", topic, self._kept[topic])
            if self._answers:
                return self._answers[0]
            if self._passing:
                topic = next(iter(self._passing))
                return Parcel("passing", topic, self._passing.pop(topic))
            self._filled.clear()
            await self._filled.wait()

    def sent(self, parcel: Parcel, *, given_up: bool = False) -> None:
        """Remove a parcel that the broker has, or never takes."""
        if parcel.kind == "kept":
            if given_up:
                self._given_up.add(parcel.topic)
            if self._kept[parcel.topic] == parcel.payload:
                self._unsent.pop(parcel.topic, None)
        elif parcel.kind == "answer" and self._answers and self._answers[0] is parcel:
            self._answers.popleft()
        self._tell()

    def _tell(self) -> None:
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
        self.settings, self.client_id = settings, client_id
        self.outbox = Outbox()
        self.connections = 0
        self._will, self._subscriptions, self._on_message = will, list(subscriptions), on_message
        self._spoken_to: aiomqtt.Client | None = None
        self._reconnection = Reconnection("mqtt", worth_s=WORTH_S, first_s=FIRST_WAIT_S, cap_s=LONGEST_WAIT_S)
        self._protocol: int = MQTT_5
        self._connected_s: float | None = None
        self._since = datetime.datetime.now(tz=datetime.UTC)
        self._refused: list[str] = []
        self._warned_open = False
        self._echoed = will is None
        self._trying = ""
        self._tries = 0
        self.where = f"{settings.host}:{settings.broker_port}"

    @property
    def connected(self) -> bool:
        """True while the broker accepts us."""
        return self._connected_s is not None

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        now_s, faults = asyncio.get_running_loop().time(), [*self._refused]
        if self._connected_s is not None:
            if now_s - self._connected_s > ANSWER_DEADLINE_S and not self._echoed:
                # Few brokers tell a client that they let it neither speak nor hear.
                faults.append("our own messages do not come back (the broker's access list?)")
            words = "; ".join((f"connected to {self.where} since {self._since:%H:%M:%S} UTC", *faults))
        else:
            words = self._reconnection.last_error or f"{self.where}: not connected yet"
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
        if (problem := await asyncio.to_thread(_load_library)) is not None:
            self._reconnection.down(problem)
            await asyncio.get_running_loop().create_future()
        await self._reconnection.keep(self._once)

    async def _once(self) -> str:
        """Hold one connection in the newest protocol of the broker; return why it has ended."""
        before, reason = self.connections, f"{self.where}: the connection has ended"
        for protocol in (MQTT_5, MQTT_3_1_1) if self._protocol == MQTT_5 else (MQTT_3_1_1,):
            self._protocol = protocol
            ended: BaseException | None = None
            try:
                await self._serve()
            except* Exception as group:  # noqa: BLE001 - whatever it is, it costs the connection and nothing else
                ended = group
            if ended is None:
                return reason
            if any(isinstance(cause, MemoryError) for cause in causes(ended)):
                raise MemoryError from ended
            logger.debug("mqtt", exc_info=ended)
            reached = self.connections > before
            reason = f"{self.where}: {explain(ended, self.settings, self.client_id, reached=reached)}"
            # A broker that is too old for MQTT 5 says so, or says nothing, or closes the connection.
            if reached or not is_of_protocol(ended):
                return reason
        self._protocol = MQTT_5
        return reason

    async def flush(self, within_s: float) -> None:
        """Wait until everything was sent, at most so long; without a connection not at all."""
        if self.connected:
            await comes(self.outbox.emptied, within_s)

    async def _serve(self) -> None:
        """Hold one connection to its end; raises LinkError, OSError or aiomqtt.MqttError for why."""
        password = await asyncio.to_thread(read_password, self.settings)
        if not self._warned_open and is_open_to_all(self.settings):
            self._warned_open = True
            path = self.settings.password_path
            logger.warning("mqtt: password file %s: everybody on this computer can read it (chmod o-r)", path)
        context = await asyncio.to_thread(tls_context, self.settings)
        async with self._client(password, context) as client:
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._speak(client), name="mqtt sender")
                    group.create_task(self._receive(client), name="mqtt receiver")
            finally:
                self._connected_s = self._spoken_to = None
                self.outbox.closed()

    def _client(self, password: str | None, context: ssl.SSLContext | None) -> aiomqtt.Client:
        import aiomqtt

        return make_client(
            self.settings,
            self._protocol,
            MAX_PACKET_BYTES,
            password=password,
            identifier=self.client_id,
            will=aiomqtt.Will(self._will[0], self._will[1], qos=1, retain=True) if self._will else None,
            tls_context=context,
            timeout=GREETING_DEADLINE_S,
            max_queued_incoming_messages=MAX_WAITING,
        )

    async def _speak(self, client: aiomqtt.Client) -> None:
        self._refused = []
        # One that is added meanwhile takes part.
        for topic in self._subscriptions:
            await self._subscribe(client, topic)
        self._spoken_to = client
        self._connected_s = asyncio.get_running_loop().time()
        self._since = datetime.datetime.now(tz=datetime.UTC)
        self._echoed = self._will is None
        self.connections += 1
        self.outbox.opened()
        self._reconnection.up(f"connected to {self.where} ({_PROTOCOLS[self._protocol]})")
        while True:
            await self._send(client, await self.outbox.next())

    async def _send(self, client: aiomqtt.Client, parcel: Parcel) -> None:
        """Send a parcel, or give it up: a broker that ends the connection over it would do so at every connection."""
        self._tries = self._tries + 1 if parcel.topic == self._trying else 1
        self._trying = parcel.topic
        if self._tries > MOST_TRIES and len(parcel.payload) > LONG_BYTES:
            logger.warning(
                "mqtt: %s: given up: %d bytes at %s, over which the connection ended %d times;"
                " set the broker's limit higher",
                *(self.where, len(parcel.payload), parcel.topic, MOST_TRIES),
            )
            self.outbox.sent(parcel, given_up=True)
        else:
            qos, retain = 0 if parcel.kind == "passing" else 1, parcel.kind == "kept"
            await client.publish(parcel.topic, parcel.payload, qos=qos, retain=retain, timeout=ANSWER_DEADLINE_S)
            self.outbox.sent(parcel)
        self._trying = ""

    async def hear(self, topic: str) -> None:
        """Subscribe to one more topic, now and at every connection."""
        import aiomqtt

        if topic in self._subscriptions:
            return
        self._subscriptions.append(topic)
        if self._spoken_to is not None:
            # A connection that is lost over it brings the next one.
            with contextlib.suppress(aiomqtt.MqttError):
                await self._subscribe(self._spoken_to, topic)

    async def _subscribe(self, client: aiomqtt.Client, topic: str) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        if self._protocol == MQTT_5:
            options = SubscribeOptions(qos=1, retainAsPublished=True)
            granted = await client.subscribe(topic, options=options, timeout=ANSWER_DEADLINE_S)
        else:
            granted = await client.subscribe(topic, qos=1, timeout=ANSWER_DEADLINE_S)
        if any(getattr(code, "value", code) >= _REFUSED for code in granted):
            self._refused.append(f"the broker does not let us hear {topic} (its access list?)")
            logger.warning("mqtt: %s: %s", self.where, self._refused[-1])

    async def _receive(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            topic = message.topic.value
            self._echoed |= self._will is not None and topic == self._will[0]
            try:
                self._on_message(Incoming(topic, message.payload, bool(message.retain)))
            except Exception:
                logger.exception("an MQTT message could not be dealt with")


def make_client(settings: Mqtt, protocol: int, most_bytes: int, **more: Any) -> aiomqtt.Client:
    """Make a client of a broker with a clean session; `most_bytes`: longest packet that it may send (MQTT 5)."""
    import aiomqtt
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    properties = None
    if protocol == MQTT_5:
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = most_bytes
    return aiomqtt.Client(
        settings.host,
        settings.broker_port,
        username=settings.username,
        protocol=aiomqtt.ProtocolVersion(protocol),
        clean_session=True if properties is None else None,
        keepalive=settings.keepalive_s,
        properties=properties,
        logger=_quiet,
        **more,
    )


def _load_library() -> str | None:
    """Import aiomqtt, in a thread as it takes a while; return why it cannot be used, in words."""
    try:
        # Imported here: it takes as long as all of the links.
        from importlib.metadata import version

        found = version("aiomqtt")
        importlib.import_module("aiomqtt")
    except Exception as error:  # noqa: BLE001 - whatever a broken installation raises
        return f"aiomqtt cannot be loaded: {error} ({INSTALL}); the companion goes on without MQTT"
    if not found.startswith("2."):
        return f"aiomqtt {found} is of another make ({INSTALL}); the companion goes on without MQTT"
    return None
