"""Measurement of one window without motion, and the estimate of biases from this window."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Final

import msgspec

from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import MEASURED_PERCENT
from companion.component.statustext import Severity
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.poses.alignment import ActiveAlignment, ActiveSixPosition
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.collector.intake import CollectorStatus
from companion.estimation.machine import Event, State, What
from companion.estimation.means.windows import Window
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import Solution, solve
from companion.estimation.solution.truth import FallbackPose
from companion.links.system.events import Listeners

POLL_S: Final = 0.2
"""Longest interval between checks of a measurement; each complete second of samples causes a check at once."""
SAY_WAITING_EVERY_S: Final = 10.0
SAY_LEFT_EVERY_S: Final = 75.0
"""Interval of messages on the time left; long enough for none in the first minute on a ship's deck."""
READ_ATTEMPTS: Final = 2
MOST_UPSETS: Final = 5


class Measuring:
    """Measures windows without motion of one aircraft, for one job at a time."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._core, self._machine, self._imus = core, core.machine, imus
        self._upsets_before: dict[str, int] = {}
        self._said, self._said_s = "", -math.inf
        self.on_measured: Listeners[Window] = Listeners()

    def begin(self) -> None:
        self._said, self._said_s = "", -math.inf
        self._upsets_before = {name: imu.upsets for name, imu in self._imus.items()}

    async def read_state(self, job: Job, if_armed: str | None) -> tuple[CollectorStatus, str | None, int | None]:
        """Return the collector's status, the reason to wait, and the seconds to hold still if nothing else is missing.

        `if_armed`: text of the error if the aircraft was armed since the job began; None: wait until it is disarmed.
        """
        vehicle = self._core.vehicle
        armed = vehicle.arm_state is ArmState.ARMED
        if if_armed is not None and (armed or job.was_armed):
            raise CalibrationRefusedError(if_armed)
        job.check_time()
        await self._core.catch_up()
        status = self._core.collector.status(asyncio.get_running_loop().time())
        if armed:
            return status, "armed: continues once disarmed", None
        if vehicle.conflict is not None:
            return status, f"waiting: {vehicle.conflict}", None
        if vehicle.arm_state is ArmState.UNKNOWN:
            return status, "waiting for the autopilot's heartbeat", None
        found = ((name, imu.obstacle) for name, imu in self._imus.items())
        unread = (f"waiting for imu {name}: {obstacle}" for name, obstacle in found if obstacle is not None)
        other = next(unread, None) or models.place_doubt(self._core.config, vehicle)
        if other is not None or status.obstacle is None:
            return status, other, None
        return status, status.obstacle.words, status.obstacle.hold_still_s

    def show(self, *, measuring: bool) -> None:
        if measuring and self._machine.state is State.WAITING:
            self._machine.on(Event.STILL)
        elif not measuring and self._machine.state is State.COLLECTING:
            self._machine.on(Event.MOVED)

    async def measure(self, job: Job) -> Window:
        collector = self._core.collector
        settings = self._core.wanted.settings
        gyro = settings.target_gyro_sigma_rad_s if job.what.gyros else math.inf
        accel = settings.target_accel_sigma_m_s2 if job.what.accelerometers else math.inf
        collector.retarget(
            msgspec.structs.replace(settings, target_gyro_sigma_rad_s=gyro, target_accel_sigma_m_s2=accel)
        )
        failures = {name: imu.failures for name, imu in self._imus.items()}
        collector.on_second.append(job.wake_up)
        try:
            while True:
                status, waiting_for, hold_still_s = await self.read_state(job, "armed; nothing written")
                self._check_imus(failures)
                self.show(measuring=waiting_for is None)
                words = waiting_for or status.measuring
                if status.still_s == 0.0:
                    job.progress_percent = 0  # the measurement begins again
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
            collector.on_second.remove(job.wake_up)

    def tell(self, job: Job, words: str, every_s: float = SAY_WAITING_EVERY_S) -> None:
        now_s = asyncio.get_running_loop().time()
        if words != self._said and not job.automatic and now_s - self._said_s >= every_s:
            self._said, self._said_s = words, now_s
            self._core.say(Severity.INFO, words)

    def _check_imus(self, failures: dict[str, int]) -> None:
        for name, imu in self._imus.items():
            failures[name] = min(failures[name], imu.failures)
            if imu.failures - failures[name] >= READ_ATTEMPTS:
                # An autopilot that does not answer is a fault, not a reason to wait.
                raise AutopilotError(f"imu {name}: {imu.problem}")
            if (upsets := imu.upsets - self._upsets_before.get(name, 0)) >= MOST_UPSETS:
                raise AutopilotError(
                    f"{imu.upset}, {upsets} times now: does something else write, or pretend to be the autopilot?"
                )


class Estimator:
    """Estimates biases with the active alignment, for the present place on Earth."""

    def __init__(self, core: Core, alignment: ActiveAlignment, faces: ActiveSixPosition, own: OwnAttitude) -> None:
        self._core, self.alignment, self._faces, self._own = core, alignment, faces, own
        self.on_solved: Listeners[Whereabouts, FallbackPose, What, Expectation] = Listeners()
        """Listeners to the inputs of an estimate: place, fallbacks for sensors, biases requested, biases predicted."""

    async def solve(self, window: Window, what: What) -> tuple[Solution, Whereabouts, FallbackPose]:
        config = self._core.config
        where, otherwise = models.whereabouts(config, self._core.vehicle), await self._otherwise(window)
        poses = self.alignment.model(), models.compass_model(config.compass)
        platform, any_bias = config.vehicle.platform, config.calibration.any_bias
        found: Solution = await self._core.offload(
            lambda: solve(window, local_earth(where), *poses, what, platform, any_bias=any_bias, otherwise=otherwise)
        )
        return found, where, otherwise

    def sides(self, window: Window) -> FallbackPose:
        """Return the six-position calibrations that give the tilt without a gradienter."""
        return FallbackPose(sides=self._faces.sides(window) if self._core.config.gradienter is None else {})

    async def _otherwise(self, window: Window) -> FallbackPose:
        core, heading = self._core, self._own.heading() if self._core.config.compass is None else None
        try:
            # Use the autopilot's heading only if it is its own and not ours.
            if heading is not None and not await core.vehicle.kind.yaw_is_its_own(core.parameters):
                heading = None
        except AutopilotError:
            heading = None
        return msgspec.structs.replace(self.sides(window), heading=heading)
