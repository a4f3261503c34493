"""Arming: the active calibration, the gate, automatic calibrations, and the history of armings."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Final

import msgspec

from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.commands import History
from companion.component.statustext import Severity, Weight
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.in_force import ActiveCalibration
from companion.daemon.arming.readiness import Readiness
from companion.daemon.arming.warm_up import WarmUp
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import REREAD_EVERY_S, Core, Handler, RepeatedRead, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord, ImuRecord
from companion.formats import Object, utc_now
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector
from companion.storage.records import armings_in, stored_history

logger = logging.getLogger(__name__)


QUEUE: Final = 16
POLL_S: Final = 1.0
RETRY_S: Final = 30.0
SCRIPT_STARTS_S: Final = 10.0
"""Longest wait for a sign of ArduPilot's gate script: scripting starts some seconds after the first heartbeat."""


class Armings:
    """Reports and records the active calibration at each arming; `run` writes the records to disk."""

    def __init__(self, core: Core, readiness: Readiness) -> None:
        self._readiness, self._say, self._offload = readiness, core.say, core.offload
        self.file = armings_in(core.config.storage.path)
        self._queue: asyncio.Queue[ArmingRecord] = asyncio.Queue(QUEUE)
        self.last: ArmingRecord | None = None
        self.seen_disarmed = False
        """True once this daemon has seen the aircraft disarmed; until then, the daemon may have started in flight."""

    async def run(self) -> None:
        try:
            while True:
                arming = await self._queue.get()
                try:
                    await self._offload(self.file.append, arming)
                except StorageError as error:
                    logger.warning("arming not kept: %s", error)
        finally:
            while not self._queue.empty():
                with contextlib.suppress(StorageError):
                    self.file.append(self._queue.get_nowait())

    def add(self) -> None:
        readiness, in_force = self._readiness, self._readiness.in_force
        now_s = asyncio.get_running_loop().time()
        state, words = readiness.state(now_s)
        self.last = ArmingRecord(
            armed_at=utc_now(),
            state=state,
            reason=words,
            at_arm=readiness.at_arm,
            calibration=in_force.calibration.started_at if in_force.calibration is not None else None,
            calibrated_ago_s=_ago_s(now_s, in_force.calibrated_s),
            confirmed_ago_s=_ago_s(now_s, in_force.confirmed_s),
            gyro_sigma_use_rad_s=in_force.sigma("gyro"),
            accel_sigma_use_m_s2=in_force.sigma("accel"),
        )
        with contextlib.suppress(asyncio.QueueFull):
            self._queue.put_nowait(self.last)
        if readiness.at_arm != "off":
            uncalibrated = state == "uncalibrated"
            severity = Severity.WARNING if uncalibrated else Severity.NOTICE
            self._say(severity, f"Armed{' UNCALIBRATED' if uncalibrated else ''}: {words}", Weight.RESULT)


class GateSetup:
    """Checks whether the autopilot is set up to ask the companion before it arms."""

    def __init__(self, core: Core) -> None:
        self._core, self._vehicle = core, core.vehicle
        self.reading = RepeatedRead(core.vehicle, self._read, RETRY_S)
        self._said: str | None = None
        self.problem: str | None = None
        """Autopilot settings missing for the gate, as text for people; None: none is missing, or not known yet."""
        self.known = False
        core.parameters.on_value.add(self._on_parameter)

    async def _read(self) -> None:
        self.known = False
        while self._core.wanted.at_arm != "gate":  # a ground station may switch the gate on at the flight line
            await asyncio.sleep(POLL_S)
        await self._vehicle.found.wait()
        self.problem = await self._vehicle.kind.find_gate_problem(
            self._core.parameters, self._vehicle.system_id, SCRIPT_STARTS_S
        )
        self.known = True
        if self.problem not in (None, self._said) and self._core.wanted.at_arm == "gate":
            logger.warning("arming is not gated: %s", self.problem)
            self._core.say(Severity.WARNING, f"NO GATE: {self.problem}", Weight.RESULT)
        self._said = self.problem

    def _on_parameter(self, name: str, _value: float) -> None:
        if self.known and name in self._vehicle.kind.gate_parameters:
            self.reading.again(REREAD_EVERY_S)


