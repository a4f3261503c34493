"""The samples of one of the autopilot's IMUs, from the best message that it will send.

What is asked for is lost at every restart of the autopilot, may be refused, answered late or never; so nothing is
believed but the messages that arrive: the answer to a request only saves time.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.telemetry import imu_messages
from companion.autopilot.telemetry.imu_messages import Reading, StreamKind
from companion.autopilot.telemetry.pairing import LEAST_HZ, UNLIKE, Pairing, floats_kind
from companion.autopilot.telemetry.source import ABSENT_AFTER, Source
from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.system.waiting import comes
from companion.samples import ImuSample

__all__ = ["ImuStream", "StreamKind"]

logger = logging.getLogger(__name__)

SILENCE_S: Final = 2.0
"""After this long without a sample the stream is asked for again."""

SLOWER_RATES_HZ: Final = (100.0, 50.0, 40.0, 25.0, 10.0)
"""Tried in turn when a rate is denied: ArduPilot allows 1.25 times its loop rate, Plane's 50 Hz loop 40 Hz."""

_ASKS: Final = 3
"""How often a message is asked for that nobody refuses and that does not come."""

_BETTER_AGAIN_S: Final = 30.0
"""How often a better message that merely never came is asked for again."""

_LOOK_S: Final = 0.25
_TURN_S: Final = 1.0
BEAT_WITHIN_S: Final = 20.0
"""A request may wait behind fifteen others, each of which goes unanswered (`autopilot.commands`)."""
_REFUSED: Final = -1
_TEMPERATURE_RATE_HZ: Final = 2.0
_TEMPERATURE_AGE_S: Final = 5.0


