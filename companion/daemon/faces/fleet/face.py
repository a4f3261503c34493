"""Keeps what the fleet is to know, and sends it by the broker's connection until a collector has confirmed it.

The broker's receipt frees nothing: a broker may be wiped before a collector has looked. What is not confirmed in time
is sent again; what a collector lacks although it had it (restored from a backup) it asks for.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
from collections import deque
from collections.abc import Callable
from itertools import islice
from typing import Final

import msgspec

from companion.config.sections import Fleet
from companion.daemon.core import Core, Handler
from companion.daemon.faces.fleet import wire
from companion.daemon.faces.fleet.sources import Look, Sources, utc
from companion.daemon.faces.mqtt.face import MqttFace
from companion.errors import StorageError
from companion.formats import Object
from companion.links.mqtt.client import Incoming, MqttLink
from companion.links.system.waiting import comes
from companion.storage.fleet_items import Clock, Entry, FleetItems, Item, Kept, Mark

logger = logging.getLogger(__name__)

FIRST_LOOK_S: Final = 10.0
"""After the start, which comes first."""
LOOK_S: Final = 2.0
BATCH: Final = 20
"""Of what is taken from the disk at once; a whole history may wait there."""
WINDOW: Final = 8
"""The most items under way without a confirmation."""
CONFIRMED_WITHIN_S: Final = 30.0
LONGEST_WAIT_S: Final = 600.0
HELLO_AGAIN_S: Final = 10.0
SENT_WITHIN_S: Final = 1.0
CURVES_EVERY_S: Final = 6 * 3600.0
CLOCKS_AGREE_S: Final = 2.0
INBOX: Final = 64
AIRCRAFT, CURVE = "aircraft", "curve/"
"""Marks: of which one the last was, and the curve that was told last."""


class FleetFace:
    """One aircraft's part of the fleet, and what is left of others that had this companion; `run` it."""

    def __init__(self, core: Core, settings: Fleet, mqtt: MqttFace, answer: Handler) -> None:
        self._settings, self._mqtt, self._answer = settings, mqtt, answer
        self._vehicle, self._offload = core.vehicle, core.offload
        self._only_listening = core.only_listening is not None
        self._items = FleetItems(core.config.storage.path)
        self._sources = Sources(core.config.storage.path, self._items)
        self._inbox: deque[Incoming] = deque(maxlen=INBOX)
        self._woken = asyncio.Event()
        self._kept: list[Kept] = []
        self._of: str | None = None
        """The aircraft that what is found is of."""
        self._news = True
        self._caught_up = False
        """What earlier runs have left was taken."""
        self._started_s = self._curves_s = 0.0
        self._greeted: tuple[MqttLink, int] | None = None
        self._hello_s = 0.0
        self._under_way: set[tuple[str, int]] = set()
        self._sent = 0
        """The number of the last one under way."""
        self._expires_s = 0.0
        self._wait_s = CONFIRMED_WITHIN_S
        self._problem: str | None = None
        self._faulty = False
        mqtt.on_other.add(self._on_message)

    def status(self) -> Object:
        """For `companion status` and `check`."""
        waiting = sum(kept.waiting for kept in self._kept)
        confirmed_at = max((kept.confirmed_at for kept in self._kept if kept.confirmed_at), default=None)
        told = "never confirmed so far" if confirmed_at is None else f"last confirmed {confirmed_at[:16]}Z"
        words = f"{waiting or 'no'} item{'' if waiting == 1 else 's'} waiting for the fleet, {told}"
        if self._only_listening:
            words = "what waits for the fleet is told while the companion runs"
        elif self._problem is not None:
            words = f"{words}; {self._problem}"
        elif self._nameless:
            words = "the autopilot tells no unique id (AUTOPILOT_VERSION): nothing is kept for the fleet"
        return {
            "good": self._problem is None and not self._nameless,
            "summary": words,
            "aircraft": self._of,
            "waiting": waiting,
            "confirmed_at": confirmed_at,
            "kept": [kept._asdict() for kept in self._kept],
        }

    @property
    def _nameless(self) -> bool:
        return self._vehicle.version is not None and self._vehicle.uid is None

    def _on_message(self, message: Incoming) -> None:
        # A retained one would come back at every connection.
        if message.topic.startswith("fleet/") and not message.retained:
            self._inbox.append(message)
            self._woken.set()

    async def run(self) -> None:
        """Keep and send until cancelled; never raises anything else."""
        self._started_s = asyncio.get_running_loop().time()
        try:
            await asyncio.sleep(FIRST_LOOK_S)
            while True:
                await self._look()
                self._woken.clear()
                if not self._inbox:
                    await comes(self._woken, LOOK_S)
        finally:
            self._items.close()

    async def _look(self) -> None:
        try:
            await self._listen()
            await self._take()
            await self._greet()
            await self._send()
            self._problem, self._faulty = None, False
        except StorageError as error:
            if str(error) != self._problem:
                self._problem = str(error)
                logger.warning("fleet: %s", error)
            await asyncio.sleep(LOOK_S)
        except Exception:
            # Said once, not at every look.
            logger.log(logging.DEBUG if self._faulty else logging.ERROR, "fleet", exc_info=True)
            self._faulty = True
            await asyncio.sleep(LOOK_S)

    # --- keeping

    async def _take(self) -> None:
        if self._of is None:
            marks = await self._offload(self._items.marks, AIRCRAFT)
            self._of = marks[AIRCRAFT].value if marks else None
            await self._count()
        if self._of is not None and not self._caught_up:
            # What an earlier run has left is of the aircraft that there was then.
            await self._take_all(self._of, None)
        self._caught_up = True
        uid = self._vehicle.uid
        if uid is None:
            return
        is_first = self._of is None
        if uid != self._of:
            body = {"what": "airframe changed", "before": self._of}
            event = Item("event", _utc_now(), self._clock()(_now()), msgspec.json.encode(body))
            entry = Entry({AIRCRAFT: Mark("", uid)}, () if is_first else (event,))
            await self._offload(self._items.add, uid, (entry,), _utc_now())
            self._of, self._curves_s = uid, 0.0
            await self._count()
        self._news |= await self._offload(self._sources.has_news)
        if self._news:
            await self._take_all(uid, self._vehicle.system_id)
            self._news = False
        now_s = asyncio.get_running_loop().time()
        if now_s >= self._curves_s:
            self._curves_s = now_s + CURVES_EVERY_S
            await self._take_curves(uid)

    async def _take_all(self, aircraft: str, system_id: int | None) -> None:
        look = Look(aircraft, system_id, self._clock())

        def take() -> bool:
            batch = list(islice(self._sources.entries(look), BATCH))
            if batch:
                self._items.add(aircraft, batch, _utc_now())
            return len(batch) == BATCH

        while await self._offload(take):
            # A history is no hurry: the calibration has the processor.
            await asyncio.sleep(SENT_WITHIN_S / BATCH)
        await self._count()

    async def _take_curves(self, aircraft: str) -> None:
        """The curves of biases over temperature, where they are others than were told last."""
        marks = await self._offload(self._items.marks, f"{CURVE}{aircraft}/")
        entries = []
        async for reply in self._answer({"command": "temperature"}, "fleet"):
            for imu in reply["imus"]:
                body = {key: imu[key] for key in ("imu", "power_ups", "days", "curve", "accel_curve")}
                key, mark = f"{CURVE}{aircraft}/{imu['imu']}", Mark("", f"{imu['power_ups']} {imu['summary']}")
                if imu["curve"] and marks.get(key) != mark:
                    item = Item("curve", _utc_now(), self._clock()(_now()), msgspec.json.encode(body))
                    entries.append(Entry({key: mark}, (item,)))
        if entries:
            await self._offload(self._items.add, aircraft, entries, _utc_now())
            await self._count()

    def _clock(self) -> Callable[[str], Clock]:
        """How good our clock is: good if the autopilot's GNSS agrees, for whatever it has timed in this run."""
        unix_s, now = self._vehicle.place.unix_time_s, datetime.datetime.now(tz=datetime.UTC)
        run_s = asyncio.get_running_loop().time() - self._started_s
        since = (now - datetime.timedelta(seconds=run_s)).isoformat(timespec="milliseconds")
        agrees = unix_s is not None and abs(unix_s - now.timestamp()) < CLOCKS_AGREE_S
        return lambda at: "good" if agrees and at >= since else "unknown"

    async def _count(self) -> None:
        self._kept = await self._offload(self._items.aircraft)

    # --- hearing

    async def _listen(self) -> None:
        heard = bool(self._inbox)
        while self._inbox:
            message = self._inbox.popleft()
            said = wire.parse(message.payload)
            for kept in self._kept:
                if said is not None and message.topic in wire.Topics(kept.aircraft).heard:
                    await self._heed(kept.aircraft, said, confirmed=message.topic.endswith("/confirmed"))
        if heard:
            await self._count()

    async def _heed(self, aircraft: str, said: wire.Said, *, confirmed: bool) -> None:
        if confirmed:
            if await self._offload(self._items.confirm, aircraft, said.epoch, said.sequences, _utc_now()):
                self._under_way = {one for one in self._under_way if one[0] != aircraft or not said.names(one[1])}
                if self._wait_s > CONFIRMED_WITHIN_S:
                    self._begin_again()  # somebody is there again: in order, from the first
        elif await self._offload(self._items.want, aircraft, said.epoch, said.sequences) and said.sequences:
            self._begin_again()
        elif asyncio.get_running_loop().time() - self._hello_s >= HELLO_AGAIN_S:
            self._greeted = None

    # --- sending

    @property
    def _link(self) -> MqttLink | None:
        link = self._mqtt.link
        return link if link is not None and link.connected else None

    async def _greet(self) -> None:
        """At every connection: listen for the fleet, and say what is kept."""
        link = self._link
        if link is None or (self._greeted == (link, link.connections) and self._is_heard(link)):
            return
        for kept in self._kept:
            topics = wire.Topics(kept.aircraft)
            for topic in topics.heard:
                await link.hear(topic)
            link.outbox.keep(topics.hello, wire.hello(kept, self._settings.name, _utc_now()))
        if self._greeted != (link, link.connections):
            self._begin_again()
        self._greeted, self._hello_s = (link, link.connections), asyncio.get_running_loop().time()

    def _is_heard(self, link: MqttLink) -> bool:
        return all(link.outbox.kept(wire.Topics(kept.aircraft).hello) is not None for kept in self._kept)

    def _begin_again(self) -> None:
        self._under_way.clear()
        self._sent, self._wait_s = 0, CONFIRMED_WITHIN_S

    async def _send(self) -> None:
        """The next few, once the last few are confirmed, or have not been in time.

        Then the next ones are sent all the same, and after the last the first again: one item that a collector does
        not take holds up no other.
        """
        link, now_s = self._link, asyncio.get_running_loop().time()
        if link is None or not any(kept.waiting for kept in self._kept):
            return
        if self._under_way:
            if now_s < self._expires_s:
                return
            self._wait_s = min(2.0 * self._wait_s, LONGEST_WAIT_S)
        if not await comes(link.outbox.emptied, SENT_WITHIN_S):
            return
        batch = await self._offload(self._items.waiting, self._sent, WINDOW)
        if not batch and self._sent:
            batch = await self._offload(self._items.waiting, 0, WINDOW)
        for waiting in batch:
            topic = wire.Topics(waiting.aircraft).item
            link.outbox.answer(topic, wire.item(waiting, self._settings.location), droppable=True)
        self._under_way = {(waiting.aircraft, waiting.sequence) for waiting in batch}
        self._sent = batch[-1].number if batch else 0
        self._expires_s = now_s + self._wait_s


def _now() -> str:
    return datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds")


def _utc_now() -> str:
    return utc(_now())
