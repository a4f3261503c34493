"""Interfaces: the MAVLink component, the control socket's answers, and the child processes for MQTT and the web page.

Each command is answered by its subsystem; the status is merged from the parts of all subsystems.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final, get_args

import msgspec
import numpy as np

from companion.commands import ALL, Monitor, Status
from companion.component.component import MavlinkComponent
from companion.component.own_parameters import AT_ARM, RESULTS, Parameter
from companion.component.service import JobResult
from companion.config.sections import AtArm, Senders
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, RuntimeSettings, Subsystem, Task, joined
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.subsystem import Heading
from companion.daemon.interfaces.diagnosis import Diagnosis
from companion.daemon.interfaces.headline import Headlines
from companion.daemon.job import Job
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import CalibrationRefusedError, ConfigError
from companion.estimation.records.record import ImuRecord
from companion.formats import Object
from companion.messages import message
from companion.physics.units import DEG_H, MG
from companion.samples import ImuSample, Triad

if TYPE_CHECKING:
    from companion.daemon.interfaces.child import Child, StartChild

LARGEST: Final = 1e6
MONITOR_EVERY_S: Final = 0.5
POSE_EVERY_S: Final = 0.2
MOST_SAMPLES: Final = 1000
FACES: Final = {"page": "the page's", "mqtt": "mqtt", "fleet": "fleet", "interrupt": "Ctrl-C's"}
"""Names of interfaces in requests, and in texts for people, as in "asked for by mqtt calibrate"."""
_NO_PAGE: Final[Object] = {"url": None, "viewers": 0, "wrong_tokens": 0}
"""Status of the web page while its process reports nothing."""


def _mean(samples: deque[ImuSample]) -> Object:
    """Average the readings and empty the queue."""
    rows = np.mean([(*sample.gyro_rad_s, *sample.accel_m_s2) for sample in samples], axis=0).tolist()
    samples.clear()
    return {"gyro_rad_s": rows[:3], "accel_m_s2": rows[3:]}


class Interfaces(Subsystem):
    """The MAVLink component, the control socket's answers, and the child processes."""

    def __init__(
        self,
        core: Core,
        devices: Devices,
        offsets: Offsets,
        calibrating: Calibrating,
        arming: Arming,
        heading: Heading,
        recorder: Subsystem,
        child: StartChild | None = None,
    ) -> None:
        self._core, self._devices = core, devices
        self.component = MavlinkComponent(
            core.link,
            calibrating.manager,
            arming.readiness,
            core.texts,
            core.tunes,
            own_parameters(core.wanted),
            Senders(core.config.mavlink.allow),
        )
        calibrating.manager.on_ended.add(self._show_result)
        self.diagnosis = Diagnosis(core, devices, offsets, calibrating, heading.pose)
        self._headlines = Headlines(core, devices, calibrating, arming, heading, self.diagnosis)
        self._pose, self._readiness = heading.pose, arming.readiness
        self._manager = calibrating.manager
        self._subsystems = (self, devices, offsets, calibrating, arming, heading, recorder)
        self._handlers: dict[str, Handler] = {"status": self._status, "monitor": self._monitor}
        self._handlers["fix"] = self.diagnosis.answer_fix
        for subsystem in self._subsystems:
            self._handlers |= subsystem.commands()
        self._start_child = child
        self.mqtt = None if core.config.mqtt is None else self._child("mqtt", "companion.mqtt")
        self.page = None if core.config.web is None else self._child("page", "companion.web")

    def _child(self, name: str, module: str) -> Child:
        # Imported here to keep the start short.
        from companion.daemon.interfaces.child import Child
        from companion.links.system.process import ChildSettings

        level = logging.getLevelName(logging.getLogger().level)
        settings = ChildSettings(self._core.config, level, only_listening=self._core.only_listening)
        return (self._start_child or Child)(name, module, settings)

    async def answer(self, request: Object, face: str | None = None) -> AsyncIterator[Object]:
        """Answer a request; `face`: name of the interface that sent it. Raises CompanionError if it is refused."""
        command = request.get("command")
        face = face or FACES.get(str(request.get("face")), "companion")
        handler = self._handlers.get(command) if isinstance(command, str) else None
        if handler is None:
            yield {"kind": "error", "reason": message("request_not_understood", reason=f"command {command!r}")}
            return
        try:
            understood = ALL[str(command)].read(request)
        except CalibrationRefusedError as error:
            raise CalibrationRefusedError(f"{command}: {error}") from None
        async for reply in handler(understood, face):
            yield reply

    async def _status(self, _request: Status, _face: str) -> AsyncIterator[Object]:
        yield {"kind": "result", "status": await self.refresh()}

    async def _monitor(self, request: Monitor, _face: str) -> AsyncIterator[Object]:
        """Stream the status every 0.5 s; with `pose`, also the attitude and any new state or record every 0.2 s.

        With `samples`, `imus` has the means of each autopilot IMU's readings since the last reply, in vehicle FRD.
        """
        if not request.pose:
            while True:
                yield {"kind": "progress", "status": await self.refresh()}
                await asyncio.sleep(MONITOR_EVERY_S)
        shown, due_s, loop, record = "", 0.0, asyncio.get_running_loop(), None
        read: dict[str, deque[ImuSample]] = {}
        with contextlib.ExitStack() as stack:
            for name, imu in self._devices.imus.items() if request.samples else ():
                read[name] = deque(maxlen=MOST_SAMPLES)
                stack.callback(imu.on_sample.add(read[name].append))
            while True:
                reply: Object = {"kind": "progress", "pose": await self._pose.refresh()}
                if request.samples:
                    reply["imus"] = {name: _mean(samples) for name, samples in read.items() if samples}
                if self._manager.last is not record:
                    record = self._manager.last
                    reply["record"] = msgspec.to_builtins(record)
                state = self._manager.state.shown
                if state != shown or loop.time() >= due_s:
                    reply["status"] = self.all_status()
                    shown, due_s = state, loop.time() + MONITOR_EVERY_S
                yield reply
                await asyncio.sleep(POSE_EVERY_S)

    async def refresh(self) -> Object:
        await self._pose.refresh()
        return self.all_status()

    def all_status(self) -> Object:
        # Headline and arming line must describe the same moment.
        self._readiness.update()
        return joined([subsystem.status() for subsystem in self._subsystems])

    def _show_result(self, job: Job, _result: JobResult) -> None:
        if (record := job.record) is not None:
            parameters = self.component.parameters
            parameters.set("CMP_STATE", RESULTS.index(record.state))
            parameters.set("CMP_GYR_SIG", _worst(record.imus, "gyro", DEG_H))
            parameters.set("CMP_ACC_SIG", _worst(record.imus, "accel", MG))

    def status(self) -> Object:
        return {
            "headline": self._headlines.now(),
            "diagnosis": self.diagnosis.findings,
            "vehicle": self._vehicle(),
            **self._mqtt_status(),
            "page": None if self.page is None else _NO_PAGE | self.page.status(),
            "spoken": list(self._core.texts.spoken),
        }

    def _vehicle(self) -> Mapping[str, object]:
        vehicle, link = self._core.vehicle, self._core.link
        age_s = vehicle.heartbeat_age_s
        refused = self.component.permission.refused
        return {
            "system_id": vehicle.system_id,
            "uid": vehicle.uid,
            "version_known": vehicle.version is not None,
            "unix_time_s": vehicle.place.unix_time_s,
            "firmware": vehicle.firmware,
            "armed": vehicle.arm_state.value,
            "summary": f"{vehicle.name}, {vehicle.arm_state.value}"
            if vehicle.system_id is not None
            else self._devices.not_heard,
            "fault": link.fault,
            "heartbeat_age_s": None if age_s is None else round(age_s, 1),
            "messages": link.received.total() - link.received["bad"],
            "bad": link.received["bad"],
            "not_sent": link.dropped,
            "signing": self._devices.signing.status(),
            "refused": {f"{system}/{one}": count for (system, one), count in refused.items()},
        }

    def _mqtt_status(self) -> Object:
        if self.mqtt is None:
            return {"mqtt": None, "fleet": None}
        report: Object = {"connected": False, "fleet": None} | self.mqtt.status()
        fleet = report.pop("fleet")
        if fleet is None and self._core.config.fleet is not None:
            fleet = {"good": False, "summary": message("fleet_not_sent", reason=report["summary"])}
        return {"mqtt": report, "fleet": fleet}

    async def settled(self, within_s: float) -> None:
        deadline_s = asyncio.get_running_loop().time() + within_s
        while self.mqtt is not None and asyncio.get_running_loop().time() < deadline_s:
            report = self.mqtt.status()
            if report.get("connected") or report.get("last_error"):
                return
            await asyncio.sleep(POSE_EVERY_S)

    def tasks(self) -> Sequence[Task]:
        tasks: list[Task] = [("component", self.component.run), ("diagnosis", self.diagnosis.run)]
        if self.mqtt is not None:
            tasks.append(("mqtt", self.mqtt.run))
        if self.page is not None and self._core.only_listening is None:
            tasks.append(("page", self.page.run))
        return tasks