class ImuStream:
    """Asks for one IMU's messages (1, 2 or 3), keeps them coming and hands on their samples in vehicle FRD.

    Slower than `rate_hz` when the autopilot denies that. `on_kind_change` is called before the first sample of another
    message (and with None when there is none any more), so that nobody mixes two resolutions in one mean.
    """

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        instance: int,
        on_sample: Callable[[ImuSample], None],
        *,
        rate_hz: float = 100.0,
        on_kind_change: Callable[[StreamKind | None], None] | None = None,
    ) -> None:
        if instance not in imu_messages.ARDUPILOT:
            raise ValueError(f"no IMU {instance}: 1, 2 or 3")
        self.kind: StreamKind | None = None
        """What the samples come from; None while there are none."""
        self.samples = 0
        self.problem = f"waiting for the autopilot to start IMU {instance}"
        """Why there are no samples, one line; empty while there are."""
        self.turns = 0
        """Turns of `run`, one at least every `BEAT_WITHIN_S`, whether samples come or not."""
        self.rejected: Counter[str] = Counter()
        self._vehicle, self._instance = vehicle, instance
        self._on_sample, self._on_kind_change = on_sample, on_kind_change
        self._rates_hz = [rate_hz, *(rate for rate in SLOWER_RATES_HZ if rate < rate_hz)]
        self._link = link
        self._sources: list[Source] = []
        self._current: Source | None = None
        self.temperature: tuple[float, float] | None = None
        """Of the IMU, degC, and when it was told; None: not since the restart."""
        self.pairing = Pairing()
        self._pairing: Pairing | None = None
        """Of PX4."""
        self._floats_again_s = -math.inf
        self._restart = asyncio.Event()
        self._arrived = asyncio.Event()

    @property
    def own_kind(self) -> StreamKind | None:
        """That of the one message by which the IMU is known, which offsets just written are seen by."""
        return None if self._current is None else self._current.message.kind

    @property
    def rate_hz(self) -> float | None:
        """The rate that was asked for last and not denied; None while nothing comes."""
        return None if self._current is None else self._current.rates_hz[self._current.rate]

    async def run(self) -> None:
        """Keep the samples coming until cancelled; raises nothing else."""
        messages = {*imu_messages.ARDUPILOT[self._instance], *imu_messages.PX4[self._instance]}
        subscriptions = [self._link.subscribe(each.message, self._on_message) for each in messages]
        subscriptions.append(self._link.subscribe(imu_messages.HIGHRES.message, self._on_floats))
        subscriptions.append(self._vehicle.on_event.add(self._on_event))
        try:
            while True:
                try:
                    await self._serve()
                except Exception:
                    logger.exception("the stream of IMU %d failed; starting again", self._instance)
                    await asyncio.sleep(1.0)
        finally:
            for unsubscribe in subscriptions:
                unsubscribe()
            self._switch(None)

    # --- which message, at which rate

    async def _serve(self) -> None:
        if not self._vehicle.alive:
            self._lose("no heartbeat from the autopilot")
        self.turns += 1
        while not await comes(self._vehicle.found, _TURN_S):
            self.turns += 1
        self._restart.clear()
        if self._vehicle.firmware == "ardupilot":
            messages = imu_messages.ARDUPILOT[self._instance]
        elif self._vehicle.firmware == "px4":
            messages = imu_messages.PX4[self._instance]
        else:
            self._lose("this autopilot is neither ArduPilot nor PX4: what its IMU messages carry is not known")
            await self._pause(60.0)
            return
        self._sources = [Source(message, self._rates_hz) for message in messages]
        paired = self._vehicle.firmware == "px4" and self._rates_hz[0] >= LEAST_HZ
        self._pairing = self.pairing if paired else None
        self.pairing.forget()
        self.temperature = None
        while not self._restart.is_set():
            found = await self._find()
            if found is None:
                self._lose(self._why_none())
                await self._pause(5.0)
                for source in self._sources:
                    source.refused = False
            else:
                await self._keep(found)

    async def _find(self) -> Source | None:
        """The first source, best first, that sends."""
        for source in self._sources:
            for _ in range(_ASKS):
                if self._restart.is_set() or source.refused:
                    break
                result = await self._ask(source)
                if result != _REFUSED and await self._sends(source):
                    return source
                if source.absent:
                    break
                if result is None and source.rate + 1 < len(source.rates_hz):
                    source.rate += 1  # the denial may have been lost or be late
        return None

    async def _ask(self, source: Source) -> int | None:
        """Ask for a message at the fastest rate that is not denied: the last answer, None when none came in time."""
        while True:
            self.turns += 1
            rate_hz = source.rates_hz[source.rate]
            result = await self._vehicle.commands.request_message_interval(source.message.message.id, rate_hz)
            if result == mavlink.MAV_RESULT_DENIED and not self._restart.is_set():
                # Too fast; or, in the same word, no such message.
                if source.rate + 1 < len(source.rates_hz):
                    source.rate += 1
                    continue
                source.rate, source.refused, source.reason = 0, True, "denied"
            elif result in (mavlink.MAV_RESULT_UNSUPPORTED, mavlink.MAV_RESULT_FAILED):
                source.refused, source.reason = True, "not supported"
            return _REFUSED if source.refused else result

    async def _sends(self, source: Source) -> bool:
        """Whether the source brings a sample within the time of a silence."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + SILENCE_S
        asked_s = loop.time()
        while not self._restart.is_set() and not source.absent:
            if source.last_s >= asked_s or loop.time() - source.last_s < _LOOK_S:
                return True
            self._arrived.clear()
            if not await comes(self._arrived, deadline_s - loop.time()):
                break
        return False

    async def _keep(self, source: Source) -> None:
        """Serve from a source until it falls silent for good, a better one sends, or the autopilot is lost."""
        loop = asyncio.get_running_loop()
        self._switch(source)
        silent_asks = 0
        asked_s = temperature_s = better_s = loop.time()
        await self._ask_for_temperature(source)
        self._floats_again_s = -math.inf  # PX4 may send them by itself, at another rate
        await self._ask_for_floats(source, asked_s)
        for each in self._sources:
            each.recent = 0
        while not await self._pause(_LOOK_S):
            now_s = loop.time()
            await self._ask_for_floats(source, now_s)
            better = self._better_than(source)
            if better is not None:
                self._switch(better)
                source = better
                await self._ask_for_temperature(source)
            if now_s - source.last_s < SILENCE_S:
                silent_asks = 0
                if self._temperature_is_old(now_s) and now_s - temperature_s > _TEMPERATURE_AGE_S:
                    temperature_s = now_s
                    await self._ask_for_temperature(source)
                if now_s - better_s > _BETTER_AGAIN_S:
                    better_s = now_s
                    await self._ask_for_better(source)
            elif source.absent:
                return
            elif now_s - asked_s >= SILENCE_S:
                self.problem = f"{source.name} has been silent for {now_s - source.last_s:.0f} s; asked for it again"
                if silent_asks >= _ASKS:
                    return
                silent_asks += 1
                asked_s = now_s
                if await self._ask(source) == _REFUSED:
                    return

    def _better_than(self, source: Source) -> Source | None:
        """A better source that has begun to send at a useful rate."""
        found = None
        for each in self._sources[: self._sources.index(source)]:
            if each.recent >= 10.0 * _LOOK_S and not each.absent and found is None:
                found = each
            each.recent = 0
        return found

    async def _ask_for_better(self, source: Source) -> None:
        for each in self._sources[: self._sources.index(source)]:
            if not each.refused and not each.reason:
                await self._ask(each)

    async def _ask_for_temperature(self, source: Source) -> None:
        """HIGHRES_IMU carries the barometer's; the IMU's comes with the integer messages."""
        if source.message is imu_messages.HIGHRES:
            for each in self._sources[1:]:
                message_id = each.message.message.id
                result = await self._vehicle.commands.request_message_interval(message_id, _TEMPERATURE_RATE_HZ)
                if result in (mavlink.MAV_RESULT_ACCEPTED, None):
                    return

    async def _ask_for_floats(self, source: Source, now_s: float) -> None:
        """PX4's floats, to be paired with its integers; by itself it may send them at a rate that never pairs."""
        if self._pairing is not None and not self._pairing.known and now_s >= self._floats_again_s:
            rate_hz = source.rates_hz[source.rate] * UNLIKE
            result = await self._vehicle.commands.request_message_interval(imu_messages.HIGHRES.message.id, rate_hz)
            answered = result == mavlink.MAV_RESULT_ACCEPTED
            self._floats_again_s = now_s + (_BETTER_AGAIN_S if answered else SILENCE_S)

    def _temperature_is_old(self, now_s: float) -> bool:
        return self.temperature is None or now_s - self.temperature[1] > _TEMPERATURE_AGE_S

    async def _pause(self, seconds: float) -> bool:
        """Wait, but not beyond the loss or restart of the autopilot; True when that came."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + seconds
        while not self._restart.is_set():
            self.turns += 1
            left_s = deadline_s - loop.time()
            if left_s <= 0.0:
                return False
            await comes(self._restart, min(left_s, _TURN_S))
        return True

    # --- what arrives

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("lost", "rebooted"):
            self._lose("the autopilot restarted" if event == "rebooted" else "no heartbeat from the autopilot")
            self._restart.set()

    def _on_message(self, message: Message, t_s: float) -> None:
        if not self._vehicle.sent(message):
            return
        source = next((each for each in self._sources if each.message.message is type(message)), None)
        if source is None:
            return
        reading = source.message.decode(message)
        if isinstance(reading, str):
            self.rejected[reading] += 1
            source.reason = reading
            return
        if reading.all_zero:
            self.rejected["all zero"] += 1
            source.zeros = min(source.zeros + 1, ABSENT_AFTER)
            self._arrived.set()
            return
        if -0.5 < reading.t_device_s - source.device_s <= 0.0:
            self.rejected["repeated or late"] += 1
            return
        source.device_s, source.last_s, source.zeros, source.reason = reading.t_device_s, t_s, 0, ""
        source.recent += 1
        self._arrived.set()
        if reading.temperature_degc is not None:
            self.temperature = (reading.temperature_degc, t_s)
        if source is self._current:
            self._take(reading, source.message.kind, t_s)

    def _take(self, reading: Reading, kind: StreamKind, t_s: float) -> None:
        if self._pairing is not None:
            self._pairing.add_integers(reading)
            self._set_kind(floats_kind(kind) if self._pairing.known else kind)
        if self.kind is kind:
            self._hand_on(reading, t_s)

    def _on_floats(self, message: Message, t_s: float) -> None:
        """PX4's HIGHRES_IMU, whichever IMU it shows."""
        if self._pairing is None or not self._vehicle.sent(message):
            return
        reading = imu_messages.HIGHRES.decode(message)
        if isinstance(reading, str):
            return
        self._pairing.add_floats(reading)
        if self._pairing.known and self.kind is not None and not self.kind.truncates:
            corrected, variance = self._pairing.corrected(reading)
            self._hand_on(corrected, t_s, variance)

    def _hand_on(self, reading: Reading, t_s: float, shared_variance: tuple[float, ...] | None = None) -> None:
        self.samples += 1
        self.problem = ""
        known = self.temperature
        temperature = None if known is None or t_s - known[1] > _TEMPERATURE_AGE_S else known[0]
        self._on_sample(
            ImuSample(
                t_s, reading.gyro_rad_s, reading.accel_m_s2, temperature, None, reading.t_device_s,
                shared_variance=shared_variance,
            )
        )  # fmt: skip

    def _lose(self, problem: str) -> None:
        self._switch(None)
        if problem != self.problem:
            # The loss of the autopilot itself has been said once already.
            logger.log(logging.WARNING if self._vehicle.alive else logging.DEBUG, "IMU %d: %s", self._instance, problem)
        self.problem = problem

    def _switch(self, source: Source | None) -> None:
        if source is self._current:
            return
        self._current = source
        if source is not None:
            self.problem = ""
        self._set_kind(None if source is None else source.message.kind)

    def _set_kind(self, kind: StreamKind | None) -> None:
        if kind != self.kind:
            self.kind = kind
            if kind is not None:
                logger.info("IMU %d: %s at up to %g Hz", self._instance, kind.message, self.rate_hz)
            if self._on_kind_change is not None:
                self._on_kind_change(kind)

    def _why_none(self) -> str:
        ordinal = {1: "first", 2: "second", 3: "third"}[self._instance]
        if all(source.absent for source in self._sources if not source.refused and not source.reason):
            zero = [source.name for source in self._sources if source.absent]
            if zero:
                return f"{zero[0]} is all zero: there is no {ordinal} IMU"
        words = [f"{source.name} {source.reason or 'does not come'}" for source in self._sources]
        return f"no samples of IMU {self._instance}: {', '.join(words)}"
