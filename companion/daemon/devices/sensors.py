"""Sensors on the companion's own serial ports: connection, decoding, dialogue, and listeners to the samples."""

from __future__ import annotations

import asyncio
import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from companion.configured.models import Role, SerialDevice, parts_of
from companion.daemon.core import Offload
from companion.links.serial.bytestream import ByteLink
from companion.links.serial.ports import find_holders, in_use
from companion.links.system.connection import BYTES_PER_S, Budget
from companion.links.system.events import Listeners
from companion.messages import message
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.clock import LATE
from companion.protocols.registry import Kind
from companion.protocols.stream_health import SILENT_AFTER_S, StreamHealth, Trouble
from companion.samples import CompassSample, Sample

logger = logging.getLogger(__name__)

RATE_SPAN_S: Final = 2.0
TICK_S: Final = 0.02
"""Minimum time between two messages to a device, and interval of checks for due messages during a dialogue."""
COARSE_S: Final = 0.25
LIVELY_S: Final = 1.0
LOOK_AGAIN_S: Final = 60.0
HELD_AGAIN_S: Final = 5.0
MOST_WORDS: Final = 20

_WANTED: Final[dict[Kind, str]] = {"imu": "rates", "gradienter": "tilt", "compass": "heading"}
ABSENT: Final = "absent"
FLOOD: Final = "flood"
RESTARTED: Final = "restarted"
FLOOD_S: Final = 1.0
GOOD_AFTER_S: Final = 1.0
AGAIN_S: Final = 60.0
"""Minimum time between two warnings of one kind of trouble; repeats, common with a loose wire, go to the debug log."""


class SensorHealth:
    """Present trouble of one sensor, and the number of times each kind of trouble began."""

    def __init__(self, link: ByteLink, protocol: str, decoder: Decoder) -> None:
        self.link, self._decoder = link, decoder
        self.stream = StreamHealth(protocol, decoder)
        self.counts: Counter[str] = Counter()
        self._breaks = 0
        self._stuck: Trouble | None = None
        self._opened_s = 0.0
        self.reported: str | None = None
        self._began_s = 0.0
        self._good_since_s: float | None = None
        self._warned_s: dict[str, float] = {}

    def opened(self, now_s: float) -> None:
        self._opened_s = now_s
        self.stream.opened()

    def trouble(self, now_s: float) -> Trouble | None:
        if not self.link.connected:
            return Trouble(ABSENT, self.link.last_error or f"{self.link.settings.url}: not open yet")
        found = _flood(self.link.budget, now_s) or self.stream.trouble(now_s) or self._stuck
        if found is None:
            return None
        return Trouble(found.key, f"{self.link.settings}: {found.words}", found.implausible)

    def update(self, now_s: float, stuck: Trouble | None = None) -> tuple[Trouble | None, bool]:
        """Count and log new trouble (call twice a second); return present trouble, and whether a warning was logged."""
        self._stuck = stuck
        if (breaks := self._decoder.times.clock.breaks) != self._breaks:
            self.counts[RESTARTED] += breaks - self._breaks
            self._breaks = breaks
            self._warn(Trouble(RESTARTED, message("device_restarted")), now_s)
        found = self.trouble(now_s)
        if found is not None and found.key == FLOOD:
            # Dropped bytes damage frames, which is no fault of the device; FLOOD_S spans two calls.
            self.stream.excuse()
        return found, self._report(found, now_s)

    def _report(self, found: Trouble | None, now_s: float) -> bool:
        if found is None:
            self._good_since_s = now_s if self._good_since_s is None else self._good_since_s
            if self.reported is not None and now_s - self._good_since_s >= GOOD_AFTER_S:
                logger.info("%s: good again after %.0f s", self.link.name, self._good_since_s - self._began_s)
                self.reported = None
            return False
        self._good_since_s = None
        if found.key == self.reported:
            return False
        if found.key == ABSENT or (now_s - self._opened_s < SILENT_AFTER_S and not found.implausible):
            return False  # `ByteLink` reports a lost port; a device may need a moment to start
        if self.reported is None:
            self._began_s = now_s
        self.reported = found.key
        self.counts[found.key] += 1
        return self._warn(found, now_s)

    def _warn(self, what: Trouble, now_s: float) -> bool:
        again = now_s - self._warned_s.get(what.key, -AGAIN_S) < AGAIN_S
        self._warned_s[what.key] = now_s
        level = logging.DEBUG if again else logging.WARNING
        logger.log(level, "%s: %s (%d so far)", self.link.name, what.words, self.counts[what.key])
        return not again


