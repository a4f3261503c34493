"""Measuring one still window: the reasons to wait, and when there is enough."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Final

import msgspec

from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import MEASURED_PERCENT
from companion.component.statustext import Severity
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, not_ready
from companion.daemon.job import Job
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.collector.outlook import CollectorStatus
from companion.estimation.machine import Event, State
from companion.estimation.means.windows import Window
from companion.links.system.listeners import Listeners

POLL_S: Final = 0.2
"""Interval at which all but a complete second is checked; a second is handled when it is complete."""
SAY_WAITING_EVERY_S: Final = 10.0
SAY_LEFT_EVERY_S: Final = 75.0
"""Interval of messages while nothing is in the way; the first minute of a deck says nothing yet."""
READ_ATTEMPTS: Final = 2
"""Failed reads of the autopilot's offsets within one calibration that make it fail."""
MOST_UPSETS: Final = 5
"""Changes of the offsets, or restarts of the autopilot, within one calibration that make it fail."""


class Measuring:
    """Measures still windows of one aircraft, for one job at a time."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._core, self._machine, self._imus = core, core.machine, imus
        self._upsets: dict[str, int] = {}
        """Number of upsets before this calibration, by IMU."""
        self._said, self._said_s = "", -math.inf
        self.on_measured: Listeners[Window] = Listeners()
        """Notified of every window, in the moment in which it is taken."""

    def begin(self) -> None:
        """Begin a calibration, which may measure more than once."""
        self._said, self._said_s = "", -math.inf
        self._upsets = {name: imu.upsets for name, imu in self._imus.items()}

    async def read_state(self, job: Job, if_armed: str | None) -> tuple[CollectorStatus, str | None, int | None]:
        """Return the collector's status, the reason to wait, and the seconds to hold still where that is all.

        `if_armed`: reason of the failure if it was armed since the job began; None: it goes on once disarmed.

        Raises:
            CalibrationRefusedError: armed (in those words), or out of time.
        """
        armed = self._core.vehicle.arm_state is ArmState.ARMED
        if if_armed is not None and (armed or job.was_armed):
            raise CalibrationRefusedError(if_armed)
        job.check_time()
        await self._core.catch_up()
        status = self._core.collector.status(asyncio.get_running_loop().time())
        if armed:
            return status, "armed: it goes on once it is disarmed", None
        other = not_ready(self._core.vehicle, self._imus) or models.place_doubt(self._core.config, self._core.vehicle)
        if other is not None or status.obstacle is None:
            return status, other, None
        return status, status.obstacle.words, status.obstacle.hold_still_s

    def show(self, *, measuring: bool) -> None:
        """Report to the state table whether it measures."""
        if measuring and self._machine.state is State.WAITING:
            self._machine.on(Event.STILL)
        elif not measuring and self._machine.state is State.COLLECTING:
            self._machine.on(Event.MOVED)

    async def measure(self, job: Job) -> Window:
        """Wait for stillness and for enough of it; returns the averages.

        Raises:
            CalibrationRefusedError: armed in the middle, out of time, or the readings fail their checks.
            JobCancelledError: cancelled.
        """
        collector = self._core.collector
        settings = self._core.wanted.settings
        gyro = settings.target_gyro_sigma_rad_s if job.what.gyros else math.inf
        accel = settings.target_accel_sigma_m_s2 if job.what.accelerometers else math.inf
        collector.retarget(
            msgspec.structs.replace(settings, target_gyro_sigma_rad_s=gyro, target_accel_sigma_m_s2=accel)
        )
        failures = {name: imu.failures for name, imu in self._imus.items()}
        collector.on_second.append(job.look_again)
        try:
            while True:
                status, waiting_for, hold_still_s = await self.read_state(job, "armed; nothing written")
                self._check_imus(failures)
                self.show(measuring=waiting_for is None)
                words = waiting_for or status.measuring
                job.progress(MEASURED_PERCENT * status.progress, words, hold_still_s)
                if waiting_for is None and status.enough:
                    self._machine.on(Event.ENOUGH)
                    job.progress(MEASURED_PERCENT, "working out the biases")
                    window = await self._core.window()
                    self.on_measured.tell(window)
                    return window
                if waiting_for or status.left:
                    self.tell(job, words, SAY_WAITING_EVERY_S if waiting_for else SAY_LEFT_EVERY_S)
                await job.pause(POLL_S)
        finally:
            collector.on_second.remove(job.look_again)

    def tell(self, job: Job, words: str, every_s: float = SAY_WAITING_EVERY_S) -> None:
        """Tell the requester what is waited for: changes only, and not too often."""
        now_s = asyncio.get_running_loop().time()
        if words != self._said and not job.automatic and now_s - self._said_s >= every_s:
            self._said, self._said_s = words, now_s
            self._core.say(Severity.INFO, words)

    def _check_imus(self, failures: dict[str, int]) -> None:
        for name, imu in self._imus.items():
            failures[name] = min(failures[name], imu.failures)
            if imu.failures - failures[name] >= READ_ATTEMPTS:
                # Patience is for what can change by itself; an autopilot that does not answer is a fault.
                raise AutopilotError(f"imu {name}: {imu.problem}")
            if (upsets := imu.upsets - self._upsets.get(name, 0)) >= MOST_UPSETS:
                raise AutopilotError(
                    f"{imu.upset}, {upsets} times now: does something else write, or pretend to be the autopilot?"
                )
