"""One IMU of the autopilot: its telemetry, the offsets that the autopilot subtracts, and changes of the offsets.

Samples count only while the offsets are known; a change by anybody voids the samples collected before. Offsets are
also written by people, and by a boot of ArduPilot with INS_GYR_CAL = 1, which calibrates the gyros.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final

from companion.autopilot.firmware.base import SlotMemory
from companion.autopilot.firmware.firmwares import part_of, read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.firmware.imu_messages import ImuMessage, Six
from companion.autopilot.telemetry.imu_stream import ImuStream
from companion.autopilot.telemetry.px4_console import EkfBias
from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.component.service import JobResult
from companion.config.sections import Imu
from companion.configured import models
from companion.daemon.core import REREAD_EVERY_S, Core, RepeatedRead
from companion.daemon.job import NO_CALIBRATION, Job
from companion.errors import AutopilotError
from companion.estimation.records.validity import Why
from companion.links.system.events import Listeners
from companion.messages import message
from companion.samples import ImuSample

logger = logging.getLogger(__name__)

RETRY_S: Final = 3.0
CONFIRMED_WITHIN_S: Final = 3.0
"""Maximum time from an announced change to a read that disproves it: later, the value may have been changed back."""


class AutopilotImu:
    """Passes the samples of one autopilot IMU to the collector while the offsets subtracted in them are known."""

    def __init__(self, core: Core, imu: Imu, slots: SlotMemory, ekf_bias: EkfBias, rate_hz: float) -> None:
        self.name, self.instance = imu.name, imu.instance or 1
        self.calibration: ImuCalibration | None = None
        """Offsets and scales that the autopilot applies, as last read; None while they are unknown."""
        self.problem = message("offsets_not_read", why="start")
        self.failures = 0
        self.upsets = 0
        self.upset = ""
        self.on_sample: Listeners[ImuSample] = Listeners()
        self.on_counting: Listeners[ImuSample] = Listeners()  # Listeners to samples under known offsets
        self.on_raw: Listeners[float, Six, float | None] = Listeners()
        """Listeners to averaged raw readings: time, readings corrected by the present offsets, temperature in deg C."""
        self.on_read: Listeners[ImuCalibration | None, ImuCalibration] = Listeners()
        """Listeners to reads of the offsets: previous ones (None after a write by the companion), present ones."""
        self.on_change: Listeners[[]] = Listeners()
        self.input = models.imu_input(core.profiles.imu(self.name), None)
        self._slots, self._ekf_bias, self._profiles = slots, ekf_bias, core.profiles
        self._vehicle, self._parameters, self._collector = core.vehicle, core.parameters, core.collector
        self._known: ImuCalibration | None = None
        self._ours = 0
        self._announced: tuple[str, float, float] | None = None
        """Parameter change that somebody announced and `refresh` has not checked yet: name, value, time."""
        self.reading = RepeatedRead(core.vehicle, self._read, RETRY_S)
        self.stream = ImuStream(
            core.link,
            core.vehicle,
            self.instance,
            self._on_sample,
            rate_hz=rate_hz,
            ekf_bias=ekf_bias,
            on_kind_change=self._kind_changed,
            may_be_slow=lambda: not self.on_counting,
        )
        core.parameters.on_value.add(self._on_parameter)
        core.vehicle.on_event.add(self._on_event)

    @contextlib.contextmanager
    def changing(self) -> Iterator[None]:
        """Suspend the use of samples and the reading of offsets while the companion itself writes offsets."""
        self._ours += 1
        self.calibration = self._known = None
        self.on_change.tell()
        try:
            with self._ekf_bias.held():
                yield
        finally:
            self._ours -= 1
            self._invalidate("offsets written")

    @property
    def obstacle(self) -> str | None:
        return self.stream.problem or (self.problem if self.calibration is None else None)

    @property
    def decided(self) -> bool:
        """True once this IMU is known to exist or not: offsets and samples have arrived, or either was not obtained."""
        if self.calibration is None:
            return self.failures > 0 or (self.stream.decided and bool(self.stream.problem))
        return self.stream.decided

    @property
    def in_force(self) -> ImuCalibration:
        """Offsets and scales that the autopilot applies; raises AutopilotError while they are unknown."""
        if self.calibration is None:
            raise AutopilotError(f"imu {self.name}: {self.problem}")
        return self.calibration

    async def refresh(self) -> bool:
        """Read the offsets; if they may have changed, void the samples and return False. Raises AutopilotError."""
        assumed, announced, self._announced = self.calibration, self._announced, None
        why = "offsets read again" if announced is None else f"{announced[0]} was changed"
        try:
            fresh = await read_calibration(self._parameters, self.instance, self._slots)
        except AutopilotError:
            if announced is not None and not self._ours:
                self._upset(why)
            raise
        if self._ours:
            return False  # a write of ours began meanwhile: the values read may be older or newer
        known, self._known = self._known, fresh
        self.calibration, self.problem, self.failures = fresh, "", 0
        part = part_of(self._vehicle.firmware, fresh.gyro_id, fresh.accel_id)
        if self._profiles.found(self.name, part):
            self._kind_changed(self.stream.kind)
        self.on_read.tell(known, fresh)
        now_s = asyncio.get_running_loop().time()
        holds = assumed is not None and assumed.corrects_like(fresh)
        if announced is not None:
            name, value, t_s = announced
            change = f"{name} = {value:.6g}"
            if holds:
                logger.warning("%s", message("announced_value_not_active", imu=self.name, change=change))
                holds = now_s - t_s <= CONFIRMED_WITHIN_S
            else:
                logger.warning("%s", message("offsets_changed_by_others", imu=self.name, change=f": {change}"))
        if not holds:
            if assumed is not None:
                self.upsets, self.upset = self.upsets + 1, why
                self._ekf_bias.step()
            self._collector.reset(why, self.name)
        self.on_change.tell()
        return holds

    @property
    def wants_raw(self) -> bool:
        kind = self.stream.kind
        return self.calibration is not None and kind is not None and kind.integers

    def take_raw(self, gyro_id: int, accel_id: int, raw: ImuSample) -> None:
        known = self.calibration
        if known is None:
            return
        if (gyro_id, accel_id) != (known.gyro_id, known.accel_id):
            # The console names the devices; the order of the slots was a guess.
            self._slots.learn("gyro", gyro_id, self.instance)
            self._slots.learn("accel", accel_id, self.instance)
            self.reading.again()
            return
        output = known.output(raw.gyro_rad_s, raw.accel_m_s2, raw.temperature_degc)
        row: Six = tuple(output.tolist())
        self._collector.add_raw(self.name, raw.t_s, row, raw.temperature_degc)
        self.on_raw.tell(raw.t_s, row, raw.temperature_degc)

    def _on_sample(self, sample: ImuSample) -> None:
        if self.on_sample:
            self.on_sample.tell(sample)
        if self.calibration is not None:
            if self.on_counting:
                self.on_counting.tell(sample)
            self._collector.add_imu(self.name, sample)

    def _kind_changed(self, kind: ImuMessage | None) -> None:
        self.input = models.imu_input(self._profiles.imu(self.name), kind)
        self._collector.set_imu(self.input)
        self.on_change.tell()

    def _invalidate(self, why: str) -> None:
        self.calibration = None
        self.problem = message("offsets_not_read", why=why)
        self._collector.reset(why, self.name)
        self.on_change.tell()
        self.reading.again()

    def _upset(self, why: str) -> None:
        self.upsets, self.upset = self.upsets + 1, why
        self._invalidate(why)

    def _on_parameter(self, name: str, value: float) -> None:
        known = self.calibration
        if known is None or self._ours:
            return
        if known.contradicts({name: value}):
            # Anybody can announce a change; `refresh` asks the autopilot, and voids the samples if it is true.
            self._announced = self._announced or (name, value, asyncio.get_running_loop().time())
        else:
            active = {rival.parameter: rival.value for rival in known.rivals}
            watched = {rival.parameter for rival in self._vehicle.kind.rivals}
            if name not in watched or active.get(name, 0) == value:
                return  # otherwise a setting that overwrites offsets has changed
        self.reading.again(REREAD_EVERY_S)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "rebooted":
            self._upset("the autopilot rebooted")

    async def _read(self) -> None:
        if self._ours:
            return
        try:
            await self.refresh()
        except AutopilotError as error:
            self.problem = str(error)
            self.failures += 1
            logger.warning("%s: %s", self.name, error)
            raise

    def status(self) -> dict[str, object]:
        problem, kind = self.stream.problem or self.problem, self.stream.kind
        return {
            "name": self.name,
            "kind": "autopilot imu",
            "good": not problem,
            "summary": problem or f"autopilot IMU {self.instance}, {kind.name if kind else 'no samples'}",
            "frames": self.stream.samples,
        }


@contextlib.contextmanager
def changing(imus: Iterable[AutopilotImu]) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for imu in imus:
            stack.enter_context(imu.changing())
        yield


_Known = tuple[tuple[float, ...], int]
"""Offset values without names, as PX4 may move an IMU to other parameters, and the autopilot's boot count."""


