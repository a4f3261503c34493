"""Sender of an aircraft's results to the fleet: saves them as numbered items, and sends each until it is confirmed.

The confirmation comes from a collector. The broker's acknowledgement is not enough: a broker may lose a message before
a collector reads it. A collector that was restored from a backup requests the items that it lacks.
"""

from __future__ import annotations

import asyncio
import datetime
import logging
import math
import re
from collections import deque
from collections.abc import Awaitable, Callable
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from companion.config.sections import Fleet, Location
from companion.errors import CompanionError
from companion.formats import Object, decode, utc_now
from companion.links.system.events import comes
from companion.messages import message
from companion.mqtt.client import Incoming, MqttLink
from companion.mqtt.daemon import Daemon
from companion.mqtt.fleet_sources import CurrentAircraft, Sources, utc
from companion.storage.fleet_items import Clock, FleetItems, Kept, Mark, Range, SourceItems, Waiting
from companion.storage.state import UNREADABLE

logger = logging.getLogger(__name__)

COLLECT_EVERY_S: Final = 2.0
BATCH: Final = 20  # Most entries read from the disk at once: a whole history may be unread
WINDOW: Final = 8  # Most items that are sent before any of them is confirmed
CONFIRMED_WITHIN_S: Final = 30.0
LONGEST_WAIT_S: Final = 600.0
HELLO_AGAIN_S: Final = 10.0
SENT_WITHIN_S: Final = 1.0
PAUSE_S: Final = 0.05
CURVES_AFTER_S: Final = 60.0  # Delay of the first curves of bias over temperature, which are slow to compute
CURVES_EVERY_S: Final = 6 * 3600.0
INBOX: Final = 64
AIRCRAFT_MARK, CURVE_MARKS = "aircraft", "curve/"

FORMAT_VERSION: Final = 1
MOST_RANGES: Final = 256  # Most ranges of sequences in one message to an aircraft
MOST_SEQUENCE: Final = 2**53

_Sequence = Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]
_Ranges = Annotated[list[tuple[_Sequence, _Sequence]], msgspec.Meta(max_length=MOST_RANGES)]

_ROUNDED: Final[dict[str, int]] = {
    "latitude_deg": 2,
    "longitude_deg": 2,
    "height_m": -2,
    "gravity_m_s2": 3,
    "declination_deg": 1,
    "field_gauss": 3,
    "field_expected_gauss": 3,
    "inclination_deg": 1,
    "inclination_expected_deg": 1,
}
"""Decimals of sent figures that reveal the location (gravity, magnetic field, ...): rounded, they show it to 1 km."""
_WORKED_OUT: Final[dict[str, object]] = {"covariance": None, "effective": None}
"""Values sent in place of figures whose digits would reveal the local gravity and the latitude."""
_EARTHS: Final = re.compile(r"(the Earth's) [\d.]+")


