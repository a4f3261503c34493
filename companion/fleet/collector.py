"""A collector: hears aircraft at a broker, puts what they tell into the database, and then says that it is there.

It keeps nothing itself. Whatever goes wrong, at the broker or in the database, ends its connection; what it had not
confirmed the aircraft tell again, and at the next connection they are asked for what is lacking.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import secrets
import socket
from collections.abc import AsyncIterator, Iterable
from typing import TYPE_CHECKING, Any, Final

from companion.config.sections import Mqtt
from companion.errors import CompanionError, LinkError
from companion.fleet.contract import MOST_BYTES, answers, ranges
from companion.fleet.store import Message, Outcome, Store
from companion.links.system.connection import Backoff, Reconnection
from companion.mqtt.broker import explain, is_of_protocol, read_password, tls_context

if TYPE_CHECKING:
    import aiomqtt

logger = logging.getLogger(__name__)
_quiet = logging.getLogger(f"{__name__}.aiomqtt")
_quiet.setLevel(logging.CRITICAL)

BATCH: Final = 500
GATHER_S: Final = 0.1
"""How long more of a batch is waited for."""
ASK_AFTER: Final = 50
"""So many times as long of hellos: what is told with one has come by then, perhaps to another collector."""
WAITING: Final = 20 * BATCH
"""The most messages from the broker that wait; what is beyond is told again, or another collector hears it."""
WAITING_BYTES: Final = 16 * 1024 * 1024
"""The most bytes of them."""
BATCH_BYTES: Final = 4 * 1024 * 1024
"""The most bytes of a batch, of which a database makes several copies."""
AT_ONCE: Final = 50
"""Messages that are being sent; aiomqtt looks at each of them for every further one."""
SWEEP_S: Final = 5.0
"""For what aircraft said before this collector was there."""
JUDGE_S: Final = 2.0
"""Between two looks for aircraft that are to be judged."""
REST: Final = 4.0
"""Times as long as a judgement took it rests after it: what comes in goes first."""
ANSWER_S: Final = 10.0
STOP_AGAIN_S: Final = 0.5
FIRST_WAIT_S: Final = 0.5
LONGEST_WAIT_S: Final = 30.0
WORTH_S: Final = 10.0
_HELLO: Final = "fleet/+/hello"
_ITEM: Final = "fleet/+/item"
_SHARED: Final = "$share/collectors/"
_MQTT_5: Final = 5
_MQTT_3_1_1: Final = 4


@contextlib.asynccontextmanager
async def connected(client: aiomqtt.Client) -> AsyncIterator[aiomqtt.Client]:
    """A connection whose end hides nothing: what goes wrong on leaving does not take the place of a cancellation."""
    import aiomqtt

    await client.__aenter__()
    try:
        yield client
    finally:
        with contextlib.suppress(aiomqtt.MqttError, OSError, TimeoutError):
            await client.__aexit__(None, None, None)


async def stop(tasks: Iterable[asyncio.Task[None]]) -> list[BaseException]:
    """Cancel tasks until they have ended; what they raised.

    Once is not enough: before Python 3.12 `asyncio.wait_for`, which aiomqtt waits with, loses a cancellation that comes
    at the moment of its result.
    """
    pending = found = set(tasks)
    while pending:
        for task in pending:
            task.cancel()
        _, pending = await asyncio.wait(pending, timeout=STOP_AGAIN_S)
    return [end for end in await asyncio.gather(*found, return_exceptions=True) if end is not None]


class Waiting(asyncio.Queue[Any]):
    """Messages that wait, bounded in bytes beside their number: one may have a quarter of a megabyte."""

    most_bytes = WAITING_BYTES
    _bytes = 0

    def full(self) -> bool:
        """Tell whether there is no room for another message."""
        return super().full() or self._bytes >= self.most_bytes

    def _put(self, item: Any) -> None:
        super()._put(item)
        self._bytes += len(item.payload or b"")

    def _get(self) -> Any:
        item = super()._get()
        self._bytes -= len(item.payload or b"")
        return item


class Inbox(Waiting):
    """Messages of the next batch."""

    most_bytes = BATCH_BYTES


class Collector:
    """One of as many as are wanted at one broker; `run` it as a task.

    Without `mqtt_5` it tries MQTT 3.1.1 first, for a broker that says nothing to MQTT 5.
    """

    def __init__(self, settings: Mqtt, store: Store, *, mqtt_5: bool = True) -> None:
        self.settings, self.store = settings, store
        self.client_id = settings.client_id or f"collector-{socket.gethostname()[:40]}-{secrets.token_hex(4)}"
        self._protocol = _MQTT_5 if mqtt_5 else _MQTT_3_1_1
        self._reconnection = Reconnection("fleet", Backoff(FIRST_WAIT_S, LONGEST_WAIT_S), worth_s=WORTH_S)

    @property
    def where(self) -> str:
        """The broker's address."""
        return f"{self.settings.host}:{self.settings.broker_port}"

    async def run(self) -> None:
        """Collect until cancelled.

        Raises:
            StorageError: a newer companion has made the database.
        """
        await self._reconnection.keep(self._once)

    async def _once(self) -> str:
        """One connection to both, to its end; why it has ended."""
        import aiomqtt

        await asyncio.to_thread(self.store.prepare)
        reached = False
        try:
            password = await asyncio.to_thread(read_password, self.settings)
            async with connected(self._client(password)) as client:
                reached = True
                await self._serve(client)
        except LinkError as error:
            return str(error)
        except CompanionError:
            raise
        except (aiomqtt.MqttError, OSError, TimeoutError) as error:
            if not reached and self._protocol == _MQTT_5 and is_of_protocol(error):
                # Too old for MQTT 5: it says so, or says nothing, or closes the connection.
                self._protocol = _MQTT_3_1_1
                return f"{self.where}: no MQTT 5 there, so one collector only; going on with MQTT 3.1.1"
            self._protocol = _MQTT_5
            return f"{self.where}: {explain(error, self.settings, self.client_id, reached=reached)}"
        finally:
            self.store.close()
        return f"{self.where}: the connection has ended"

    def _client(self, password: str | None) -> aiomqtt.Client:
        import aiomqtt
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = None
        if self._protocol == _MQTT_5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.MaximumPacketSize = 2 * MOST_BYTES
        return aiomqtt.Client(
            self.settings.host,
            self.settings.broker_port,
            username=self.settings.username,
            password=password,
            identifier=self.client_id,
            protocol=aiomqtt.ProtocolVersion(self._protocol),
            clean_session=True if properties is None else None,
            keepalive=self.settings.keepalive_s,
            properties=properties,
            timeout=ANSWER_S,
            tls_context=tls_context(self.settings),
            max_queued_incoming_messages=WAITING,
            queue_type=Waiting,
            logger=_quiet,
        )

    async def _serve(self, client: aiomqtt.Client) -> None:
        items, hellos = Inbox(BATCH), Inbox(BATCH)
        tasks = [
            asyncio.create_task(self._hear(client, items, hellos), name="fleet listener"),
            asyncio.create_task(self._collect(client, items, 1), name="fleet writer"),
            asyncio.create_task(self._collect(client, hellos, ASK_AFTER), name="fleet asker"),
            asyncio.create_task(self._subscribe(client), name="fleet subscriptions"),
            asyncio.create_task(self._judge(), name="fleet judgement"),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
        finally:
            ended = await stop(tasks)
        for end in ended:
            if isinstance(end, Exception):
                raise end

    async def _subscribe(self, client: aiomqtt.Client) -> None:
        alone = self._protocol == _MQTT_3_1_1
        shared = "" if alone else _SHARED
        for topic in (shared + _ITEM, shared + _HELLO):
            await self._hear_of(client, topic)
        words = "MQTT 3.1.1: no other collector beside this one" if alone else "MQTT 5"
        self._reconnection.up(f"{self.where} ({words}) into {self.store.where}")
        if not alone:
            # What was said before is not told to those who share.
            await self._hear_of(client, _HELLO, qos=0)
            await asyncio.sleep(SWEEP_S)
            await client.unsubscribe(_HELLO)
        await asyncio.get_running_loop().create_future()

    async def _hear_of(self, client: aiomqtt.Client, topic: str, qos: int = 1) -> None:
        granted = await client.subscribe(topic, qos=qos)
        if any(getattr(code, "value", code) >= 128 for code in granted):
            raise LinkError(f"{self.where}: the broker does not let us hear {topic} (its access list?)")

    async def _hear(
        self, client: aiomqtt.Client, items: asyncio.Queue[Message], hellos: asyncio.Queue[Message]
    ) -> None:
        async for message in client.messages:
            if isinstance(message.payload, bytes):
                topic = message.topic.value
                inbox = hellos if topic.endswith("/hello") else items
                await inbox.put(Message(topic, message.payload, bool(message.retain)))

    async def _collect(self, client: aiomqtt.Client, inbox: asyncio.Queue[Message], times: int) -> None:
        while True:
            batch = [await inbox.get()]
            for _ in range(times):
                if inbox.qsize() < BATCH - 1:
                    await asyncio.sleep(GATHER_S)
            with contextlib.suppress(asyncio.QueueEmpty):
                while len(batch) < BATCH:
                    batch.append(inbox.get_nowait())
            await self._answer(client, await asyncio.to_thread(self.store.take, batch))

    async def _judge(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            found = await asyncio.to_thread(self.store.judge)
            await asyncio.sleep(REST * (loop.time() - began_s) if found else JUDGE_S)

    async def _answer(self, client: aiomqtt.Client, outcome: Outcome) -> None:
        # A confirmation that gets lost is given again, as the item is told again.
        said = [
            (f"fleet/{aircraft}/confirmed", payload, 0)
            for (aircraft, epoch), sequences in outcome.confirmed.items()
            for payload in answers(epoch, ranges(sequences))
        ]
        said += [
            (f"fleet/{aircraft}/wanted", payload, 1)
            for (aircraft, epoch), lacking in outcome.wanted.items()
            for payload in answers(epoch, lacking)
        ]
        if outcome.rejected:
            message, reason = outcome.rejected[0]
            logger.warning("fleet: %s: not taken: %s (table rejected has it)", message.topic, reason)
        # One timer for some: theirs would cost as much as sending.
        publish = functools.partial(client.publish, timeout=math.inf)
        for some in (said[k : k + AT_ONCE] for k in range(0, len(said), AT_ONCE)):
            async with asyncio.timeout(ANSWER_S):
                await asyncio.gather(*(publish(topic, payload, qos=qos) for topic, payload, qos in some))