class Arming(Subsystem):
    """Connects the active calibration, the gate, automatic calibrations and the history of armings."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets, calibrating: Calibrating) -> None:
        self._core, self._store, self._by_hand = core, calibrating.store, calibrating.by_hand
        self.manager = calibrating.manager
        self._recovery = offsets.recovery
        self.in_force = ActiveCalibration(core, devices.imus, calibrating)
        self.automatic = Automatic(core, devices.imus, self.in_force, calibrating.alignment)
        # The order matters: `Automatic` reads the state of `ActiveCalibration`.
        calibrating.manager.on_ended.add(self.in_force.on_ended)
        calibrating.manager.on_ended.add(self.automatic.on_ended)
        self.readiness = Readiness(core, offsets.owed, self.in_force, self.automatic)
        self.warm_up = WarmUp(core, calibrating.memory)
        self.armings = Armings(core, self.readiness)
        self.gate_setup = GateSetup(core)
        core.vehicle.on_event.add(self._on_event)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "disarmed":
            self.armings.seen_disarmed = True
        elif event == "armed" and self.armings.seen_disarmed:  # a start in flight is no arming
            self.armings.add()

    def commands(self) -> Mapping[str, Handler]:
        return {"history": self._answer_history}

    def status(self) -> Object:
        setup = self.gate_setup
        return {
            "arming": {
                **self.readiness.status(),
                "warm_up": self.warm_up.status(),
                "setup": {"known": setup.known, "problem": setup.problem if setup.known else None},
                "last": msgspec.to_builtins(self.armings.last),
            },
            "automatic": self.automatic.status(),
            "calibration": self._calibration(),
        }

    def tasks(self) -> Sequence[Task]:
        tasks: list[Task] = [("gate-setup", self.gate_setup.reading.run)]
        if self._core.only_listening is None:
            tasks += [("readiness", self.readiness.run), ("automatic", self.automatic.run)]
            tasks += [("warm-up", self.warm_up.run), ("armings", self.armings.run)]
        return tasks

    def _calibration(self) -> Object | None:
        """Return the active calibration with its age, or the last good one without age (clocks may have been wrong)."""
        in_force, now_s = self.in_force, asyncio.get_running_loop().time()
        known, record = in_force.calibration is not None, in_force.calibration or in_force.earlier
        if record is None:
            return None
        return {
            "in_force": known,
            "started_at": record.started_at,
            "calibrated_ago_s": _ago_s(now_s, in_force.calibrated_s) if known else None,
            "confirmed_ago_s": _ago_s(now_s, in_force.confirmed_s),
            "imus": [
                {
                    "name": imu.name,
                    "temperature_degc": imu.temperature_degc,
                    "when_warm": [] if imu.when_warm is None else list(imu.when_warm.words),
                    "temperature_now_degc": in_force.temperatures_degc.get(imu.name),
                    "gyro_bias_deg_h": _scaled(imu.gyro_bias_rad_s, DEG_H, 2),
                    "gyro_sigma_deg_h": _scaled(self._sigma(imu, "gyro"), DEG_H, 2),
                    "accel_bias_mg": _scaled(imu.accel_bias_m_s2, MG, 4),
                    "accel_sigma_mg": _scaled(self._sigma(imu, "accel"), MG, 4),
                    "held_back": list(imu.held_back),
                    "unchanged": list(imu.unchanged),
                }
                for imu in record.imus
            ],
        }

    def _sigma(self, imu: ImuRecord, triad: Triad) -> Vector | None:
        """Return the sigma of the active offsets, as the headline shows it; of a held-back result, its own sigma."""
        active = None if triad in imu.held_back or imu.of(triad).bias is None else self.in_force.active(imu.name, triad)
        return imu.sigma_in_force(triad) if active is None else active[0]

    async def _answer_history(self, request: History, _face: str) -> AsyncIterator[Object]:
        # Reading a thousand records would block the event loop too long.
        yield await self._core.offload(self._history, request.limit)

    def _history(self, limit: int | None) -> Object:
        return {
            "kind": "result",
            **stored_history(self._core.config.storage.path, limit),
            "by_hand": self._by_hand.history()[:limit],
            "interrupted": self._recovery.interruptions()[:limit],
        }


def _ago_s(now_s: float, time_s: float | None) -> float | None:
    return None if time_s is None else round(now_s - time_s, 1)


def _scaled(axes: Vector | None, unit: float, decimals: int) -> list[float] | None:
    return None if axes is None else [round(value / unit, decimals) for value in axes]