class OffsetWatch:
    """Detects changes of the offsets; call `poll` often. Calls `lost` with an IMU whose calibration ended, and why."""

    def __init__(self, vehicle: Vehicle, imus: Mapping[str, AutopilotImu], lost: Callable[[str, Why], object]) -> None:
        self._vehicle, self._imus, self._lost = vehicle, imus, lost
        self._known: dict[str, _Known] = {}
        self._before: dict[str, _Known] = {}  # Offsets before a job, until those after it are read
        self._failed = self._asked_restart = False
        self._written: dict[str, dict[str, float]] = {}  # Values just written, by IMU, until they are read
        self.foreign: str | None = None  # Change by somebody else since the last request, as a short text

    def known(self) -> dict[str, _Known]:
        return dict(self._known)

    def let_go(self) -> None:
        self._before, self._known = dict(self._known) or self._before, {}

    def on_ended(self, job: Job, result: JobResult) -> None:
        self.let_go()
        self._written, self._failed = {}, result.outcome != "done"
        if job.kind == "undo":
            return
        if not job.automatic and job.kind not in NO_CALIBRATION:
            self.foreign = None
        if not self._failed and job.record is not None:
            self._asked_restart = job.reboot
            for imu in job.record.imus:
                self._written[imu.name] = {name: one.after for name, one in imu.written.items()}

    def poll(self) -> None:
        for name, imu in self._imus.items():
            calibration = imu.calibration
            if calibration is None:
                continue
            now = tuple(calibration.offsets.values()), self._vehicle.boots
            after_job = name not in self._known
            before = self._before.pop(name, now) if after_job else self._known[name]
            self._known[name] = now
            failed, written = after_job and self._failed, self._written.pop(name, {})
            rebooted = before[1] != now[1]
            restarted = rebooted and not (after_job and self._asked_restart)
            if failed or not after_job:
                changed = before[0] != now[0]
            else:
                # Settling of the EKF may have changed other values for minutes: check only the written ones.
                changed = bool(written) and calibration.contradicts(written)
            if changed and rebooted and (failed or restarted):
                # Changes of our own have been restored by now, so the reboot or somebody else made this one.
                self._lost(name, Why.FAILED if failed else Why.REPLACED)
            elif changed:
                self.foreign = f"{name} was changed"
                logger.warning("%s", message("offsets_changed_by_others", imu=name, change=""))
                self._lost(name, Why.CHANGED)
            elif restarted:
                self._lost(name, Why.REBOOTED)
