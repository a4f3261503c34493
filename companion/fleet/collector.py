"""Collector of a fleet: receives items of aircraft (calibrations, armings, ...) by MQTT, stores and confirms them.

A collector stores everything in the database. If the broker or the database fails, both connections end. Aircraft
resend unconfirmed items, and at each new connection the collector requests the items that the database lacks.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import math
import secrets
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from companion.config import converted, read
from companion.config.rules import broker_complaints
from companion.config.sections import Mqtt
from companion.errors import ConfigError
from companion.fleet.contract import MOST_BYTES, answers, ranges
from companion.fleet.store import BatchResult, Store
from companion.links.system.connection import Reconnection
from companion.mqtt.broker import MQTT_3_1_1, Broker, subscribe
from companion.mqtt.client import FIRST_WAIT_S, LONGEST_WAIT_S, WORTH_S, Incoming

if TYPE_CHECKING:
    import aiomqtt

logger = logging.getLogger(__name__)

BATCH: Final = 500
GATHER_S: Final = 0.1
ASK_AFTER: Final = 50
"""Delay from a hello to the request for missing items, in units of `GATHER_S`: items already sent arrive meanwhile."""
WAITING: Final = 20 * BATCH
"""Largest number of received messages that wait to be stored; more are dropped, and the aircraft resend them."""
WAITING_BYTES: Final = 16 * 1024 * 1024
BATCH_BYTES: Final = 4 * 1024 * 1024  # Most bytes stored at once; a database makes several copies of them
AT_ONCE: Final = 50  # Answers sent concurrently; the time that aiomqtt needs for each grows with their number
SWEEP_S: Final = 5.0  # Time for the broker to deliver retained hellos, which needs an unshared subscription
JUDGE_S: Final = 2.0
REST: Final = 4.0  # Pause after a judgement, as a multiple of its duration: collecting has priority
ANSWER_S: Final = 10.0
STOP_AGAIN_S: Final = 0.5
_HELLO: Final = "fleet/+/hello"
_ITEM: Final = "fleet/+/item"
_SHARED: Final = "$share/collectors/"


class _Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    mqtt: Mqtt


def load_broker(path: Path) -> Mqtt:
    """Read the settings of the broker, section [mqtt], from a collector's configuration file.

    Raises:
        ConfigError: one line that names the file, the key, the value found and the values allowed.
    """
    mqtt = converted(read(path, "write one with a section [mqtt] that names the broker"), str(path), _Settings).mqtt
    for wrong in broker_complaints(mqtt):
        raise ConfigError(f"{path}: {wrong}")
    return mqtt


async def stop(tasks: Iterable[asyncio.Task[None]]) -> list[BaseException]:
    """Cancel tasks again and again until they have ended; return their exceptions.

    One cancellation is not enough: aiomqtt uses `asyncio.wait_for`, which before Python 3.12 loses a cancellation that
    arrives together with the result.
    """
    pending = found = set(tasks)
    while pending:
        for task in pending:
            task.cancel()
        _, pending = await asyncio.wait(pending, timeout=STOP_AGAIN_S)
    return [end for end in await asyncio.gather(*found, return_exceptions=True) if end is not None]


class BoundedMessages(asyncio.Queue[Any]):
    """Queue of received messages, limited in number and in bytes, because one message may have 256 KiB."""

    def __init__(self, maxsize: int = WAITING, most_bytes: int = WAITING_BYTES) -> None:
        super().__init__(maxsize)
        self._bytes, self._most_bytes = 0, most_bytes

    def full(self) -> bool:
        return super().full() or self._bytes >= self._most_bytes

    def _put(self, item: Any) -> None:
        super()._put(item)
        self._bytes += len(item.payload or b"")

    def _get(self) -> Any:
        item = super()._get()
        self._bytes -= len(item.payload or b"")
        return item


class Collector:
    """Collector of items from one broker; several collectors may share the broker. Start `run` as a task."""

    def __init__(self, settings: Mqtt, store: Store) -> None:
        self.store = store
        client_id = settings.client_id or f"collector-{socket.gethostname()[:40]}-{secrets.token_hex(4)}"
        self._broker = Broker(settings, client_id)
        self._reconnection = Reconnection("fleet", worth_s=WORTH_S, first_s=FIRST_WAIT_S, cap_s=LONGEST_WAIT_S)

    async def run(self) -> None:
        """Receive and store items until cancelled.

        Raises:
            StorageError: the database has tables of another version of the companion.
        """
        await self._reconnection.keep(self._once)

    async def _once(self) -> str:
        options = {"timeout": ANSWER_S, "max_queued_incoming_messages": WAITING, "queue_type": BoundedMessages}
        try:
            await asyncio.to_thread(self.store.prepare)
            async with self._broker.connected(2 * MOST_BYTES, **options) as client:
                await self._serve(client)
        finally:
            self.store.close()
        return f"{self._broker.where}: the connection has ended"

    async def _serve(self, client: aiomqtt.Client) -> None:
        items, hellos = BoundedMessages(BATCH, BATCH_BYTES), BoundedMessages(BATCH, BATCH_BYTES)
        tasks = [
            asyncio.create_task(self._receive(client, items, hellos), name="fleet listener"),
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
        alone = self._broker.protocol == MQTT_3_1_1
        shared = "" if alone else _SHARED
        for topic in (_ITEM, _HELLO):
            await subscribe(client, shared + topic, qos=1)
        words = "MQTT 3.1.1: no other collector beside this one" if alone else "MQTT 5"
        self._reconnection.up(f"{self._broker.where} ({words}) into {self.store.where}")
        if not alone:
            # Shared subscriptions do not deliver retained hellos.
            await subscribe(client, _HELLO, qos=0)
            await asyncio.sleep(SWEEP_S)
            await client.unsubscribe(_HELLO)
        await asyncio.get_running_loop().create_future()

    async def _receive(
        self, client: aiomqtt.Client, items: asyncio.Queue[Incoming], hellos: asyncio.Queue[Incoming]
    ) -> None:
        async for message in client.messages:
            if isinstance(message.payload, bytes):
                topic = message.topic.value
                inbox = hellos if topic.endswith("/hello") else items
                await inbox.put(Incoming(topic, message.payload, bool(message.retain)))

    async def _collect(self, client: aiomqtt.Client, inbox: asyncio.Queue[Incoming], times: int) -> None:
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

    async def _answer(self, client: aiomqtt.Client, outcome: BatchResult) -> None:
        # QoS 0 for confirmations: an item whose confirmation is lost is sent again, and confirmed again.
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
        # One timer for all answers: a timer for each would cost as much as sending.
        publish = functools.partial(client.publish, timeout=math.inf)
        for some in (said[k : k + AT_ONCE] for k in range(0, len(said), AT_ONCE)):
            async with asyncio.timeout(ANSWER_S):
                await asyncio.gather(*(publish(topic, payload, qos=qos) for topic, payload, qos in some))