class AircraftFleet:
    """Fleet client of one companion: sends items of the present aircraft, and stored items of earlier aircraft.

    `link` returns the connection to the broker, or None. `offload` runs a blocking call in a thread. `run` is a task.
    """

    def __init__(
        self,
        settings: Fleet,
        directory: Path,
        daemon: Daemon,
        link: Callable[[], MqttLink | None],
        offload: Callable[..., Awaitable[Any]] = asyncio.to_thread,
    ) -> None:
        self._settings, self._daemon, self._current_link, self._offload = settings, daemon, link, offload
        self._items = FleetItems(directory)
        self._sources = Sources(directory, self._items)
        self._inbox: deque[Incoming] = deque(maxlen=INBOX)
        self._woken = asyncio.Event()
        self._kept: list[Kept] = []
        self._aircraft: str | None = None
        self._has_news = True
        self._caught_up = False  # True once the files that earlier runs left were read
        self._started_s = 0.0
        self._curves_s = math.inf
        self._connection: tuple[MqttLink, int] | None = None
        self._greeted: dict[str, int] = {}
        """Last item number announced by a hello in this connection, by aircraft; -1: a new hello must be sent."""
        self._hello_s = 0.0
        self._under_way: set[tuple[str, int]] = set()
        self._sent = 0
        self._expires_s = 0.0
        self._wait_s = CONFIRMED_WITHIN_S
        self._problem: str | None = None

    def status(self) -> Object:
        waiting = sum(kept.waiting for kept in self._kept)
        confirmed_at = max((kept.confirmed_at for kept in self._kept if kept.confirmed_at), default=None)
        last = "never confirmed so far" if confirmed_at is None else f"last confirmed {confirmed_at[:16]}Z"
        words = message("fleet_waiting", items=f"{waiting or 'no'} item{'' if waiting == 1 else 's'}", confirmed=last)
        if self._problem is not None:
            words = f"{words}; {self._problem}"
        elif self._nameless:
            words = message("fleet_not_sent", reason="the autopilot has no unique id (AUTOPILOT_VERSION)")
        return {
            "good": self._problem is None and not self._nameless,
            "summary": words,
            "aircraft": self._aircraft,
            "waiting": waiting,
            "confirmed_at": confirmed_at,
            "kept": [kept._asdict() for kept in self._kept],
        }

    @property
    def _nameless(self) -> bool:
        vehicle = self._daemon.vehicle
        return bool(vehicle.get("version_known")) and vehicle["uid"] is None

    def on_message(self, message: Incoming) -> None:
        """Queue a message of a collector; ignore a retained one, because it would return at every connection."""
        if message.topic.startswith("fleet/") and not message.retained:
            self._inbox.append(message)
            self._woken.set()

    async def run(self) -> None:
        """Save and send items until cancelled; faults show in `status` and are never raised."""
        self._started_s = asyncio.get_running_loop().time()
        self._curves_s = self._started_s + CURVES_AFTER_S
        try:
            while True:
                problems = [
                    await self._try(step) for step in (self._read_answers, self._collect, self._greet, self._send)
                ]
                self._problem = next((each for each in problems if each is not None), None)
                self._woken.clear()
                if not self._inbox:
                    await comes(self._woken, COLLECT_EVERY_S)
        finally:
            self._items.close()

    async def _try(self, step: Callable[[], Awaitable[None]]) -> str | None:
        """Run a step and return its error as text: a failure to save items must not block sending, nor vice versa."""
        try:
            await step()
        except Exception as error:
            is_known = isinstance(error, CompanionError)
            words = str(error) if is_known else f"internal error: {error!r}"
            if words != self._problem:
                logger.warning("fleet: %s", words, exc_info=not is_known)
            return words
        return None

    # --- collecting

    async def _collect(self) -> None:
        if not self._caught_up:
            marks = await self._offload(self._items.marks, AIRCRAFT_MARK)
            self._aircraft = marks[AIRCRAFT_MARK].value if marks else None
            await self._count()
            if self._aircraft is not None:
                # Results of an earlier run belong to the aircraft of that run.
                await self._collect_all(CurrentAircraft(self._aircraft, None, self._clock()))
            self._caught_up = True
        uid, system_id = self._daemon.vehicle.get("uid"), self._daemon.vehicle.get("system_id")
        if uid is None:
            return
        current = CurrentAircraft(uid, system_id, self._clock())
        if uid != self._aircraft:
            moved = [current.item("event", utc_now(), {"what": "airframe changed", "before": self._aircraft})]
            await self._add(
                uid, [SourceItems({AIRCRAFT_MARK: Mark("", uid)}, moved if self._aircraft is not None else [])]
            )
            self._aircraft = uid
        self._has_news |= await self._offload(self._sources.has_news)
        if self._has_news:
            await self._collect_all(current)
            self._has_news = False
        now_s = asyncio.get_running_loop().time()
        if now_s >= self._curves_s:
            self._curves_s = now_s + CURVES_EVERY_S
            await self._collect_curves(current)

    async def _collect_all(self, current: CurrentAircraft) -> None:
        batch: list[SourceItems] = [SourceItems({})] * BATCH
        while len(batch) == BATCH:
            batch = await self._offload(lambda: list(islice(self._sources.entries(current), BATCH)))
            await self._add(current.aircraft, batch)
            # An old history is not urgent.
            await asyncio.sleep(PAUSE_S)

    async def _add(self, aircraft: str, entries: list[SourceItems]) -> None:
        if entries:
            await self._offload(self._items.add, aircraft, entries, utc(utc_now()))
            await self._count()

    async def _collect_curves(self, current: CurrentAircraft) -> None:
        marks = await self._offload(self._items.marks, f"{CURVE_MARKS}{current.aircraft}/")
        entries = []
        reply = await self._daemon.result({"command": "temperature", "face": "fleet"})
        for imu in reply["imus"]:
            body = {key: imu[key] for key in ("imu", "power_ups", "days", "curve", "accel_curve")}
            key, mark = f"{CURVE_MARKS}{current.aircraft}/{imu['imu']}", Mark("", imu["summary"])
            if imu["curve"] and marks.get(key) != mark:
                entries.append(SourceItems({key: mark}, [current.item("curve", utc_now(), body)]))
        await self._add(current.aircraft, entries)

    def _clock(self) -> Callable[[str], Clock]:
        """Return a function that rates a timestamp: "good" if made since our start and GNSS time confirms the clock."""
        run_s = asyncio.get_running_loop().time() - self._started_s
        began = datetime.datetime.now(tz=datetime.UTC) - datetime.timedelta(seconds=run_s)
        since, agrees = began.isoformat(timespec="milliseconds"), self._daemon.clock_agrees
        return lambda at: "good" if agrees and at >= since else "unknown"

    async def _count(self) -> None:
        self._kept = await self._offload(self._items.aircraft)

    # --- answers of the collector

    async def _read_answers(self) -> None:
        if not self._inbox:
            return
        while self._inbox:
            message = self._inbox.popleft()
            said = parse(message.payload)
            for kept in self._kept:
                if said is not None and message.topic in _answer_topics(kept.aircraft):
                    await self._handle_answer(kept.aircraft, *said, confirmed=message.topic.endswith("/confirmed"))
        await self._count()

    async def _handle_answer(self, aircraft: str, epoch: str, sequences: list[Range], *, confirmed: bool) -> None:
        if confirmed:
            if await self._offload(self._items.confirm, aircraft, epoch, sequences, utc(utc_now())):
                self._under_way -= {
                    (of, sequence)
                    for of, sequence in self._under_way
                    if of == aircraft and any(first <= sequence <= last for first, last in sequences)
                }
                if self._wait_s > CONFIRMED_WITHIN_S:
                    self._begin_again()  # a collector is connected again: send in order, from the first item
        elif await self._offload(self._items.confirm, aircraft, epoch, sequences, None) and sequences:
            self._begin_again()
        else:
            self._greeted[aircraft] = -1

    # --- sending

    @property
    def _link(self) -> MqttLink | None:
        link = self._current_link()
        return link if link is not None and link.connected else None

    async def _greet(self) -> None:
        """Subscribe to the collectors' answers and send a hello, at every connection and after new items."""
        link, now_s = self._link, asyncio.get_running_loop().time()
        if link is None:
            return
        if self._connection != (link, link.connections):
            self._connection = (link, link.connections)
            self._greeted.clear()
            self._begin_again()
        news = [kept for kept in self._kept if self._greeted.get(kept.aircraft) != kept.last]
        if now_s - self._hello_s < HELLO_AGAIN_S and all(kept.aircraft in self._greeted for kept in news):
            return
        for kept in news:
            for topic in _answer_topics(kept.aircraft):
                await link.subscribe(topic)
            hello = {
                "format_version": FORMAT_VERSION,
                "aircraft": kept.aircraft,
                "name": self._settings.name if kept.aircraft == self._aircraft else None,
                "epoch": kept.epoch,
                "first": kept.first,
                "last": kept.last,
                "at": utc(utc_now()),
            }
            link.outbox.keep(f"fleet/{kept.aircraft}/hello", msgspec.json.encode(hello), again=True)
            self._greeted[kept.aircraft], self._hello_s = kept.last, now_s

    def _begin_again(self) -> None:
        self._under_way.clear()
        self._sent, self._wait_s = 0, CONFIRMED_WITHIN_S

    async def _send(self) -> None:
        """Send the next few items once all items sent before are confirmed or have timed out.

        After the last item, sending restarts at the first unconfirmed one, so that no item blocks the others.
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
            topic = f"fleet/{waiting.aircraft}/item"
            link.outbox.answer(topic, encode_item(waiting, self._settings.location), droppable=True)
        self._under_way = {(waiting.aircraft, waiting.sequence) for waiting in batch}
        self._sent = batch[-1].number if batch else 0
        self._expires_s = now_s + self._wait_s


def _answer_topics(aircraft: str) -> tuple[str, str]:
    return f"fleet/{aircraft}/confirmed", f"fleet/{aircraft}/wanted"


# --- payloads: docs/fleet/asyncapi.yaml


def parse(payload: bytes) -> tuple[str, list[Range]] | None:
    """Parse a collector's message: id of the numbering (epoch), and ranges of item numbers; None: it is invalid."""
    try:
        said = decode(payload, dict[str, Any], FORMAT_VERSION)
        epoch, sequences = msgspec.convert((said.get("epoch"), said.get("sequences")), tuple[str, _Ranges])
    except UNREADABLE:
        return None
    return (epoch, sequences) if all(first <= last for first, last in sequences) else None


def encode_item(waiting: Waiting, location: Location) -> bytes:
    item = waiting.item
    try:
        body = msgspec.json.decode(item.body)
    except UNREADABLE:
        body = {}  # damaged on the disk
    return msgspec.json.encode(
        {
            "format_version": FORMAT_VERSION,
            "aircraft": waiting.aircraft,
            "epoch": waiting.epoch,
            "sequence": waiting.sequence,
            "kind": item.kind,
            "at": item.at,
            "clock": item.clock,
            "body": body if location == "full" else _less_place(body, location),
        }
    )


def _less_place(value: Any, location: Location, key: str = "") -> Any:
    if isinstance(value, list):
        return [_less_place(each, location, key) for each in value]
    if isinstance(value, dict):
        return {
            name: _WORKED_OUT[name] if name in _WORKED_OUT else _less_place(each, location, name)
            for name, each in value.items()
        }
    if isinstance(value, str):
        return _EARTHS.sub(r"\1 ?", value)
    if key in _ROUNDED:
        return None if location == "off" or value is None else round(value, _ROUNDED[key])
    # A sigma is significant to two digits; more would reveal the latitude (see `_WORKED_OUT`).
    return float(f"{value:.2g}") if "sigma" in key and isinstance(value, float) else value
