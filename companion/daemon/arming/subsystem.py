"""Arming: what is in force, whether that is good enough, and calibrations by itself that keep it so."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping, Sequence

import msgspec

from companion.daemon.arming.armings import Armings, with_armings
from companion.daemon.arming.automatic import Automatic
from companion.daemon.arming.gate_setup import GateSetup
from companion.daemon.arming.in_force import InForce
from companion.daemon.arming.readiness import Readiness
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import StorageError
from companion.estimation.records.record import ImuRecord
from companion.formats import Object
from companion.physics.units import DEG_H, MG
from companion.samples import Vector

logger = logging.getLogger(__name__)


class Arming(Subsystem):
    """May it arm, and what happens when it does."""

    def __init__(self, core: Core, devices: Devices, offsets: Offsets, calibrating: Calibrating) -> None:
        self._core, self._store, self._by_hand = core, calibrating.store, calibrating.by_hand
        self._recovery = offsets.recovery
        self.in_force = InForce(core, devices.imus, calibrating.manager, calibrating.estimator, calibrating.memory)
        self.automatic = Automatic(core, devices.imus, calibrating.manager, self.in_force)
        # In this order: the next automatic calibration asks for what is in force.
        for on_ended in (self.in_force.on_ended, self.automatic.on_ended):
            calibrating.manager.on_ended.add(on_ended)
        self.readiness = Readiness(core, offsets.owed, calibrating.manager, self.in_force, self.automatic)
        self.armings = Armings(core, self.readiness)
        self.gate_setup = GateSetup(core, self.readiness)

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"history": self._answer_history}

    def status(self) -> Object:  # noqa: D102
        now_s = asyncio.get_running_loop().time()
        return {
            "arming": {
                **self.readiness.status(),
                "setup": self.gate_setup.status(),
                "last": msgspec.to_builtins(self.armings.last),
            },
            "automatic": self.automatic.status(),
            "calibration": shown_calibration(self.in_force, now_s),
        }

    def tasks(self) -> Sequence[Task]:  # noqa: D102
        looking: list[Task] = [("gate-setup", self.gate_setup.run)]
        if self._core.only_listening is not None:
            return looking
        return [
            ("readiness", self.readiness.run),
            ("armings", self.armings.run),
            ("automatic", self.automatic.run),
            *looking,
        ]

    async def _answer_history(self, request: Object, _face: str) -> AsyncIterator[Object]:
        limit = request.get("limit")
        number = limit if isinstance(limit, int) and limit > 0 else None
        # A thousand records take longer to read than a ground station waits for an answer.
        yield await self._core.offload(self._history, number)

    def _history(self, limit: int | None) -> Object:
        armings = self.armings.history()
        found = self._store.numbered(limit)
        records = with_armings(list(found.values()), armings)
        return {
            "kind": "result",
            "numbers": list(found),
            "records": [msgspec.to_builtins(record) for record in records],
            "armings": [msgspec.to_builtins(arming) for arming in armings[:limit]],
            "by_hand": self._by_hand.history()[:limit],
            "interrupted": self._recovery.interruptions()[:limit],
            "flights": self._flights(limit),
        }

    def _flights(self, limit: int | None) -> list[Object]:
        """What `companion flight` has kept, without what only plots need."""
        # What nobody asked for costs the start nothing.
        from companion.storage.flights import FlightStore

        try:
            found = FlightStore(self._core.config.storage.path).newest(limit)
        except StorageError as error:
            logger.warning("%s", error)
            return []
        shown: list[Object] = [msgspec.to_builtins(kept) | {"number": number} for number, kept in found.items()]
        for imu in (imu for each in shown for imu in each["flight"]["imus"]):
            del imu["moments"]
        return shown


def shown_calibration(in_force: InForce, now_s: float) -> dict[str, object] | None:
    """The calibration in force, else the last one if that was good and has not been undone; None without either.

    `calibrated_ago_s` and `confirmed_ago_s` are null where that is not known to be in force: a wall clock that was
    wrong in the field tells no age.
    """
    known = in_force.calibration is not None
    record = in_force.calibration or in_force.earlier
    if record is None:
        return None
    calibrated_s, confirmed_s = in_force.calibrated_s, in_force.confirmed_s
    return {
        "in_force": known,
        "started_at": record.started_at,
        "calibrated_ago_s": round(now_s - calibrated_s, 1) if known and calibrated_s is not None else None,
        "confirmed_ago_s": round(now_s - confirmed_s, 1) if confirmed_s is not None else None,
        "imus": [_imu(imu, in_force.temperatures_degc.get(imu.name)) for imu in record.imus],
    }


def _imu(imu: ImuRecord, now_degc: float | None) -> dict[str, object]:
    return {
        "name": imu.name,
        "temperature_degc": imu.temperature_degc,
        "when_warm": [] if imu.when_warm is None else list(imu.when_warm.words),
        "temperature_now_degc": now_degc,
        "gyro_bias_deg_h": _scaled(imu.gyro_bias_rad_s, DEG_H, 2),
        "gyro_sigma_deg_h": _scaled(imu.gyro_sigma_use_rad_s, DEG_H, 2),
        "accel_bias_mg": _scaled(imu.accel_bias_m_s2, MG, 4),
        "accel_sigma_mg": _scaled(imu.accel_sigma_use_m_s2, MG, 4),
        "held_back": list(imu.held_back),
    }


def _scaled(axes: Vector | None, unit: float, decimals: int) -> list[float] | None:
    return None if axes is None else [round(value / unit, decimals) for value in axes]
