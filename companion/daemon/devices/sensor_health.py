"""How one of our own sensors does: its port and its stream together, counted, and said once per change."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.seconds.batch import Batch
from companion.component.statustext import Say, Severity, Weight
from companion.links.serial.bytestream import ByteLink
from companion.links.system.listeners import Listeners
from companion.physics.frames import Array, Matrix
from companion.protocols.decoding.base import Decoder
from companion.protocols.stream_health import SILENT, SILENT_AFTER_S, StreamHealth, Trouble

if TYPE_CHECKING:
    from companion.daemon.devices.sensors import SerialSensor

logger = logging.getLogger(__name__)

ABSENT: Final = "absent"
FLOOD: Final = "flood"
FLOOD_S: Final = 1.0
RENEW_AFTER_S: Final = 2.5
"""A sensor that streams says something every second; so soon a connection over which nothing comes is made anew."""
RENEW_POLLED_AFTER_S: Final = 6.0
"""One that must be asked is given time to be asked, and to answer."""
GOOD_AFTER_S: Final = 1.0
AGAIN_S: Final = 60.0
"""How soon after its last line the same trouble is said in the detailed log only: a loose wire must not fill it."""
PERIOD_S: Final = 0.5
REMEMBERED_S: Final = 300
TILTED_DEG: Final = 3.0
"""Far more than the mean of a second in somebody's hands is off, and 300 steps of the coarsest gradienter."""
TILTED_SECONDS: Final = 3
BEFORE_S: Final = 3.0
"""How long before the first of its equal headings a compass may have begun to hang: until then it was near them."""
QUIET_S: Final = 3.0
"""An IMU that is so far behind the others is no witness: the autopilot's, while its offsets are being written."""
LATE_S: Final = 1.0
"""Nor is one that begins so much later than another: it has not seen how the aircraft stood."""
TURNED_DEG: Final = 15.0
TURNING_RAD_S: Final = math.radians(12.0)
"""Less may be a bias: what is called still may have 10 deg/s."""


class SensorHealth:
    """What is wrong with one sensor now, and how often what has been; `polled`: it speaks only when it is asked."""

    def __init__(self, link: ByteLink, kind: str, protocol: str, decoder: Decoder, *, polled: bool) -> None:
        self.link, self.kind, self.protocol = link, kind, protocol
        self.stream = StreamHealth(protocol, decoder)
        self.counts: Counter[str] = Counter()
        """How often each trouble has begun, and each event happened."""
        self._stuck: Trouble | None = None
        self.on_implausible: Listeners[Trouble] = Listeners()
        """Told, as often as the log, when its readings begin to look good without being so."""
        self._renew_after_s = RENEW_POLLED_AFTER_S if polled else RENEW_AFTER_S
        self._opened_s = self._grace_since_s = 0.0
        self._renewed = False
        self._said: str | None = None
        self._began_s = 0.0
        self._good_since_s: float | None = None
        self._told_s: dict[str, float] = {}
        self._received = (0.0, 0)
        self._bytes_per_s = 0.0

    def opened(self) -> None:
        """The port was opened (again)."""
        self._opened_s = asyncio.get_running_loop().time()
        if not self._renewed:
            self._grace_since_s = self._opened_s
        self._renewed = False
        self.stream.opened()
        timer_ms = self.link.latency_timer_ms
        if self.kind == "imu" and timer_ms is not None and timer_ms > 1:
            words = f"its FTDI bridge collects bytes for {timer_ms} ms, samples come in bunches (companion check)"
            self.stream.events.append(Trouble("slow bridge", words))

    def trouble(self, now_s: float) -> Trouble | None:
        """What is wrong with it, worst first; None while good samples come."""
        if not self.link.connected:
            words = self.link.last_error or f"{self.link.settings.url}: not open yet"
            return Trouble(SILENT if self._renewed else ABSENT, words)
        found = self._flood(now_s) or self.stream.trouble(now_s) or self._stuck
        if found is None:
            return None
        return Trouble(found.key, f"{line_of(self.link)}: {found.words}", found.implausible)

    def words(self, now_s: float) -> str | None:
        """What is wrong with it in one line, or None while good samples come."""
        found = self.trouble(now_s)
        return found.words if found is not None else None

    def _is_flooded(self, now_s: float) -> bool:
        budget = self.link.budget
        return budget is not None and budget.exceeded_s is not None and now_s - budget.exceeded_s < FLOOD_S

    def _flood(self, now_s: float) -> Trouble | None:
        if not self._is_flooded(now_s):
            return None
        rate = f"{self._bytes_per_s / 1e3:.0f} kB/s" if self._bytes_per_s else "too much"
        return Trouble(FLOOD, f"floods us ({rate}); the surplus is thrown away: another device, or a loop-back?")

    def look(self, now_s: float, stuck: Trouble | None = None) -> Trouble | None:
        """See how it does, count and say what has changed, and ask a silent peer anew; called about twice a second.

        `stuck`: its reading stays while the aircraft does not, as who sees the other sensors too has found.
        """
        self._stuck = stuck
        since_s, before = self._received
        if now_s - since_s >= 1.0:
            self._bytes_per_s = (self.link.bytes_received - before) / (now_s - since_s) if since_s else 0.0
            self._received = (now_s, self.link.bytes_received)
        for event in self.stream.events:
            self.counts[event.key] += 1
            self._tell(event, now_s)
        self.stream.events.clear()
        if self._is_flooded(now_s):
            # What of its frames is damaged is damaged by what was thrown away; two looks fall into FLOOD_S.
            self.stream.excuse()
        found = self.trouble(now_s)
        if found is None:
            # Whatever is open and speaks as configured is the right one.
            self.link.confirm()
        self._say(found, now_s)
        self._renew(now_s)
        return found

    def _say(self, found: Trouble | None, now_s: float) -> None:
        if found is None:
            if self._said is None:
                return
            if self._good_since_s is None:
                self._good_since_s = now_s
            if now_s - self._good_since_s >= GOOD_AFTER_S:
                logger.info("%s: good again after %.0f s", self.link.name, self._good_since_s - self._began_s)
                self._said = None
            return
        self._good_since_s = None
        if found.key == self._said:
            return
        if found.key == ABSENT or (now_s - self._grace_since_s < SILENT_AFTER_S and not found.implausible):
            return  # the port says itself that it is gone; and what was just opened has a moment to begin
        if self._said is None:
            self._began_s = now_s
        self._said = found.key
        self.counts[found.key] += 1
        if self._tell(found, now_s) and found.implausible:
            self.on_implausible.tell(found)

    def _tell(self, what: Trouble, now_s: float) -> bool:
        """In the log; whether in the ordinary one."""
        told_s = self._told_s.get(what.key)
        again = told_s is not None and now_s - told_s < AGAIN_S
        self._told_s[what.key] = now_s
        logger.log(
            logging.DEBUG if again else logging.WARNING, "%s: %s (%d so far)", self.link.name, what.words,
            self.counts[what.key],
        )  # fmt: skip
        return not again

    def _renew(self, now_s: float) -> None:
        """A peer behind tcp:// that vanished without a word, or that accepts and says nothing."""
        if not self.link.settings.is_tcp or not self.link.connected:
            return
        heard_s = max(self._opened_s, self.link.last_byte_s or 0.0)
        if now_s - heard_s >= self._renew_after_s:
            self.counts["renewed"] += 1
            self._renewed = True
            self.link.renew(f"silent for {now_s - heard_s:.1f} s, asked anew")

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        found = self.trouble(asyncio.get_running_loop().time())
        return {
            "trouble": found.key if found is not None else None,
            "counts": dict(self.counts),
            "protocol": self.protocol,
            "speaks": self.stream.speaks,
            "port": self.link.settings.url,
        }


