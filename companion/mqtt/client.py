"""Connection to an MQTT broker: made again after every loss, fed from an outbox.

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
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from companion.config.sections import Mqtt
from companion.links.system.connection import Backoff, Reconnection
from companion.links.system.waiting import comes
from companion.mqtt.broker import causes, explain, is_of_protocol, is_open_to_all, read_password, tls_context
from companion.mqtt.outbox import Outbox

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
"""The numbers of the two protocols on the wire."""
MAX_PACKET_BYTES: Final = 64 * 1024
"""The longest message that the broker may send us (MQTT 5)."""
MAX_WAITING: Final = 1000
"""The most messages received and not handled yet; more are dropped without an answer. aiomqtt fills this queue faster
than it empties it: a flood of some hundred requests has to fit. With 64 KiB each they fit the process's memory."""
_REFUSED: Final = 128


class Incoming(NamedTuple):
    """A message from the broker."""

    topic: str
    payload: bytes
    retained: bool = False
    """Kept by the broker from earlier, or (seen in MQTT 5 only) published now to be kept."""


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
        self._reconnection = Reconnection("mqtt", Backoff(FIRST_WAIT_S, LONGEST_WAIT_S), worth_s=WORTH_S)
        self._protocol: int = MQTT_5
        self._connected_s: float | None = None
        self._since = datetime.datetime.now(tz=datetime.UTC)
        self._refused: list[str] = []
        self._warned_open = False
        self._echoed = will is None

    @property
    def connected(self) -> bool:
        """True while the broker accepts us."""
        return self._connected_s is not None

    @property
    def last_error(self) -> str | None:
        """Why there is, or last was, no connection; one line for people."""
        return self._reconnection.last_error or None

    @property
    def where(self) -> str:
        """The broker's address."""
        return f"{self.settings.host}:{self.settings.broker_port}"

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        now_s = asyncio.get_running_loop().time()
        since_s = None if self._connected_s is None else now_s - self._connected_s
        next_s = self._reconnection.retry_s
        retry_s = None if next_s is None else max(0.0, next_s - now_s)
        refused_now = [*self._refused]
        if since_s is not None and since_s > ANSWER_DEADLINE_S and not self._echoed:
            # Few brokers tell a client that they let it neither speak nor hear.
            refused_now.append("our own messages do not come back (the broker's access list?)")
        if since_s is not None:
            words = f"connected to {self.where} since {self._since:%H:%M:%S} UTC"
            words += "".join(f"; {refused}" for refused in refused_now)
        else:
            words = self.last_error or f"{self.where}: not connected yet"
            words += "" if retry_s is None else f"; next attempt in {retry_s:.0f} s"
        if self.outbox.dropped:
            words += f"; {self.outbox.dropped} answers dropped in a flood of requests"
        return {
            "good": since_s is not None and not refused_now,
            "summary": words,
            "connected": since_s is not None,
            "last_error": self.last_error,
        }

    async def run(self) -> None:
        """Keep the connection until cancelled; a loss is an event to report, never an exception."""
        loop = asyncio.get_running_loop()
        problem = await asyncio.to_thread(_load_library)
        if problem is not None:
            self._reconnection.down(problem)
            await loop.create_future()
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
        await self._subscribe(client)
        self._spoken_to = client
        self._up()
        await self._send(client)

    async def hear(self, topic: str) -> None:
        """Subscribe to one more topic, now and at every connection."""
        import aiomqtt

        if topic in self._subscriptions:
            return
        self._subscriptions.append(topic)
        if self._spoken_to is not None:
            # A connection that is lost over it brings the next one.
            with contextlib.suppress(aiomqtt.MqttError):
                await self._ask_for(self._spoken_to, topic)

    async def _subscribe(self, client: aiomqtt.Client) -> None:
        self._refused = []
        # One that is added meanwhile takes part.
        for topic in self._subscriptions:
            await self._ask_for(client, topic)

    async def _ask_for(self, client: aiomqtt.Client, topic: str) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        if self._protocol == MQTT_5:
            options = SubscribeOptions(qos=1, retainAsPublished=True)
            granted = await client.subscribe(topic, options=options, timeout=ANSWER_DEADLINE_S)
        else:
            granted = await client.subscribe(topic, qos=1, timeout=ANSWER_DEADLINE_S)
        if any(getattr(code, "value", code) >= _REFUSED for code in granted):
            self._refused.append(f"the broker does not let us hear {topic} (its access list?)")
            logger.warning("mqtt: %s: %s", self.where, self._refused[-1])

    async def _send(self, client: aiomqtt.Client) -> None:
        while True:
            parcel = await self.outbox.next()
            await client.publish(
                parcel.topic, parcel.payload, qos=parcel.qos, retain=parcel.retain, timeout=ANSWER_DEADLINE_S
            )
            self.outbox.sent(parcel)

    async def _receive(self, client: aiomqtt.Client) -> None:
        """Handle messages until the connection ends, which raises."""
        async for message in client.messages:
            self._deliver(message)

    def _deliver(self, message: aiomqtt.Message) -> None:
        topic = message.topic.value
        self._echoed |= self._will is not None and topic == self._will[0]
        try:
            self._on_message(Incoming(topic, message.payload, bool(message.retain)))
        except Exception:
            logger.exception("an MQTT message could not be dealt with")

    def _up(self) -> None:
        self._connected_s = asyncio.get_running_loop().time()
        self._since = datetime.datetime.now(tz=datetime.UTC)
        self._echoed = self._will is None
        self.connections += 1
        self.outbox.opened()
        protocol = {MQTT_5: "MQTT 5", MQTT_3_1_1: "MQTT 3.1.1"}[self._protocol]
        self._reconnection.up(f"connected to {self.where} ({protocol})")


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