def _flood(budget: Budget | None, now_s: float) -> Trouble | None:
    if budget is None or budget.exceeded_s is None or now_s - budget.exceeded_s >= FLOOD_S:
        return None
    return Trouble(FLOOD, message("port_flooded", most=f"{BYTES_PER_S / 1e3:.0f}"))


class SensorRole:
    """One role of a device (IMU, gradienter or compass): its sample count and rate, for `companion status`."""

    def __init__(self, sensor: SerialSensor, role: Role) -> None:
        self.name, self.kind = role.name, role.kind
        self._sensor = sensor
        self._samples = 0
        self._last_s: float | None = None
        self._counted = (0.0, 0)
        self._rate_hz = 0.0

    def count(self, t_s: float) -> None:
        self._samples += 1
        self._last_s = t_s
        since_s, before = self._counted
        if t_s - since_s >= RATE_SPAN_S:
            self._rate_hz = (self._samples - before) / (t_s - since_s) if before else 0.0
            self._counted = (t_s, self._samples)

    def _problem(self, now_s: float) -> str | None:
        sensor, port = self._sensor, self._sensor.link.settings
        if self._last_s is not None and now_s - self._last_s < SILENT_AFTER_S:
            return None
        if self.kind == "compass" and (north := sensor.other_north) is not None:
            return message("compass_reference_wrong", port=port, north=north)
        return message("frames_without", port=port, protocol=sensor.protocol, wanted=_WANTED[self.kind])

    def status(self) -> dict[str, object]:
        sensor, now_s = self._sensor, asyncio.get_running_loop().time()
        trouble, words = sensor.health.trouble(now_s), sensor.text
        problem = self._problem(now_s) if trouble is None else trouble.words
        rate, port = f"{self._rate_hz:.0f}", sensor.link.settings.url
        summary = problem or message("sensor_state", protocol=sensor.protocol, port=port, rate=rate)
        if problem is None and sensor.health.counts:
            summary += f"; so far {', '.join(f'{count} {key}' for key, count in sensor.health.counts.items())}"
        others = [role.name for role in sensor.roles if role is not self]
        if others:
            summary += f" (shared with {', '.join(others)})"
        return {
            "name": self.name,
            "kind": self.kind,
            "good": problem is None,
            "summary": f"{summary}; {words}" if problem is not None and words else summary,
            "frames": self._samples,
            "rejected": dict(sensor.decoder.rejected),
            "warned": dict(sensor.decoder.warned),
            "reconnects": sensor.link.reconnects,
            "words": words,
            "shared_with": others,
            "restarts": sensor.decoder.times.clock.breaks,
            "too_late": sensor.decoder.times.dropped[LATE],
            "trouble": None if trouble is None else trouble.key,
            "counts": dict(sensor.health.counts),
            "protocol": sensor.protocol,
            "speaks": sensor.health.stream.speaks,
            "port": port,
        }


