"""Samples of one of the autopilot's IMUs, from the best message that the autopilot is ready to send.

A request is lost at every restart of the autopilot, and may be refused, answered late or never. So a request counts as
successful only when messages arrive; an answer to the request only saves time.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware import imu_messages
from companion.autopilot.firmware.firmwares import FIRMWARES
from companion.autopilot.firmware.imu_messages import TEMPERATURE_AGE_S, ImuMessage, ImuSamples
from companion.autopilot.telemetry.px4_console import EkfBias
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.system.events import comes
from companion.lua import to_script
from companion.messages import message
from companion.samples import ImuSample

logger = logging.getLogger(__name__)

SILENCE_S: Final = 2.0  # time without a sample after which the stream is requested again

SLOWER_RATES_HZ: Final = (100.0, 50.0, 40.0, 25.0, 10.0)  # ArduPilot allows 1.25 times its loop rate

_ASKS: Final = 3  # requests for a message that is not refused and does not arrive

_BETTER_AGAIN_S: Final = 30.0  # time between requests for a better message that was not refused

_LOOK_S: Final = 0.25
_TURN_S: Final = 1.0
BEAT_WITHIN_S: Final = 20.0  # a request may wait behind fifteen others that go unanswered
_BESIDE_CONSOLE: Final = 0.85  # fraction of the rate that the console's answers leave on a slow line
_TEMPERATURE_RATE_HZ: Final = 2.0
_ASK_SCRIPT_S: Final = 1.0  # time between requests to ArduPilot's script, which sends for 3 s after one
_SEEN_BY_RATE_HZ: Final = 4.0  # rate of PX4's integers beside floats: a write observes them for 0.4 s (`px4_writes`)
_ABSENT_AFTER: Final = 10  # all-zero readings in a row after which the IMU counts as absent


@dataclasses.dataclass(slots=True)
class _Source:
    message: ImuMessage
    rates_hz: Sequence[float]
    rate: int = 0
    refused: bool = False
    last_s: float = -math.inf
    recent: int = 0
    zeros: int = 0
    reason: str = ""

    @property
    def absent(self) -> bool:
        return self.zeros >= _ABSENT_AFTER


_NO_HEARTBEAT: Final = "no heartbeat from the autopilot"
_RESTARTED: Final = "the autopilot restarted"


class ImuStream:
    """Requests the messages of one IMU (1, 2 or 3) as often as needed, and passes on its samples in vehicle FRD.

    The rate is below `rate_hz` if the autopilot denies `rate_hz`. `may_be_slow` returns True if the eleven samples a
    second of ArduPilot's script suffice. `on_kind_change` is called before the first sample of another message, and
    with None when samples end, so that no mean mixes two resolutions.
    """

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        instance: int,
        on_sample: Callable[[ImuSample], None],
        *,
        rate_hz: float,
        ekf_bias: EkfBias,
        on_kind_change: Callable[[ImuMessage | None], None],
        may_be_slow: Callable[[], bool] = lambda: True,
    ) -> None:
        self.samples = 0
        self._starting = f"waiting for the autopilot to start IMU {instance}"
        self.problem = self._starting  # reason why there are no samples, one line; empty while they arrive
        self.turns = 0  # turns of `run`, at least one every `BEAT_WITHIN_S`, with or without samples
        self._vehicle, self._instance = vehicle, instance
        self._on_sample, self._on_kind_change = on_sample, on_kind_change
        self._ekf_bias, self._may_be_slow = ekf_bias, may_be_slow
        self._rates_hz = [rate_hz, *(rate for rate in SLOWER_RATES_HZ if rate < rate_hz)]
        self._link = link
        self._sources: list[_Source] = []
        self._current: _Source | None = None
        self._reader = ImuSamples()
        self._restart = asyncio.Event()
        self._arrived = asyncio.Event()

    @property
    def kind(self) -> ImuMessage | None:
        return None if self._current is None else self._current.message

    @property
    def wants_script(self) -> bool:
        """Return True if the floats of ArduPilot's script are the current source, or better than the current one."""
        for source in self._sources:
            if source.message.from_script and self._usable(source):
                return True
            if source is self._current:
                break
        return False

    @property
    def decided(self) -> bool:
        """Return True once samples arrive, or once every message that could carry them was requested in vain."""
        return self.problem not in (self._starting, _NO_HEARTBEAT, _RESTARTED)

    @property
    def rate_hz(self) -> float | None:
        return None if self._current is None else self._current.rates_hz[self._current.rate]

    async def run(self) -> None:
        """Keep the samples coming until cancelled; errors are logged, not raised."""
        kinds = {each.message for firmware in FIRMWARES for each in firmware.imu_messages.get(self._instance, ())}
        subscriptions = [self._link.subscribe(kind, self._on_message) for kind in kinds]
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
            self._lose(_NO_HEARTBEAT)
        self.turns += 1
        while not await comes(self._vehicle.found, _TURN_S):
            self.turns += 1
        self._restart.clear()
        messages = self._vehicle.kind.imu_messages.get(self._instance)
        if messages is None:
            self._lose(message("firmware_not_supported", what="telemetry"))
            await self._pause(60.0)
            return
        if self._ekf_bias.may_look:
            # Wait for the bias: a later change to floats would restart a measurement.
            await comes(self._ekf_bias.settled, BEAT_WITHIN_S / 2.0)
        sources = [_Source(message, self._rates_hz) for message in messages]
        self._sources = [source for source in sources if self._may_be_slow() or not source.message.from_script]
        if messages[0].lacks_bias and self._rates_hz[0] < SLOWER_RATES_HZ[0]:
            self._sources[0].rates_hz = [_BESIDE_CONSOLE * self._rates_hz[0], *self._rates_hz[1:]]
        self._reader = ImuSamples()
        better: _Source | None = None
        while not self._restart.is_set():
            found = better or await self._find()
            if found is None:
                self._lose(self._why_none())
                await self._pause(5.0)
                for source in self._sources:
                    source.refused = False
            else:
                better = await self._keep(found)

    async def _find(self) -> _Source | None:
        for source in filter(self._usable, self._sources):
            for _ in range(_ASKS):
                if self._restart.is_set() or source.refused or source.message.from_script:
                    break  # the script's samples take over as soon as they arrive
                answered = await self._ask(source)
                if await self._sends(source):
                    return source
                if source.absent:
                    break
                if not answered and source.rate + 1 < len(source.rates_hz):
                    source.rate += 1  # a denial may have been lost or be late
        return None

    async def _ask(self, source: _Source) -> bool:
        """Request a message at the fastest rate that is not denied; return whether an answer came in time."""
        if source.message.from_script:
            return False
        while True:
            self.turns += 1
            rate_hz = source.rates_hz[source.rate]
            result = await self._vehicle.commands.request_message_interval(source.message.message.id, rate_hz)
            if result == mavlink.MAV_RESULT_DENIED and not self._restart.is_set():
                # DENIED means too fast, or no such message.
                if source.rate + 1 < len(source.rates_hz):
                    source.rate += 1
                    continue
                source.rate, source.refused, source.reason = 0, True, "denied"
            elif result in (mavlink.MAV_RESULT_UNSUPPORTED, mavlink.MAV_RESULT_FAILED):
                source.refused, source.reason = True, "not supported"
            return result is not None

    async def _sends(self, source: _Source) -> bool:
        loop = asyncio.get_running_loop()
        asked_s = loop.time()
        while not (self._restart.is_set() or source.absent or source.refused):
            if source.last_s >= asked_s or loop.time() - source.last_s < _LOOK_S:
                return True
            self._arrived.clear()
            if not await comes(self._arrived, asked_s + SILENCE_S - loop.time()):
                break
        return False

    async def _keep(self, source: _Source) -> _Source | None:
        """Use a source until a better one sends and return the better one; None: source failed or autopilot lost."""
        loop = asyncio.get_running_loop()
        self._switch(source)
        silent_asks = 0
        asked_s = temperature_s = better_s = loop.time()
        await self._ask_for_temperature(source)
        for each in self._sources:
            each.recent = 0
        while not await self._pause(_LOOK_S):
            now_s = loop.time()
            if not self._usable(source):
                if not source.message.from_script:  # the script stops by itself
                    self._vehicle.commands.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, source.message.message.id, 0.0)
                return None
            better = self._better_than(source)
            if better is not None:
                self._switch(better)
                await self._ask(better)  # it may come unrequested, at another rate
                return better
            if now_s - source.last_s < SILENCE_S:
                silent_asks = 0
                unknown = self._reader.temperature_degc(now_s) is None
                if unknown and now_s - temperature_s > TEMPERATURE_AGE_S:
                    temperature_s = now_s
                    await self._ask_for_temperature(source)
                better_s = await self._ask_for_better(source, better_s)
            elif source.absent:
                return None
            elif now_s - asked_s >= SILENCE_S:
                seconds = f"{now_s - source.last_s:.0f}"
                self.problem = message("imu_stream_interrupted", stream=source.message.name, seconds=seconds)
                silent_asks += 1
                if silent_asks > _ASKS:
                    return None
                asked_s = now_s
                await self._ask(source)
                if source.refused:
                    return None
        return None

    def _better_than(self, source: _Source) -> _Source | None:
        found = None
        for each in self._sources[: self._sources.index(source)]:
            if each.recent >= 10.0 * _LOOK_S and not each.absent and found is None:
                found = each
            each.recent = 0
        return found

    async def _ask_for_better(self, source: _Source, asked_s: float) -> float:
        """Request better messages every `_BETTER_AGAIN_S` or when one becomes usable; return the last request time."""
        if not all(map(self._usable, self._sources)):
            return -math.inf
        now_s = asyncio.get_running_loop().time()
        if now_s - asked_s <= _BETTER_AGAIN_S:
            return asked_s
        for each in self._sources[: self._sources.index(source)]:
            if not each.refused and not each.reason:
                await self._ask(each)
        return now_s

    async def _ask_for_temperature(self, source: _Source) -> None:
        """Request an integer message that carries the IMU's temperature; HIGHRES_IMU carries the barometer's."""
        if source.message.message is imu_messages.HIGHRES.message:
            rate_hz = _TEMPERATURE_RATE_HZ if source.message is imu_messages.HIGHRES else _SEEN_BY_RATE_HZ
            for each in (each for each in self._sources[1:] if not each.message.from_script):
                result = await self._vehicle.commands.request_message_interval(each.message.message.id, rate_hz)
                if result in (mavlink.MAV_RESULT_ACCEPTED, None):
                    return

    def _usable(self, source: _Source) -> bool:
        """Return True for the script while disarmed, for another source unless it needs an EKF bias that is unknown."""
        if source.message.from_script:
            return self._vehicle.arm_state is ArmState.DISARMED
        return not source.message.lacks_bias or self._ekf_bias.known_of(self._instance)

    async def _pause(self, seconds: float) -> bool:
        """Wait `seconds` and return False; return True at once if the autopilot is lost or restarts."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + seconds
        while not self._restart.is_set():
            self.turns += 1
            left_s = deadline_s - loop.time()
            if left_s <= 0.0:
                return False
            await comes(self._restart, min(left_s, _TURN_S))
        return True

    # --- inputs

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("lost", "rebooted"):
            self._lose(_RESTARTED if event == "rebooted" else _NO_HEARTBEAT)
            self._restart.set()
        elif event == "found" and self.problem == _NO_HEARTBEAT:
            self.problem = self._starting

    def _on_message(self, message: Message, t_s: float) -> None:
        if not self._vehicle.sent(message):
            return
        source = next((each for each in self._sources if each.message.message is type(message)), None)
        if source is None or not self._usable(source):
            return
        sample = source.message.decode(message, t_s)
        if isinstance(sample, str):
            source.reason = sample
            return
        if imu_messages.all_zero(sample):
            source.zeros = min(source.zeros + 1, _ABSENT_AFTER)
            self._arrived.set()
            return
        if not self._reader.accept(source.message.name, sample):
            return
        source.last_s, source.zeros, source.reason = t_s, 0, ""
        source.recent += 1
        self._arrived.set()
        if source is self._current:
            self.samples += 1
            self.problem = ""
            bias = self._ekf_bias.reading if source.message.lacks_bias else None
            self._on_sample(self._reader.complete(sample, bias))

    def _lose(self, problem: str) -> None:
        self._switch(None)
        if problem != self.problem:
            # The loss of the autopilot itself has been logged already.
            logger.log(logging.WARNING if self._vehicle.alive else logging.DEBUG, "IMU %d: %s", self._instance, problem)
        self.problem = problem

    def _switch(self, source: _Source | None) -> None:
        if source is self._current:
            return
        before, self._current = self.kind, source
        if source is not None:
            self.problem = ""
        if self.kind != before:
            if self.kind is not None:
                logger.info("IMU %d: %s at up to %g Hz", self._instance, self.kind.name, self.rate_hz)
            self._on_kind_change(self.kind)

    def _why_none(self) -> str:
        sources = [source for source in self._sources if self._usable(source) and not source.message.from_script]
        if all(source.absent for source in sources if not source.refused and not source.reason):
            zero = [source.message.name for source in sources if source.absent]
            if zero:
                return message("autopilot_has_no_imu", imu=self._instance, reason=f"{zero[0]} is all zero")
        reasons = ", ".join(f"{source.message.name} {source.reason or 'does not come'}" for source in sources)
        return message("imu_not_streamed", imu=self._instance, reasons=reasons)


async def ask_script(link: MavlinkLink, streams: Sequence[ImuStream]) -> None:
    while True:
        if any(stream.wants_script for stream in streams):
            link.send(to_script(link.system_id, imu_messages.SCRIPT_ASK))
        await asyncio.sleep(_ASK_SCRIPT_S)