def line_of(link: ByteLink) -> str:
    """The port and how it is set, for people."""
    port = link.settings
    return port.url if port.is_tcp else f"{port.url} at {port.baud} baud, parity {port.parity}"


class Corrected(NamedTuple):
    """What an owner has made of an IMU's readings."""

    back: Matrix = np.eye(3)
    """(3, 3), from the axes that it has turned them to into the IMU's own."""
    accel_m_s2: Array = np.zeros(3)
    """(3,), what it takes off the accelerometer, in the IMU's own axes."""


UNTOUCHED: Final = Corrected()


class MotionWitness:
    """Whether the aircraft has tilted or turned since some instant, as its IMUs saw it.

    In the IMUs' own axes: the angle between two directions of gravity, and the turn about it, need no mounting.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, deque[tuple[int, Array, float]]] = {}

    def look(self, latest: Mapping[str, Batch], corrected: Callable[[str], Corrected | None]) -> None:
        """Take note of the last whole second of each IMU.

        Args:
            latest: by IMU.
            corrected: what was done to its readings before they came to us; None while that is not known. It is taken
                back: new offsets, or another orientation of the board, must not look like a tilt.
        """
        for name, batch in latest.items():
            seconds = self._seconds.setdefault(name, deque(maxlen=REMEMBERED_S))
            known = corrected(name)
            if known is None or (seconds and seconds[-1][0] == batch.slot):
                continue
            rate, force = known.back @ batch.mean[:3], known.back @ batch.mean[3:] + known.accel_m_s2
            size = float(np.linalg.norm(force))
            if size > 0.0:
                down = force / size
                about = float(rate @ down)
                turned_deg = math.degrees(about) if abs(about) > TURNING_RAD_S else 0.0
                seconds.append((batch.slot, down, turned_deg))

    def tilted_deg(self, near_since_s: float, since_s: float, until_s: float) -> float:
        """By how much it has tilted and stayed so; the least that any IMU saw.

        Args:
            near_since_s: since when the sensor shows about what it shows now; the pose then is compared with.
            since_s: since when it shows exactly that; only what has stayed since then counts.
            until_s: its latest reading.
        """
        return min((self._tilted_deg(each, since_s) for each in self._heard(near_since_s, until_s)), default=0.0)

    @staticmethod
    def _tilted_deg(seconds: list[tuple[int, Array, float]], since_s: float) -> float:
        stayed = [down for slot, down, _ in seconds[1:] if slot >= since_s][-TILTED_SECONDS:]
        if len(stayed) < TILTED_SECONDS:
            return 0.0
        cosines = [float(seconds[0][1] @ down) for down in stayed]
        return math.degrees(math.acos(min(1.0, max(-1.0, *cosines))))

    def turned_deg(self, near_since_s: float, until_s: float) -> float:
        """By how much it has turned about the vertical; the least that any IMU saw."""
        turns = [abs(sum(turned_deg for *_, turned_deg in each)) for each in self._heard(near_since_s, until_s)]
        return min(turns, default=0.0)

    def _heard(self, since_s: float, until_s: float) -> list[list[tuple[int, Array, float]]]:
        """The whole seconds in between, of each IMU that has seen as much as the others."""
        # Not as the clock: while a sensor is implausible, nothing is collected of any IMU.
        newest = max((seconds[-1][0] for seconds in self._seconds.values() if seconds), default=0)
        found = [
            [second for second in seconds if since_s <= second[0] <= until_s - 1.0]
            for seconds in self._seconds.values()
            if seconds and seconds[-1][0] >= newest - QUIET_S
        ]
        first = min((seconds[0][0] for seconds in found if seconds), default=0)
        return [seconds for seconds in found if seconds and seconds[0][0] <= first + LATE_S]


class SensorWatch:
    """Looks at every sensor twice a second; `run` it beside them."""

    def __init__(
        self,
        sensors: Sequence[SerialSensor],
        collector: RollingCollector,
        corrected: Callable[[str], Corrected | None] = lambda name: UNTOUCHED,
        say: Say = lambda *what: None,
    ) -> None:
        self._sensors, self._collector = sensors, collector
        self._corrected = corrected
        self._witness = MotionWitness()
        self._has_failed = False
        self._say = say
        for sensor in sensors:
            sensor.health.on_implausible.add(functools.partial(self._tell, sensor))

    def _tell(self, sensor: SerialSensor, trouble: Trouble) -> None:
        """To the ground stations: no calibration comes to an end with it, and what was written with it may be wrong."""
        self._say(Severity.WARNING, f"{sensor.name}: {trouble.words.removeprefix(f'{sensor.line}: ')}", Weight.NEWS)

    async def run(self) -> None:
        """Look until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self.look(loop.time())
            except Exception:
                # What merely watches must not end what is watched, nor fill the log.
                if not self._has_failed:
                    logger.exception("looking after the sensors failed")
                self._has_failed = True
            await asyncio.sleep(PERIOD_S)

    def look(self, now_s: float) -> None:
        """One look at all of them."""
        self._witness.look(self._collector.imu_seconds(), self._corrected)
        for sensor in self._sensors:
            found = sensor.health.look(now_s, None if "imu" in sensor.kinds else self._stuck(sensor))
            if found is not None and found.implausible:
                self._collector.reset(f"{sensor.name}: {found.words}", sensor.name if sensor.kinds == {"imu"} else None)

    def _stuck(self, sensor: SerialSensor) -> Trouble | None:
        """A still gradienter or compass may repeat its digits for minutes; one that is moved may not."""
        since_s = sensor.health.stream.unchanged_since_s
        last_s = sensor.health.stream.last_sample_s
        if since_s is None or last_s is None:
            return None
        near_s = sensor.health.stream.near_since_s or since_s
        tilted_deg = self._witness.tilted_deg(near_s, since_s, last_s)
        # Turns are summed up, and what is not seen of one adds up likewise.
        near_s = max(near_s, since_s - BEFORE_S)
        turned_deg = self._witness.turned_deg(near_s, last_s) if "compass" in sensor.kinds else 0.0
        if turned_deg > TURNED_DEG:
            how = f"turned by {turned_deg:.0f} deg"
        elif tilted_deg > TILTED_DEG and "gradienter" in sensor.kinds:
            how = f"tilted by {tilted_deg:.0f} deg"
        else:
            return None
        words = f"stuck: the same reading for {last_s - since_s:.0f} s while the aircraft {how}"
        return Trouble("stuck", f"{words}; switch its power off and on", implausible=True)

    def implausible(self) -> str | None:
        """A sensor whose readings look good and are not, and why; None where there is none."""
        now_s = asyncio.get_running_loop().time()
        found = ((sensor.name, sensor.health.trouble(now_s)) for sensor in self._sensors)
        return next((f"{name}: {each.words}" for name, each in found if each is not None and each.implausible), None)

    def worst(self) -> str | None:
        """Of the sensor that troubles most what is wrong, with its name; None while all do well."""
        now_s = asyncio.get_running_loop().time()
        found = [(sensor.name, sensor.health.trouble(now_s)) for sensor in self._sensors]
        troubles = sorted((not each.implausible, f"{name}: {each.words}") for name, each in found if each is not None)
        return troubles[0][1] if troubles else None