def own_parameters(wanted: RuntimeSettings) -> list[Parameter]:
    assert set(AT_ARM) == set(get_args(AtArm))
    gyro, accel = wanted.settings.target_gyro_sigma_rad_s / DEG_H, wanted.settings.target_accel_sigma_m_s2 / MG

    aim, switch = wanted.retarget, wanted.switch

    def set_at_arm(value: float) -> None:
        switch(at_arm=AT_ARM[_whole("CMP_AT_ARM", value)])

    return [
        Parameter("CMP_GYR_TGT", gyro, 0.01, LARGEST, lambda value: aim(target_gyro_sigma_rad_s=value * DEG_H)),
        Parameter("CMP_ACC_TGT", accel, 0.0001, LARGEST, lambda value: aim(target_accel_sigma_m_s2=value * MG)),
        Parameter("CMP_PUSH", wanted.push, 0.0, 1.0, lambda value: switch(push=bool(_whole("CMP_PUSH", value)))),
        Parameter("CMP_AT_ARM", AT_ARM.index(wanted.at_arm), 0.0, 2.0, set_at_arm),
        Parameter("CMP_TUNES", wanted.tunes, 0.0, 1.0, lambda value: switch(tunes=bool(_whole("CMP_TUNES", value)))),
        Parameter("CMP_STATE", 0.0, 0.0, 3.0),
        Parameter("CMP_GYR_SIG", 0.0, 0.0, LARGEST),
        Parameter("CMP_ACC_SIG", 0.0, 0.0, LARGEST),
    ]


def _whole(name: str, value: float) -> int:
    if value != round(value):
        raise ConfigError(f"{name}: found {value:g}; allowed: a whole number")
    return round(value)


def _worst(imus: tuple[ImuRecord, ...], triad: Triad, unit: float) -> float:
    values = [value for imu in imus for value in imu.sigma_in_force(triad) or ()]
    return min(max(values, default=0.0) / unit, LARGEST)
