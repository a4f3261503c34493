"""Base class of the autopilot doubles: its ports and its loop, common to every firmware."""

from __future__ import annotations

import abc
import asyncio
import math
from collections.abc import Callable, Sequence

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import Array
from sim.firmware.buzzer import Buzzer
from sim.firmware.channel import Channel, Message, Write
from sim.firmware.compass import SimCompass
from sim.firmware.faults import Faults
from sim.imu_model import Bias, ImuModel

HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
COMPASS_HZ = 10.0
"""Rate at which a compass has new readings (ArduPilot: `update_batt_compass`); PX4's default is 15."""


class AutopilotDouble(abc.ABC):
    """An autopilot on a virtual aircraft with two ports, `self` for the companion and `ground` for a ground station.

    It is an `End` (attach, receive). `run` sends due messages; answers need only the running loop. Time is the loop's
    clock. Each firmware handles messages and composes its own.

    Args:
        aircraft: the truth.
        imus: the models; the first is IMU 1.
        compasses: the magnetometers; None: one on the board, without iron.
        channels: the companion's port and the ground station's.
        up_s: time since the autopilot's boot at the beginning of the simulation.
        tunes_go_on: `goes_on` of `Buzzer`.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        channels: tuple[Channel, Channel],
        *,
        compasses: Sequence[SimCompass] | None,
        up_s: float,
        seed: int,
        tunes_go_on: bool,
    ) -> None:
        self.aircraft, self.imus = aircraft, tuple(imus)
        self.faults = Faults()
        self.buzzer = Buzzer(goes_on=tunes_go_on)
        self.armed = False
        self.uid2 = f"virtual {seed:04d}".encode().ljust(18, b"\0")[:18]
        """The board's unique id, in AUTOPILOT_VERSION."""
        self.calibrating = False
        self.boots = 0
        self.writes: list[Write] = []
        """All received PARAM_SET in order, obeyed or not; integers are stored as numbers."""
        self.compasses = (SimCompass(mounting=imus[0].mounting),) if compasses is None else tuple(compasses)
        self._compass_readings: dict[int, tuple[int, Array]] = {}
        self.channels = channels
        self._port, self.ground = channels
        self.random = np.random.default_rng([seed, 4])
        """Random numbers for everything except sensor noise."""
        self.has_compass = False
        """True: the autopilot's own magnetometer works, and determines the yaw."""
        self._up_s = up_s
        self._booted_s: float | None = None
        self._down = False
        self._generation = 0
        self._lanes: dict[str, float] = {}
        self._failed: asyncio.Future[None] | None = None
        self._timer: asyncio.TimerHandle | None = None

    # The outside: two ends, and the loop.

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Connect the companion's wire (None: disconnect)."""
        self._port.attach(transmit)

    def receive(self, data: bytes, t_s: float) -> None:
        """Handle bytes from the companion's wire; never raises."""
        self._port.receive(data, t_s)

    def require_signatures(self, key: bytes, ticks: int = 0) -> None:
        """Sign on both ports, and accept only signed messages, as after SETUP_SIGNING."""
        for number, channel in enumerate(self.channels, start=1):
            channel.require_signatures(key, ticks, number)

    async def run(self) -> None:
        """Send heartbeats and streams until cancelled."""
        loop = asyncio.get_running_loop()
        self._failed = loop.create_future()
        self._begin(loop.time())
        self._tick()
        try:
            await self._failed
        finally:
            self._failed = None
            if self._timer is not None:
                self._timer.cancel()

    # What a firmware says of itself.

    @abc.abstractmethod
    def parameter(self, name: str) -> float:
        """Return the stored value of a parameter; KeyError for an unknown name."""

    @abc.abstractmethod
    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter value without an announcement, as if it had always been so."""

    @abc.abstractmethod
    def write_as_another_station(self, name: str, value: float) -> None:
        """Set a parameter as another ground station does."""

    @abc.abstractmethod
    def arm(self) -> None:
        """Arm, as a pilot would."""

    @abc.abstractmethod
    def disarm(self) -> None:
        """Disarm, as a pilot would."""

    @abc.abstractmethod
    def estimated_angles_rad(self, loop_s: float) -> tuple[float, float, float]:
        """Return roll, pitch, yaw as in ATTITUDE."""

    @abc.abstractmethod
    def residual(self, instance: int, loop_s: float) -> Bias:
        """Return the error in the output of IMU `instance` (1..) after offsets and scales: output minus truth, FRD."""

    @abc.abstractmethod
    def prearm_failures(self, loop_s: float) -> list[str]:
        """Return the reasons against arming, in the firmware's words without the prefix."""

    @abc.abstractmethod
    def build(self, message_id: int, loop_s: float) -> Message | None:
        """Build the message of a stream; None: there is nothing to send."""

    @abc.abstractmethod
    def _started(self, loop_s: float) -> None:
        """Handle the first instant on a loop; the autopilot was already running for `up_s`."""

    @abc.abstractmethod
    def _restarted(self, loop_s: float) -> None:
        """Handle a boot: forget everything that is not stored, and set up the streams."""

    @abc.abstractmethod
    def _receive_message(self, channel: Channel, message: Message, loop_s: float) -> None:
        """Handle a message that was received while the autopilot was running."""

    # What happens to it.

    def reboot(self, down_s: float = 1.5) -> None:
        """Restart: silence for `down_s`, then time from zero, streams and routes forgotten, stored parameters kept."""
        self._down = True
        self._generation += 1
        generation = self._generation
        self.armed = self.calibrating = False
        loop = asyncio.get_running_loop()
        loop.call_later(down_s, lambda: self._boot(loop.time()) if generation == self._generation else None)

    # What its parts use.

    def boot_us(self, loop_s: float) -> int:
        assert self._booted_s is not None
        return int((loop_s - self._booted_s) * 1e6)

    def boot_ms(self, loop_s: float) -> int:
        return self.boot_us(loop_s) // 1000

    def unix_s(self, loop_s: float) -> float:
        """Return the date that the autopilot knows."""
        return self.aircraft.unix_s + self.aircraft.time_at(loop_s)

    def compass_reading(self, index: int, t_s: float) -> Array:
        """Return the newest reading (3,) of compass `index` (0..) in its own axes, milligauss; no compass: zero."""
        if index >= len(self.compasses):
            return np.zeros(3)
        sensor, number = self.compasses[index], math.floor(t_s * COMPASS_HZ + 1e-6)
        last = self._compass_readings.get(index)
        if last is None or (last[0] != number and not sensor.stuck):
            field_ned = 1e3 * self.aircraft.site.field_ned_gauss
            last = number, sensor.reading(self.aircraft.body_from_ned(t_s), field_ned, self.random)
            self._compass_readings[index] = last
        return last[1]

    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    def later(self, delay_s: float, action: Callable[[], None]) -> None:
        """Run an action after a delay, unless a reboot comes first."""
        generation = self._generation
        loop = asyncio.get_running_loop()
        loop.call_later(delay_s, lambda: action() if generation == self._generation else None)

    def soon(self, delay_s: float, action: Callable[[], None], *, lane: str = "") -> None:
        """Run an action after a delay, in order with other actions of the same lane, such as answers on a port."""
        now_s = self.now_s()
        at_s = max(now_s + delay_s, self._lanes.get(lane, 0.0) + 1e-6)
        self._lanes[lane] = at_s
        self.later(at_s - now_s, action)

    def answer(self, channel: Channel, message: Message) -> None:
        """Send an answer, unless the double is silent."""
        if not self._down and not self.faults.silent:
            channel.send(message)

    def wake(self) -> None:
        """Wake `run`: a message is due earlier than planned."""
        if self._failed is not None:
            asyncio.get_running_loop().call_soon(self._tick)

    def after_write(self) -> bool:
        """Count down the faults that wait for a write; return True if this write has rebooted the autopilot."""
        faults = self.faults
        if faults.foreign_write_after is not None:
            count, name, value = faults.foreign_write_after
            faults.foreign_write_after = (count - 1, name, value) if count > 1 else None
            if count <= 1:
                self.soon(0.01, lambda: self.write_as_another_station(name, value))
        if faults.arm_after_writes is not None:
            faults.arm_after_writes -= 1
            if faults.arm_after_writes <= 0:
                faults.arm_after_writes = None
                self.arm()
        if faults.reboot_after_writes is not None:
            faults.reboot_after_writes -= 1
            if faults.reboot_after_writes <= 0:
                faults.reboot_after_writes = None
                self.reboot()
                return True
        return False

    # The inside.

    def _begin(self, loop_s: float) -> None:
        if self._booted_s is None:
            self.aircraft.begin(loop_s)
            self._booted_s = loop_s - self._up_s
            self.boots = 1
            self._started(loop_s)

    def _boot(self, loop_s: float) -> None:
        self._down = False
        self._booted_s = loop_s
        self.boots += 1
        for channel in self.channels:
            channel.streams.clear()
            channel.listing = False
        self._restarted(loop_s)
        self.wake()

    def _tick(self) -> None:
        """Send due messages and schedule the next call: plain callbacks, cheaper than a task."""
        if self._failed is None or self._failed.done():
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        loop = asyncio.get_running_loop()
        try:
            self._send_due(loop.time())
        except Exception as error:  # noqa: BLE001 - handed to whoever awaits run()
            self._failed.set_exception(error)
            return
        due = [at for channel in self.channels if (at := channel.next_due_s()) is not None]
        if due and not self._down:
            self._timer = loop.call_at(min(due), self._tick)

    def _holds_back(self, message_id: int) -> bool:
        """Return True if a fault suppresses this stream."""
        return self.faults.heartbeat_off if message_id == HEARTBEAT else self.faults.telemetry_off

    def _send_due(self, loop_s: float) -> None:
        if self._down:
            return
        for channel in self.channels:
            for message_id in channel.due(loop_s):
                if channel.attached and not self._holds_back(message_id):
                    message = self.build(message_id, loop_s)
                    if message is not None:
                        channel.send(message)

    def _handle(self, channel: Channel, message: Message, loop_s: float) -> None:
        if not self._down:
            self._begin(loop_s)
            self._receive_message(channel, message, loop_s)