class SerialSensor:
    """One serial device, read and decoded once for all its roles; `take` is called with each role and its sample."""

    def __init__(
        self, device: SerialDevice, take: Callable[[Role, Sample], None], offload: Offload = asyncio.to_thread
    ) -> None:
        settings = device.settings
        self.device = device
        self.name, self.protocol = device.name, device.info.name
        self.roles = [SensorRole(self, role) for role in device.roles]
        self.decoder = device.info.decoder(settings.seconds_per_byte)
        # A read-only device gets no dialogue, so nothing is ever sent to it.
        self.dialogue = None if device.read_only or device.info.dialogue is None else device.info.dialogue()
        name = ", ".join(role.name for role in device.roles)
        self.kinds = frozenset(role.kind for role in device.roles)
        self.link = ByteLink(
            settings, self.receive, name=name, on_state=self._on_state, budget=Budget(), on_gap=self._on_gap
        )
        self.health = SensorHealth(self.link, self.protocol, self.decoder)
        self.on_bytes: Listeners[str, bytes | None, float] = Listeners()
        """Listeners to received bytes before decoding: device name, bytes (None marks a gap), time."""
        self.on_samples: Listeners[Sequence[Sample], float] = Listeners()
        """Listeners to the samples of one read, and its time; they are called before the collector."""
        self._take, self._offload = take, offload
        self._by_role = dict(zip(device.roles, self.roles, strict=True))
        self.other_north: str | None = None
        """North reference of headings that were refused, as the configuration names another one."""
        self._spoke_s = -math.inf
        self._alone = False
        self._look_at_s = -math.inf
        self._held_by = ""
        self._openings = 0
        self._told: set[str] = set()

    async def run(self) -> None:
        if self.dialogue is None:
            await self.link.run()
            return
        async with asyncio.TaskGroup() as group:
            group.create_task(self._converse(), name=f"{self.name} dialogue")
            await self.link.run()

    def _on_state(self, connected: bool, _reason: str) -> None:  # noqa: FBT001 - ByteLink's signature
        if connected:
            now_s = asyncio.get_running_loop().time()
            self._interrupted(now_s)
            self.health.opened(now_s)
            self._openings += 1
            self._alone, self._look_at_s = False, -math.inf
            if self.dialogue is not None:
                self.dialogue.opened(now_s)

    def _on_gap(self) -> None:
        self._interrupted(asyncio.get_running_loop().time())

    def _interrupted(self, now_s: float) -> None:
        self.on_bytes.tell(self.name, None, now_s)
        self.decoder.interrupted()

    def receive(self, data: bytes, t_s: float) -> None:
        if self.on_bytes:
            self.on_bytes.tell(self.name, data, t_s)
        samples = self.decoder.receive(data, t_s)
        if samples and self.on_samples:
            self.on_samples.tell(samples, t_s)
        self.health.stream.took(data, samples, t_s)
        for sample in samples:
            if isinstance(sample, CompassSample) and any(role.refuses(sample) for role in self.device.roles):
                self.other_north = sample.north
            for role, part in parts_of(sample, self.device.roles):
                self._by_role[role].count(t_s)
                self._take(role, part)
        if self.dialogue is not None and self._openings:
            self.dialogue.heard(data, len(samples), t_s)
            self._speak(t_s)

    async def _converse(self) -> None:
        """Send due messages to the device: check often during a dialogue, otherwise seldom to save processor time."""
        loop = asyncio.get_running_loop()
        while True:
            is_lively = loop.time() - self._spoke_s < LIVELY_S
            await asyncio.sleep(TICK_S if is_lively else COARSE_S)
            if self.link.connected and loop.time() >= self._look_at_s:
                await self._look_for_others()
            self._speak(loop.time())

    async def _look_for_others(self) -> None:
        """Check that no other program (such as a login or modem service) has the port open: two writers do harm."""
        opening, port = self._openings, self.link.settings
        holders = () if port.is_tcp else await self._offload(find_holders, port.url)
        if opening != self._openings:
            return
        others = [other for other in holders if other.pid != os.getpid()]
        self._held_by = in_use(port.url, others) if others else ""
        self._alone = not self._held_by
        self._look_at_s = asyncio.get_running_loop().time() + (LOOK_AGAIN_S if self._alone else HELD_AGAIN_S)
        if self._held_by:
            self._tell(self.text)

    def _speak(self, t_s: float) -> None:
        if self.dialogue is None or not self._alone or not self.link.connected or t_s - self._spoke_s < TICK_S:
            return
        data = self.dialogue.due(t_s)
        if data:
            self._spoke_s = t_s
            self.link.write(data)
            self._tell(self.text)

    def _tell(self, words: str) -> None:
        if words and words not in self._told and len(self._told) < MOST_WORDS:
            self._told.add(words)
            logger.info("%s: %s", self.link.name, words)

    @property
    def text(self) -> str:
        return self._held_by or (self.dialogue.words if self.dialogue is not None else "")
